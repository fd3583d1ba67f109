"""Modules of tests.protocol."""
