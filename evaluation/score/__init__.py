"""Modules of evaluation.score."""
