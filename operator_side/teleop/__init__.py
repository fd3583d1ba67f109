"""Driving by hand: keys or a gamepad to leased twists.

May import: `protocol`, `operator_side`.
Interface: `control` maps keys and sticks to twists; `terminal` and `gamepad` read them.
"""
