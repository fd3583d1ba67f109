"""Modules of tests.vision_side.serving."""
