"""Modules of tests.evaluation.score."""
