"""Measures what a robot is made of: camera, target colour, wheels."""
