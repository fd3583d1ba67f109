"""Modules of vision_side.detect.color."""
