"""Differential drive: twist <-> wheel speeds, saturation that preserves the curve, odometry, encoder checks. Pure."""

import math
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, Planar, Pose, Twist
from sightline.robot_side.ports import WheelAngles

_RATE_WINDOW_US = 40_000  # shortest time for a speed: one encoder step in 20 ms is already 0.2 rad/s


class DiffDriveConfig(Config):
    """Geometry of a two-wheeled robot. The defaults are the Raspberry Pi class robot of the simulation."""

    wheel_radius_m: Annotated[float, Field(gt=0.005, lt=1.0)] = 0.035
    """Radius of the driven wheels."""
    track_width_m: Annotated[float, Field(gt=0.02, lt=3.0)] = 0.174
    """Distance between the two driven wheels."""
    max_wheel_rad_s: Annotated[float, Field(gt=0.1, lt=500.0)] = 22.0
    """Highest wheel speed; a faster twist is scaled so that its curve stays the same."""


def wheel_speeds(drive: DiffDriveConfig, twist: Twist) -> tuple[float, float]:
    """Return (left, right) rad/s for `twist`. Above `max_wheel_rad_s` one factor scales both, so the curve stays."""
    half_turn_mps = twist.angular_rad_s * drive.track_width_m / 2
    left = (twist.linear_mps - half_turn_mps) / drive.wheel_radius_m
    right = (twist.linear_mps + half_turn_mps) / drive.wheel_radius_m
    excess = max(abs(left), abs(right)) / drive.max_wheel_rad_s
    return (left / excess, right / excess) if excess > 1 else (left, right)


def twist_of(drive: DiffDriveConfig, left_rad_s: float, right_rad_s: float) -> Twist:
    """Return the twist of two wheel speeds, the inverse of `wheel_speeds` without its saturation."""
    left_mps, right_mps = left_rad_s * drive.wheel_radius_m, right_rad_s * drive.wheel_radius_m
    return Twist(linear_mps=(left_mps + right_mps) / 2, angular_rad_s=(right_mps - left_mps) / drive.track_width_m)


def check_finite(wheels: WheelAngles) -> None:
    """Raise ValueError for an angle that is not finite."""
    if not (math.isfinite(wheels.left_rad) and math.isfinite(wheels.right_rad)):
        raise ValueError(f"invalid wheel angles ({wheels.left_rad}, {wheels.right_rad}): not finite")


class Odometer:
    """Dead reckoning from wheel angles: exact for arcs of constant curvature between two readings."""

    def __init__(self, drive: DiffDriveConfig) -> None:
        self._drive = drive
        self._x_m = self._y_m = self._yaw_rad = 0.0
        self._last: WheelAngles | None = None
        self._rate_from: WheelAngles | None = None
        self._moving = STILL

    @property
    def pose(self) -> Pose:
        """Return (x_m, y_m, yaw_rad) since the start; yaw within +-pi."""
        return self._x_m, self._y_m, math.remainder(self._yaw_rad, math.tau)

    @property
    def moving(self) -> Planar:
        """Return (linear_mps, angular_rad_s), averaged over at least the last 40 ms."""
        return self._moving.linear_mps, self._moving.angular_rad_s

    def update(self, wheels: WheelAngles) -> None:
        """Process one reading. A reading that is not newer than the last one is ignored.

        Raises:
            ValueError: an angle is not finite.
        """
        check_finite(wheels)
        if self._last is None or self._rate_from is None:
            self._last = self._rate_from = wheels
            return
        if wheels.t_us <= self._last.t_us:
            return
        self._advance(wheels.left_rad - self._last.left_rad, wheels.right_rad - self._last.right_rad)
        self._last = wheels
        self._update_rate(wheels)

    def restart(self, wheels: WheelAngles) -> None:
        """Continue at the same pose from this reading. The difference to earlier readings does not count."""
        self._last = self._rate_from = wheels

    def _advance(self, left_rad: float, right_rad: float) -> None:
        arc = twist_of(self._drive, left_rad, right_rad)  # angles instead of speeds: meters and radians, not per second
        half = arc.angular_rad_s / 2
        chord_m = arc.linear_mps * (math.sin(half) / half if half else 1.0)
        self._x_m += chord_m * math.cos(self._yaw_rad + half)
        self._y_m += chord_m * math.sin(self._yaw_rad + half)
        self._yaw_rad += arc.angular_rad_s

    def _update_rate(self, wheels: WheelAngles) -> None:
        start = self._rate_from
        if start is None or wheels.t_us - start.t_us < _RATE_WINDOW_US:
            return
        seconds = (wheels.t_us - start.t_us) / 1e6
        left, right = (wheels.left_rad - start.left_rad) / seconds, (wheels.right_rad - start.right_rad) / seconds
        self._moving = twist_of(self._drive, left, right)
        self._rate_from = wheels


_COMPARED_US = 2_000_000
"""After this time and a turn in one direction a wheel is compared: its motor lags, and an encoder may be slow."""
_LEAST_SHARE = 0.1
_SIDES = "left", "right"
_AT_ONCE_US, _STEP_RAD = 100_000, 0.5
"""A drive may return a reading of up to 100 ms before with a new time; a coarse encoder has a dozen steps a turn."""

_AGED_US = 1_000_000  # a new reading is younger; an older one has another clock, or the unit of another clock
_LATEST_US = 100_000  # between two calls; a robot that was suspended for longer commanded nothing meanwhile


class WheelMonitor:
    """Compares the encoder of one wheel with its commanded speed."""

    jumped: bool
    """True if the last reading was further from the one before than a wheel can turn. `look` sets it."""

    def __init__(self, max_rad_s: float) -> None:
        """Begin. `max_rad_s`: highest commanded speed. Pushed or downhill, a wheel may be twice as fast."""
        self._max_rad_s = 2 * max_rad_s
        self._last: tuple[float, int] | None = None
        self._from_rad = self._commanded_rad = self._unseen_rad = 0.0
        self._since_us = 0

    def look(self, commanded_rad: float, angle_rad: float, t_us: int, now_us: int) -> str:
        """Return what is doubtful, or "".

        Args:
            commanded_rad: commanded since the last call, rad.
            angle_rad: angle of the encoder, rad.
            t_us: time of this reading.
            now_us: time on the robot's clock.
        """
        last_rad, last_us = self._last or (angle_rad, t_us)
        self._last = (angle_rad, t_us) if t_us > last_us or self._last is None else self._last
        step_rad, step_us = abs(self._last[0] - last_rad), max(self._last[1] - last_us, _AT_ONCE_US)
        self._commanded_rad += commanded_rad
        # A slow encoder whose old readings have new times turns at once by what was commanded since its last change.
        self._unseen_rad += abs(commanded_rad)
        self.jumped = step_rad > max(self._max_rad_s * step_us / 1e6, 2 * self._unseen_rad) + _STEP_RAD
        self._unseen_rad *= step_rad == 0
        doubt = f"jumped by {step_rad:.3g} rad; look for a loose wire, or a counter that wraps" if self.jumped else ""
        if not doubt and now_us - self._since_us >= _COMPARED_US and abs(self._commanded_rad) >= math.tau:
            doubt = self._compared(self._last[0] - self._from_rad)
            self._unseen_rad *= not doubt
        elif not doubt and commanded_rad * self._commanded_rad > 0:
            return ""
        self._since_us, self._from_rad, self._commanded_rad = now_us, self._last[0], 0.0
        return doubt

    def _compared(self, turned_rad: float) -> str:
        share = turned_rad / self._commanded_rad
        if share >= _LEAST_SHARE:
            return ""
        fix = "are the wires of motor or encoder swapped?" if share <= -_LEAST_SHARE else (
            "is it blocked, its motor or encoder loose, or the speed too low for it?")
        return f"turned {turned_rad:.3g} rad where {self._commanded_rad:.3g} rad were commanded; {fix}"


class EncoderMonitor:
    """Names a wheel whose encoder jumps, stands still while it is commanded, or runs backwards, and a wrong clock."""

    def __init__(self, drive: DiffDriveConfig) -> None:
        self._monitors = WheelMonitor(drive.max_wheel_rad_s), WheelMonitor(drive.max_wheel_rad_s)
        self._looked_us: int | None = None
        self._read_us = math.inf

    @property
    def jumped(self) -> bool:
        """Return True if a wheel of the last reading jumped."""
        return any(monitor.jumped for monitor in self._monitors)

    def look(self, speeds: tuple[float, float], wheels: WheelAngles, now_us: int) -> str:
        """Return what is doubtful, with the side, or "".

        Args:
            speeds: (left, right) commanded since the last call, rad/s.
            wheels: newest reading; finite.
            now_us: time on the robot's clock.
        """
        seconds = 0.0 if self._looked_us is None else min(now_us - self._looked_us, _LATEST_US) / 1e6
        self._looked_us = now_us
        angles = wheels.left_rad, wheels.right_rad
        doubts = [f"{side} wheel {doubt}"
                  for side, monitor, speed, angle_rad in zip(_SIDES, self._monitors, speeds, angles, strict=True)
                  if (doubt := monitor.look(speed * seconds, angle_rad, wheels.t_us, now_us))]
        if self._read_us < wheels.t_us < now_us - _AGED_US:
            age_s = (now_us - wheels.t_us) / 1e6
            doubts.append(f"a new reading of the wheels is {age_s:.3g} s old; take the robot's clock, in microseconds")
        self._read_us = wheels.t_us
        return "; ".join(doubts)
