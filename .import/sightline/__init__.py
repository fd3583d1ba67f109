"""Sightline: the public API."""
