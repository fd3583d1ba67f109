"""Detectors by color. Pure.

May import: `protocol`, `vision_side`; NumPy, OpenCV.
Interface: The entry points `hsv` and `adaptive`.
"""
