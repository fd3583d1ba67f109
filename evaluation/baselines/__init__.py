"""Modules of sightline.evaluation.baselines."""
