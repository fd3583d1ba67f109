"""Modules of sightline.operator_side.config."""
