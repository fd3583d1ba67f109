"""Track one target in the odometry frame with a Kalman filter. Pure.

In this frame the state is only the target's position and velocity, without the robot's motion. Both axes share one 2x2
covariance, because they have the same noise. The clock is the capture time of the frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sightline.protocol.messages import Pose
from sightline.vision_side.config import TrackConfig
from sightline.vision_side.tracking.locate import Sighting

# 1 sigma of the speed of a new target.
_FIRST_SPEED_MPS = 0.3
# A sighting three sigma off means that the target was pushed. Without more variance the filter would lag behind it.
_SURPRISE = 9.0
_PUSHED_MPS = 0.4


@dataclass(frozen=True, slots=True)
class Target:
    """Position and velocity of the target in the odometry frame, and the time since its last detection."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    unseen_us: int
    sightings: int


class Track:
    """Follows at most one target. `target` is None without one."""

    def __init__(self, config: TrackConfig) -> None:
        self._config = config
        self.target: Target | None = None
        self._variance = (0.0, 0.0, 0.0)  # of position, both, velocity

    def step(self, dt_s: float, pose: Pose, sightings: Sequence[Sighting]) -> Sighting | None:
        """Advance the track and correct it with the newest sightings.

        Args:
            dt_s: time since the last frame.
            pose: odometry at capture, m, m, rad.
            sightings: candidates, best first. The best one starts a track, the nearest one in the gate continues it.

        Returns:
            The sighting of the target, or None.
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
        """Predict with constant velocity and white acceleration."""
        position, both, velocity = self._variance
        power = self._config.acceleration_mps2**2 * dt_s
        self._variance = (position + dt_s * (2 * both + dt_s * velocity) + power * dt_s**2 / 3,
                          both + dt_s * velocity + power * dt_s / 2, velocity + power)
        self.target = Target(target.x_m + target.vx_mps * dt_s, target.y_m + target.vy_mps * dt_s, target.vx_mps,
                             target.vy_mps, target.unseen_us + round(dt_s * 1e6), target.sightings)

    def _nearest(self, target: Target, pose: Pose, sightings: Sequence[Sighting]) -> Sighting | None:
        # The gate grows while the target is hidden, because its position becomes less certain.
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
            # The larger variances let this sighting move the estimate most of the way.
            velocity += _PUSHED_MPS**2
            position += (position + noise)
        gain, gain_velocity = position / (position + noise), both / (position + noise)
        self._variance = (position * (1 - gain), both * (1 - gain), velocity - gain_velocity * both)
        self.target = Target(target.x_m + gain * dx, target.y_m + gain * dy, target.vx_mps + gain_velocity * dx,
                             target.vy_mps + gain_velocity * dy, 0, target.sightings + 1)

    def _noise(self, sighting: Sighting) -> float:
        """Return the variance of one position. The range error grows with the square of the range."""
        # A partly hidden outline (low score) gives a less exact range.
        range_m2, score = sighting.x_m**2 + sighting.y_m**2, sighting.detection.score * sighting.exactness
        return float((self._config.range_noise * max(range_m2, 0.1) / max(score, 0.2) ** 2) ** 2)


def to_odometry(pose: Pose, x_m: float, y_m: float) -> tuple[float, float]:
    """Convert a point relative to the robot at `pose` to the odometry frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + cos * x_m - sin * y_m, pose[1] + sin * x_m + cos * y_m


def from_odometry(pose: Pose, x_m: float, y_m: float) -> tuple[float, float]:
    """Convert a point of the odometry frame to one relative to the robot at `pose`."""
    dx, dy = x_m - pose[0], y_m - pose[1]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return cos * dx + sin * dy, cos * dy - sin * dx
