"""Modules of sightline.conformance.vision."""
