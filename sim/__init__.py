"""A PyBullet world that stands in for hardware, behind the robot's own ports."""
