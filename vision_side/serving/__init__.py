"""Modules of sightline.vision_side.serving."""
