"""Modules of tests.conformance.robot.broken."""
