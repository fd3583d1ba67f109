"""Modules of evaluation.demo."""
