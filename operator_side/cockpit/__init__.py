"""Modules of operator_side.cockpit."""
