"""A PyBullet simulation behind the robot's ports."""
