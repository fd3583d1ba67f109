"""Runs and images on disk: recorded, replayed, filmed.

May import: `protocol`, `vision_side`, `operator_side`; mcap, av.
Interface: `recorder`, `replay`, `film`.
"""
