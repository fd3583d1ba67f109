"""Modules of operator_side.teleop."""
