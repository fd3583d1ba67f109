"""Modules of tests.repository."""
