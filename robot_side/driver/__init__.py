"""The driver process: owns motors, gate and STOP latch; has no network.

May import: `protocol`, `robot_side`.
Interface: `process.run` starts it; `core` is its logic.
"""
