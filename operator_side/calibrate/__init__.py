"""Modules of sightline.operator_side.calibrate."""
