"""Modules of operator_side.setup."""
