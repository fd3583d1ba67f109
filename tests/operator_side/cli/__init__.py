"""Modules of tests.operator_side.cli."""
