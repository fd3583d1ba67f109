"""Modules of tests.evaluation.demo."""
