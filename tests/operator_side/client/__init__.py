"""Modules of tests.operator_side.client."""
