"""Modules of tests.operator_side.teleop."""
