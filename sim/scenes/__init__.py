"""Modules of sightline.sim.scenes."""
