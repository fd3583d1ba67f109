"""Modules of tests.e2e.third_party."""
