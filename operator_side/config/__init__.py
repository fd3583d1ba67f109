"""Modules of operator_side.config."""
