"""Modules of tests.evaluation.faults."""
