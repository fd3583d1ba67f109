"""Modules of sightline.operator_side.setup."""
