"""Modules of operator_side.cli."""
