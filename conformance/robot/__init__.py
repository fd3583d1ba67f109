"""Modules of sightline.conformance.robot."""
