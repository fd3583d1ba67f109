"""`sightline doctor`: problems of this machine, and of its link to a robot, each with its fix.

May import: `protocol`, `robot_side`, `operator_side`.
Interface: `machine` and `network` return findings.
"""
