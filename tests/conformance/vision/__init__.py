"""Modules of tests.conformance.vision."""
