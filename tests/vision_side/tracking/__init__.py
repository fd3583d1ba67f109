"""Modules of tests.vision_side.tracking."""
