"""Detectors on another machine: a service on the robot's link, or a server with one answer per frame.

May import: `protocol`, `vision_side`.
Interface: The entry points that take an address; `client` and `deadline` for third-party remote detectors.
"""
