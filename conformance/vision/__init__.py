"""Modules of conformance.vision."""
