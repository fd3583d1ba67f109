"""Modules of conformance.robot."""
