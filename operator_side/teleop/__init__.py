"""Driving by hand: keys or a gamepad to leased twists.

May import: `protocol`, `operator_side`.
Interface: `control` maps intent to twists; `terminal` and `gamepad` read the operator's hands.
"""
