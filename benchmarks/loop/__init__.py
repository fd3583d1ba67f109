"""Modules of sightline.benchmarks.loop."""
