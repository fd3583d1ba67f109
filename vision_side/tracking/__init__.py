"""Modules of vision_side.tracking."""
