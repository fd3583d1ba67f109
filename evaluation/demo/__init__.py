"""Modules of sightline.evaluation.demo."""
