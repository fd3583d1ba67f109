"""Modules of tests.docs."""
