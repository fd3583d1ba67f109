"""Modules of sightline.robot_side.hardware.cameras."""
