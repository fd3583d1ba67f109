"""Modules of sightline.operator_side.cli."""
