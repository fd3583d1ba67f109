"""Modules of tests.e2e."""
