"""Missions: plug-ins that map detections to a twist. Pure, but for the registry.

May import: `protocol`, `vision_side`.
Interface: `port.Mission` is what a mission implements; `registry` finds and builds one by name; `switch` changes the
    active one.
"""
