"""Modules of tests.protocol.spec."""
