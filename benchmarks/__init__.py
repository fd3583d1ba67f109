"""Performance measurements, each as a ratio to a floor of the same run.

May import: the four sides, `evaluation`, `operator_side/client`.
Interface: One module for each `sightline bench` command.
"""
