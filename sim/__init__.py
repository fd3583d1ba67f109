"""A PyBullet simulation behind the robot's ports.

May import: `protocol`, `robot_side`.
Interface: `process` runs in real time, `world.world.World` in virtual time; `scenario` has their data.
"""
