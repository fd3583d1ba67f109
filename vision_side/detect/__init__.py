"""Detectors behind one port, and the wrappers around them.

May import: `protocol`, `vision_side`.
Interface: `port.Detector` is the interface of a detector; `registry` finds and builds a detector by name.
"""
