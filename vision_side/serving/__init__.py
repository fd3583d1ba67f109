"""Modules of vision_side.serving."""
