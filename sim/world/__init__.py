"""Modules of sightline.sim.world."""
