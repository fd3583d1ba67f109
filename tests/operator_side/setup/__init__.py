"""Modules of tests.operator_side.setup."""
