"""Frames of reference without NumPy: a rotation and where it is, chained as a URDF chains its joints. Pure."""

import math
from typing import NamedTuple

Vector = tuple[float, float, float]
Rotation = tuple[Vector, Vector, Vector]
"""Rows of the matrix."""


class Transform(NamedTuple):
    """Where something is and how it is turned, seen from something else."""

    turn: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    at: Vector = (0.0, 0.0, 0.0)

    def point(self, inner: Vector) -> Vector:
        """A point of this frame, seen from outside."""
        x, y, z = self.direction(inner)
        return x + self.at[0], y + self.at[1], z + self.at[2]

    def direction(self, inner: Vector) -> Vector:
        """A direction of this frame, seen from outside."""
        x, y, z = (sum(one * other for one, other in zip(row, inner, strict=True)) for row in self.turn)
        return x, y, z

    def of(self, inner: "Transform") -> "Transform":
        """A frame that hangs in this one, seen from outside."""
        columns = [self.direction(_column(inner.turn, index)) for index in range(3)]
        x, y, z = (_column((columns[0], columns[1], columns[2]), index) for index in range(3))
        return Transform((x, y, z), self.point(inner.at))

    def inverse(self) -> "Transform":
        """The outside, seen from here."""
        back = Transform((_column(self.turn, 0), _column(self.turn, 1), _column(self.turn, 2)))
        x, y, z = back.direction(self.at)
        return Transform(back.turn, (-x, -y, -z))

    @property
    def yaw_rad(self) -> float:
        """Which way its x axis points, over the floor."""
        return math.atan2(self.turn[1][0], self.turn[0][0])


def transform(at: Vector, roll_rad: float = 0.0, pitch_rad: float = 0.0, yaw_rad: float = 0.0) -> Transform:
    """The frame of a URDF's `xyz` and `rpy`: turned about its x, then y, then z axis as they were before."""
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return Transform((
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    ), at)


def _column(turn: Rotation, index: int) -> Vector:
    return turn[0][index], turn[1][index], turn[2][index]
