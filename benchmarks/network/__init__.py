"""Modules of sightline.benchmarks.network."""
