"""Modules of benchmarks.network."""
