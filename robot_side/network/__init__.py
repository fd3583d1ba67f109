"""Modules of robot_side.network."""
