"""Legacy controllers, only for comparison. Pure.

May import: `protocol`, `vision_side`.
Interface: Missions for `sightline score --mission`.
"""
