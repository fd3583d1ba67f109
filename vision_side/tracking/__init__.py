"""Modules of sightline.vision_side.tracking."""
