"""Modules of sightline.protocol.spec."""
