"""Tracks one target in the odometry frame with a Kalman filter. Pure.

There the robot's own motion drops out, and what is left is the target's position and velocity. Both axes share one
2x2 covariance, since nothing prefers one of them. The clock is the frames' capture time.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sightline.protocol.messages import Pose
from sightline.vision_side.config import TrackConfig
from sightline.vision_side.tracking.locate import Sighting

_FIRST_SPEED_MPS = 0.3  # 1 sigma of a target's speed before anything is known of it
_SURPRISE = 9.0  # a sighting three sigma off means that the target was pushed ...
_PUSHED_MPS = 0.4  # ... and that its velocity may have changed by this much


@dataclass(frozen=True, slots=True)
class Target:
    """Where the target is and how it moves, in the odometry frame, and for how long it was not seen."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    unseen_us: int
    sightings: int


class Track:
    """Follows at most one target; `target` is None when there is none."""

    def __init__(self, config: TrackConfig) -> None:
        self._config = config
        self.target: Target | None = None
        self._variance = (0.0, 0.0, 0.0)  # of position, both, velocity

    def step(self, dt_s: float, pose: Pose, sightings: Sequence[Sighting]) -> Sighting | None:
        """Advance by `dt_s` and take in what was seen from `pose`. Returns the sighting that is the target.

        `sightings` come best first; the best one starts a track, the nearest one in the gate continues it.
        """
        if self.target is None:
            return self._start(pose, sightings)
        self._advance(self.target, dt_s)
        seen = self._nearest(self.target, pose, sightings)
        if seen is not None:
            self._correct(self.target, to_odometry(pose, seen.x_m, seen.y_m), self._noise(seen))
        elif self.target.unseen_us > self._config.give_up_s * 1e6:
            self.target = None
        return seen

    def _start(self, pose: Pose, sightings: Sequence[Sighting]) -> Sighting | None:
        if not sightings:
            return None
        x, y = to_odometry(pose, sightings[0].x_m, sightings[0].y_m)
        self.target = Target(x, y, 0.0, 0.0, 0, 1)
        self._variance = (self._noise(sightings[0]), 0.0, _FIRST_SPEED_MPS**2)
        return sightings[0]

    def _advance(self, target: Target, dt_s: float) -> None:
        """Constant velocity, with white acceleration."""
        position, both, velocity = self._variance
        power = self._config.acceleration_mps2**2 * dt_s
        self._variance = (position + dt_s * (2 * both + dt_s * velocity) + power * dt_s**2 / 3,
                          both + dt_s * velocity + power * dt_s / 2, velocity + power)
        self.target = Target(target.x_m + target.vx_mps * dt_s, target.y_m + target.vy_mps * dt_s, target.vx_mps,
                             target.vy_mps, target.unseen_us + round(dt_s * 1e6), target.sightings)

    def _nearest(self, target: Target, pose: Pose, sightings: Sequence[Sighting]) -> Sighting | None:
        gate = self._config.gate_m + self._config.gate_growth_mps * target.unseen_us / 1e6
        best: Sighting | None = None
        for one in sightings:
            x, y = to_odometry(pose, one.x_m, one.y_m)
            away = math.hypot(x - target.x_m, y - target.y_m)
            if away < gate:
                gate, best = away, one
        return best

    def _correct(self, target: Target, seen: tuple[float, float], noise: float) -> None:
        position, both, velocity = self._variance
        dx, dy = seen[0] - target.x_m, seen[1] - target.y_m
        if dx * dx + dy * dy > _SURPRISE * 2 * (position + noise):
            velocity += _PUSHED_MPS**2
            position += (position + noise)
        gain, gain_velocity = position / (position + noise), both / (position + noise)
        self._variance = (position * (1 - gain), both * (1 - gain), velocity - gain_velocity * both)
        self.target = Target(target.x_m + gain * dx, target.y_m + gain * dy, target.vx_mps + gain_velocity * dx,
                             target.vy_mps + gain_velocity * dy, 0, target.sightings + 1)

    def _noise(self, sighting: Sighting) -> float:
        """Variance of one measured position: range errors grow with its square, and with a hidden outline."""
        range_m2 = sighting.x_m**2 + sighting.y_m**2
        return float((self._config.range_noise * max(range_m2, 0.1) / max(sighting.detection.score, 0.2) ** 2) ** 2)


def to_odometry(pose: Pose, x_m: float, y_m: float) -> tuple[float, float]:
    """A point about the robot at `pose`, in the odometry frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + cos * x_m - sin * y_m, pose[1] + sin * x_m + cos * y_m


def from_odometry(pose: Pose, x_m: float, y_m: float) -> tuple[float, float]:
    """A point of the odometry frame, about the robot at `pose`."""
    dx, dy = x_m - pose[0], y_m - pose[1]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return cos * dx + sin * dy, cos * dy - sin * dx
