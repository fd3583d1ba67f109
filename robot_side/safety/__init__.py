"""Modules of sightline.robot_side.safety."""
