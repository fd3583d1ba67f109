"""Scores of runs and of detectors, from the simulation's truth, and the bounds they must keep."""
