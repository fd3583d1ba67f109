"""Modules of tests.contracts."""
