"""Modules of tests.e2e.compose."""
