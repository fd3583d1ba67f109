"""Modules of sightline.robot_side.network."""
