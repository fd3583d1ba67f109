"""The safety gate: the only path from a command to the wheels. Pure, under strict limits.

May import: `protocol`, `robot_side`.
Interface: `gate.SafetyGate`; `limits` for its numbers.
"""
