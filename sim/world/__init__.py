"""The simulated world on PyBullet: bodies, motors, camera, lidar.

May import: `protocol`, `robot_side`, `sim`.
Interface: `world.World`, on a clock that its caller steps.
"""
