"""Runs the system and scores it: lockstep, demos, faults, and the legacy controllers for comparison.

May import: the four sides, `operator_side` without `cli/`.
Interface: `lockstep` runs the loop in virtual time; `checks.Check` is one figure with its bound; `processes` runs
    real services.
"""
