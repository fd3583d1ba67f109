"""Modules of tests.training."""
