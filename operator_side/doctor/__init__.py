"""`sightline doctor`: what is wrong on this machine, and between it and a robot, each with the line that fixes it.

May import: `protocol`, `robot_side`, `operator_side`.
Interface: `machine` and `network` return findings.
"""
