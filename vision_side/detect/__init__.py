"""Detectors behind one port, and the wrappers around them.

May import: `protocol`, `vision_side`.
Interface: `port.Detector` is what a detector implements; `registry` finds and builds one by name.
"""
