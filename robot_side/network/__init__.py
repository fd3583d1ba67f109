"""The network process: owns camera and link, decides when to send a frame.

May import: `protocol`, `robot_side`.
Interface: `process` is its shell, `core` its logic; the driver process starts it.
"""
