"""Modules of sightline.operator_side.teleop."""
