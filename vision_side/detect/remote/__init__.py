"""Detectors on another machine: a service on the robot's link, or a server that is queried frame by frame."""
