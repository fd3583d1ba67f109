"""Modules of tests.sim.scenes."""
