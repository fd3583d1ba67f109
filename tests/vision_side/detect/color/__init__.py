"""Modules of tests.vision_side.detect.color."""
