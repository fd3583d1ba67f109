"""Modules of tests.evaluation.baselines."""
