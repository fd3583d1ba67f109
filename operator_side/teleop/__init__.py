"""Manual driving: converts keys or a gamepad to twists under a lease.

May import: `protocol`, `operator_side`.
Interface: `control` maps keys and sticks to twists; `terminal` and `gamepad` read them.
"""
