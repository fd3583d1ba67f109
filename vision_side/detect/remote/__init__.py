"""Detectors on another machine: a service on the robot's link, or a server that answers each frame.

May import: `protocol`, `vision_side`.
Interface: The entry points that take an address; `client` and `deadline` for remote detectors of your own.
"""
