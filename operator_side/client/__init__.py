"""Modules of sightline.operator_side.client."""
