"""Measures what a robot is made of: camera, target color, wheels.

May import: `protocol`, `vision_side`, `operator_side`.
Interface: `camera`, `color`, `wheels`, each used by the command of its name.
"""
