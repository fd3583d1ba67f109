"""Detectors by color."""
