"""Modules of tests.benchmarks."""
