"""Measures the parts of a robot: camera, target color, wheels.

May import: `protocol`, `vision_side`, `operator_side`.
Interface: `camera`, `color`, `wheels`, each for the command of the same name.
"""
