"""The network process: owns camera and link, decides when a frame is sent.

May import: `protocol`, `robot_side`.
Interface: `process` is its shell, `core` its logic; the driver process starts it.
"""
