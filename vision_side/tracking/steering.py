"""Bearing and distance to a twist (feed-forward and PI), and the search turn. Pure.

Each axis is feed-forward (what the target's and the robot's motion ask for) plus PI on what is left. dt comes from
capture times, gains shrink as latency grows, and integrals give way to whatever the robot did not carry out.
"""

import math
from dataclasses import dataclass

from sightline.protocol.messages import Planar, Pose, Twist
from sightline.vision_side.config import SearchConfig, SteerConfig


@dataclass(frozen=True, slots=True)
class Aim:
    """The target about the lens, at the time the command will act; its velocity over the floor, along x and y.

    `lens_x_m` is how far the lens is ahead of the axle: turning carries it sideways.
    """

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    lens_x_m: float = 0.0

    @property
    def bearing_rad(self) -> float:
        """Left positive."""
        return math.atan2(self.y_m, self.x_m)

    @property
    def distance_m(self) -> float:
        """Over the floor, from the lens."""
        return math.hypot(self.x_m, self.y_m)


class Steer:
    """The two controllers and their integrals."""

    def __init__(self, config: SteerConfig, stand_off_m: float) -> None:
        self._config = config
        self._stand_off_m = stand_off_m
        self._integral = (0.0, 0.0)  # m/s, rad/s

    def reset(self) -> None:
        """Forget the integrals: the target changed or was lost."""
        self._integral = (0.0, 0.0)

    def unmet(self, dt_s: float, linear_mps: float, angular_rad_s: float) -> None:
        """Back-calculation: bleed the integrals by what was asked for and not applied (applied less asked)."""
        share = min(1.0, self._config.back_calculation_hz * dt_s)
        self._add(share * linear_mps, share * angular_rad_s)

    def step(self, dt_s: float, aim: Aim, latency_s: float, may_drive: bool) -> Twist:
        """The twist that keeps the target ahead and at the stand-off; only turns unless `may_drive`."""
        config, bearing, distance = self._config, aim.bearing_rad, max(aim.distance_m, 0.05)
        cos, sin = aim.x_m / distance, aim.y_m / distance
        kp_distance = _damped(config.distance_kp, latency_s, config.max_gain_latency)
        kp_bearing = _damped(config.bearing_kp, latency_s, config.max_gain_latency)
        error_m = distance - self._stand_off_m
        receding = aim.vx_mps * cos + aim.vy_mps * sin
        linear = receding + kp_distance * error_m + self._integral[0]
        driven = self._limited(linear * self._fade(bearing)) if may_drive else 0.0
        crossing = aim.vy_mps * cos - aim.vx_mps * sin
        wanted = (crossing + driven * sin) / distance + kp_bearing * bearing + self._integral[1]
        angular = wanted / (1 + aim.lens_x_m * cos / distance)
        turned = _bounded(angular, config.max_angular_rad_s)
        self._integrate(dt_s, (error_m if may_drive else 0.0, bearing), (driven - linear if may_drive else 0.0,
                                                                        turned - angular))
        return Twist(linear_mps=driven, angular_rad_s=turned)

    def _integrate(self, dt_s: float, error: tuple[float, float], cut: tuple[float, float]) -> None:
        """Advance both integrals by their error and, back-calculation, by what the limits cut off."""
        config = self._config
        self._add(dt_s * (config.distance_ki * error[0] + config.back_calculation_hz * cut[0]),
                  dt_s * (config.bearing_ki * error[1] + config.back_calculation_hz * cut[1]))

    def _add(self, linear_mps: float, angular_rad_s: float) -> None:
        self._integral = (_bounded(self._integral[0] + linear_mps, self._config.integral_linear_mps),
                          _bounded(self._integral[1] + angular_rad_s, self._config.integral_angular_rad_s))

    def _fade(self, bearing_rad: float) -> float:
        """1 straight ahead, 0 from `drive_within_rad` on: first turn, then drive."""
        return max(0.0, 1.0 - (bearing_rad / self._config.drive_within_rad) ** 2)

    def _limited(self, linear_mps: float) -> float:
        return max(-self._config.max_reverse_mps, min(self._config.max_linear_mps, linear_mps))


def _damped(gain: float, latency_s: float, max_gain_latency: float) -> float:
    """`gain`, or as much of it as the latency allows."""
    return min(gain, max_gain_latency / max(latency_s, 1e-3))


def _bounded(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


# Bounded search: turn on the spot after "saw nothing", towards the side last seen. Pure.
#
# Only pictures that were decoded and held nothing are counted; no picture means no search. The budget is spent by
# turning, as odometry shows it: a disarmed robot keeps its whole search for when it may move.


class Search:
    """One search; `reset` when the target was seen."""

    def __init__(self, config: SearchConfig) -> None:
        self._config = config
        self._side = 1.0
        self.reset(self._side)

    def reset(self, side: float) -> None:
        """Start afresh next time, turning left for a positive `side`."""
        self._side = math.copysign(1.0, side)
        self._nothing_s = self._turning_s = self._turned_rad = 0.0
        self._yaw_rad: float | None = None

    def step(self, dt_s: float, pose: Pose, applied: Planar) -> Twist | None:
        """The twist for one more picture without the target; None when it is too early or the budget is spent."""
        self._spend(dt_s, pose[2], applied[1])
        config = self._config
        spent = self._turned_rad >= config.max_turn_rad or self._turning_s >= config.max_turning_s
        if not config.enabled or spent or self._nothing_s < config.after_s:
            return None
        return Twist(linear_mps=0.0, angular_rad_s=self._side * config.rate_rad_s)

    def _spend(self, dt_s: float, yaw_rad: float, applied_rad_s: float) -> None:
        before = yaw_rad if self._yaw_rad is None else self._yaw_rad
        self._turned_rad += abs(math.remainder(yaw_rad - before, 2 * math.pi))
        self._yaw_rad = yaw_rad
        self._nothing_s += dt_s
        self._turning_s += dt_s if abs(applied_rad_s) > 1e-3 else 0.0
