"""Modules of tests.conformance.robot."""
