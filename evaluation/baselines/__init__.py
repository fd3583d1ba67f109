"""Modules of evaluation.baselines."""
