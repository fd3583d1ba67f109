"""Modules of tests.robot_side.network."""
