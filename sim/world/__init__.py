"""Modules of sim.world."""
