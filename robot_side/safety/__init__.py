"""Modules of robot_side.safety."""
