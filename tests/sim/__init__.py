"""Modules of tests.sim."""
