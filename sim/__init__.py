"""A PyBullet simulation behind the robot's ports.

May import: `protocol`, `robot_side`.
Interface: `process` is the simulation as a process; `world.world.World` the same in virtual time; `scenario` its
    data.
"""
