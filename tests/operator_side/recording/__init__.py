"""Modules of tests.operator_side.recording."""
