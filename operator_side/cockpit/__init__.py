"""Modules of sightline.operator_side.cockpit."""
