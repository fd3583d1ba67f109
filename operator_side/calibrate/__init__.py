"""Modules of operator_side.calibrate."""
