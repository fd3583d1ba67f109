"""Runs the system and judges it: scores, demos, faults, and the older laws that it is compared with."""
