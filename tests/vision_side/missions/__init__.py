"""Modules of tests.vision_side.missions."""
