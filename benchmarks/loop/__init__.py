"""Modules of benchmarks.loop."""
