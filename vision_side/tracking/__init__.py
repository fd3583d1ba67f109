"""From detections to twists: locate, track, predict, steer. Pure.

May import: `protocol`, `vision_side`.
Interface: `track.Track`, `steering`, `prediction`, `locate`, each used by missions.
"""
