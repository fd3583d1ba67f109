"""Modules of tests.operator_side.config."""
