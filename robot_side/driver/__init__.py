"""Modules of robot_side.driver."""
