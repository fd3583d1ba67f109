"""Modules of tests.operator_side.cockpit."""
