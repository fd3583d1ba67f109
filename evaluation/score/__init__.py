"""Scores of runs and of detectors, from the truth of the simulation, and their bounds.

May import: the four sides, `evaluation`.
Interface: `runs` for scenarios, `detectors` for labeled scenes, `figures` for their numbers.
"""
