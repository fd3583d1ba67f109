"""Detectors that are elsewhere: a service on the robot's own link, or a server that is asked frame by frame."""
