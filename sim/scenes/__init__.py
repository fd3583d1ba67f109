"""Modules of sim.scenes."""
