"""Modules of tests.sim.world."""
