"""Modules of sightline.robot_side.driver."""
