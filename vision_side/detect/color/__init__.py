"""Modules of sightline.vision_side.detect.color."""
