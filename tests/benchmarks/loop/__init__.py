"""Modules of tests.benchmarks.loop."""
