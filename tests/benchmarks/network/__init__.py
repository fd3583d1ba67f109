"""Modules of tests.benchmarks.network."""
