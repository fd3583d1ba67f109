"""Missions: plug-ins that map detections to a twist. Pure, except the registry.

May import: `protocol`, `vision_side`.
Interface: `port.Mission` is the interface of a mission; `registry` finds and builds a mission by name; `switch` changes
    the active mission.
"""
