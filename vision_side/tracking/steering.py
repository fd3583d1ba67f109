"""Map bearing and distance to a twist (feed-forward and PI), and turn to search. Pure.

Each axis is feed-forward from the motion of target and robot, plus PI on the remaining error. The time step comes from
capture times. Gains shrink as latency grows, and the integrals shrink by the part that the robot did not apply.
"""

import math
from dataclasses import dataclass

from sightline.protocol.messages import Planar, Pose, Twist
from sightline.vision_side.config import SearchConfig, SteerConfig


@dataclass(frozen=True, slots=True)
class Aim:
    """The target relative to the lens at the time when the command acts.

    Args:
        x_m: forward.
        y_m: left.
        vx_mps: velocity over the floor, forward.
        vy_mps: velocity over the floor, left.
        lens_x_m: distance of the lens ahead of the axle; a turn moves the lens sideways.
    """

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    lens_x_m: float = 0.0

    @property
    def bearing_rad(self) -> float:
        """Return the bearing, left positive."""
        return math.atan2(self.y_m, self.x_m)

    @property
    def distance_m(self) -> float:
        """Return the distance over the floor from the lens."""
        return math.hypot(self.x_m, self.y_m)


class Steer:
    """The controllers of speed and turn rate, with their integrals."""

    def __init__(self, config: SteerConfig, stand_off_m: float) -> None:
        self._config = config
        self._stand_off_m = stand_off_m
        self._integral = (0.0, 0.0)  # m/s, rad/s

    def reset(self) -> None:
        """Reset the integrals after the loss or a change of the target."""
        self._integral = (0.0, 0.0)

    def unmet(self, dt_s: float, linear_mps: float, angular_rad_s: float) -> None:
        """Reduce the integrals by the part of the command that the robot did not apply (anti-windup by
        back-calculation).

        Args:
            dt_s: time since the last frame.
            linear_mps: applied minus commanded speed.
            angular_rad_s: applied minus commanded turn rate.
        """
        # At most the whole difference. With more, a long pause between frames would reverse the integrals.
        share = min(1.0, self._config.back_calculation_hz * dt_s)
        self._add(share * linear_mps, share * angular_rad_s)

    def step(self, dt_s: float, aim: Aim, latency_s: float, may_drive: bool) -> Twist:
        """Compute the twist that keeps the target ahead and at the stand-off.

        Args:
            dt_s: time since the last frame.
            aim: predicted target.
            latency_s: capture to wheels; it limits the gains.
            may_drive: False to turn only.
        """
        config, bearing, distance = self._config, aim.bearing_rad, max(aim.distance_m, 0.05)
        cos, sin = aim.x_m / distance, aim.y_m / distance
        kp_distance = _damped(config.distance_kp, latency_s, config.max_gain_latency)
        kp_bearing = _damped(config.bearing_kp, latency_s, config.max_gain_latency)
        error_m = distance - self._stand_off_m
        receding = aim.vx_mps * cos + aim.vy_mps * sin
        linear = receding + kp_distance * error_m + self._integral[0]
        driven = self._limited(linear * self._fade(bearing)) if may_drive else 0.0
        # The sideways motion of the target, plus that of the robot's own speed, is the feed-forward of the bearing.
        crossing = aim.vy_mps * cos - aim.vx_mps * sin
        wanted = (crossing + driven * sin) / distance + kp_bearing * bearing + self._integral[1]
        # A turn moves the lens sideways too, so a smaller turn rate gives the wanted change of bearing.
        angular = wanted / (1 + aim.lens_x_m * cos / distance)
        turned = _bounded(angular, config.max_angular_rad_s)
        self._integrate(dt_s, (error_m if may_drive else 0.0, bearing), (driven - linear if may_drive else 0.0,
                                                                        turned - angular))
        return Twist(linear_mps=driven, angular_rad_s=turned)

    def _integrate(self, dt_s: float, error: tuple[float, float], cut: tuple[float, float]) -> None:
        """Advance both integrals by their error, and by the part that the limits removed (back-calculation)."""
        config = self._config
        self._add(dt_s * (config.distance_ki * error[0] + config.back_calculation_hz * cut[0]),
                  dt_s * (config.bearing_ki * error[1] + config.back_calculation_hz * cut[1]))

    def _add(self, linear_mps: float, angular_rad_s: float) -> None:
        self._integral = (_bounded(self._integral[0] + linear_mps, self._config.integral_linear_mps),
                          _bounded(self._integral[1] + angular_rad_s, self._config.integral_angular_rad_s))

    def _fade(self, bearing_rad: float) -> float:
        """Return the speed share: 1 straight ahead, 0 from `drive_within_rad` on, so that it turns before it drives."""
        return max(0.0, 1.0 - (bearing_rad / self._config.drive_within_rad) ** 2)

    def _limited(self, linear_mps: float) -> float:
        return max(-self._config.max_reverse_mps, min(self._config.max_linear_mps, linear_mps))


def _damped(gain: float, latency_s: float, max_gain_latency: float) -> float:
    """Limit a gain by the latency, because a high gain with a long delay oscillates."""
    return min(gain, max_gain_latency / max(latency_s, 1e-3))


def _bounded(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))


# The bounded search: turn on the spot after "detected nothing", toward the side where the target was last seen. Pure.
#
# Only decoded images without a target count. The measured turn uses up the limit, so a disarmed robot keeps its search.
# If the robot turned and then stands, an obstacle blocks it, and it turns the other way.


_BLOCKED_S = 1.0
_TURNED_RAD = 0.1


class Search:
    """One search. Call `reset` when the target is detected."""

    def __init__(self, config: SearchConfig) -> None:
        self._config = config
        self._side = 1.0
        self.reset(self._side)

    def reset(self, side: float) -> None:
        """Start the next search from the beginning, to the left for a positive `side`."""
        self._side = math.copysign(1.0, side)
        self._nothing_s = self._turning_s = self._turned_rad = 0.0
        self._standing_s = self._one_way_rad = 0.0
        self._yaw_rad: float | None = None

    def step(self, dt_s: float, pose: Pose, applied: Planar) -> Twist | None:
        """Compute the twist for one more image without the target.

        Args:
            dt_s: time since the last frame.
            pose: odometry, m, m, rad.
            applied: twist on the wheels, m/s, rad/s.

        Returns:
            The turn, or None before the waiting time and after the limit.
        """
        self._spend(dt_s, pose[2], applied[1])
        config = self._config
        spent = self._turned_rad >= config.max_turn_rad or self._turning_s >= config.max_turning_s
        if not config.enabled or spent or self._nothing_s < config.after_s:
            return None
        return Twist(linear_mps=0.0, angular_rad_s=self._side * config.rate_rad_s)

    def _spend(self, dt_s: float, yaw_rad: float, applied_rad_s: float) -> None:
        before = yaw_rad if self._yaw_rad is None else self._yaw_rad
        turned_rad = abs(math.remainder(yaw_rad - before, 2 * math.pi))
        self._turned_rad += turned_rad
        self._yaw_rad = yaw_rad
        self._nothing_s += dt_s
        is_turning = abs(applied_rad_s) > 1e-3
        self._turning_s += dt_s if is_turning else 0.0
        self._standing_s = 0.0 if is_turning else self._standing_s + dt_s
        self._one_way_rad += turned_rad
        # A disarmed robot stands, too, but it has not turned.
        if self._standing_s >= _BLOCKED_S and self._one_way_rad >= _TURNED_RAD:
            self._side, self._one_way_rad = -self._side, 0.0
