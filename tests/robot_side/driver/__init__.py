"""Modules of tests.robot_side.driver."""
