"""The simulated world on PyBullet."""
