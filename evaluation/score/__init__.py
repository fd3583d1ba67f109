"""Scores of runs and of detectors, from the simulation's truth, and the bounds they must keep.

May import: the four sides, `evaluation`.
Interface: `runs` for scenarios, `detectors` for labeled scenes, `figures` for their numbers.
"""
