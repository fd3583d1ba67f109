"""Modules of robot_side.hardware.cameras."""
