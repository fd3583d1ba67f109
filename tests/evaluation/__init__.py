"""Modules of tests.evaluation."""
