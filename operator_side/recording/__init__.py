"""Modules of sightline.operator_side.recording."""
