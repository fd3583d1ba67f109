"""Modules of sightline.evaluation.score."""
