"""The limits of the gate, the ramp that applies them, and the stopping bound that follows from them. Pure."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Self

from pydantic import Field, model_validator

from sightline.protocol.messages import STILL, Twist
from sightline.robot_side.safety.battery import BatteryLimits

# Longest time between two ticks of the driver.
TICK_US = 20_000
# Shortest time between two ticks for commands. The driver also ticks when a command arrives, but a flood of commands
# must not flood the motors.
MIN_TICK_US = 2_000
STOP_TIME_BOUND_US = 700_000
STOP_DISTANCE_BOUND_M = 0.25

# Share of the top speed below which the robot counts as at rest.
_AT_REST = 0.02
_LONGEST_STEP_US = 1_000_000
# Largest twist that is scaled, m/s or rad/s. The ratio of a larger one to the limit could be infinite, the result zero.
_LARGEST = 1e6

Millis = Annotated[int, Field(ge=20, le=5_000)]


class SafetyConfig(BatteryLimits):
    """Limits and times of the gate. Values that imply a stop above 700 ms or 0.25 m are rejected."""

    max_linear_mps: float = Field(default=0.5, gt=0, le=3.0, description="forward speed, at most")
    max_angular_rad_s: float = Field(default=2.5, gt=0, le=10.0, description="turn rate, at most")
    max_acceleration_mps2: float = Field(default=2.0, gt=0, le=20.0, description="change of speed, also when braking")
    max_acceleration_rad_s2: float = Field(default=12.0, gt=0, le=100.0, description="change of turn rate")
    max_jerk_mps3: float = Field(default=20.0, gt=0, le=500.0, description="change of acceleration")
    max_jerk_rad_s3: float = Field(default=200.0, gt=0, le=2000.0, description="change of angular acceleration")
    motor_lag_ms: int = Field(
        default=50, ge=0, le=500, description="first-order lag of the motors, for the stopping bound only"
    )

    full_speed_age_ms: Millis = Field(default=150, description="frame age up to which the full speed limit holds")
    zero_speed_age_ms: Millis = Field(
        default=400, description="the limit falls linearly to zero at this frame age; older is rejected as `STALE`"
    )
    silence_ms: Millis = Field(default=300, description="no accepted command for this long: HOLD")
    lease_ms: Millis = Field(
        default=1_000, description="the driver loses the lease after this long without a command; at least `silence_ms`"
    )
    disarm_after_hold_s: float = Field(default=10.0, ge=1, le=600, description="from HOLD to DISARMED")
    live_commands_to_arm: int = Field(
        default=5, ge=1, le=100, description="valid commands in a row that the driver needs before arming"
    )
    auto_arm: bool = Field(default=False, description="arm without an operator after these commands; for simulation")

    guests: bool = Field(default=False, description="accept commands without a header, on `twist/guest`")
    guest_life_ms: Millis = Field(default=250, description="a guest's command ends this long after its arrival")
    guest_max_linear_mps: float = Field(default=0.2, gt=0, le=3.0, description="forward speed of a guest, at most")
    guest_max_angular_rad_s: float = Field(default=1.0, gt=0, le=10.0, description="turn rate of a guest, at most")
    guest_unchanged_ms: Millis = Field(
        default=2_000, description="a guest that repeats one command for this long holds: it names no image, so that "
        "only a changed command shows a new one"
    )
    guest_unchanged_m: float = Field(
        default=0.25, gt=0, le=5.0, description="the same after this distance, equal to that of a stop from 0.5 m/s"
    )

    @model_validator(mode="after")
    def _stops_in_time(self) -> Self:
        if self.full_speed_age_ms >= self.zero_speed_age_ms:
            raise ValueError("full_speed_age_ms must be below zero_speed_age_ms")
        if self.lease_ms < self.silence_ms:
            raise ValueError("lease_ms must be at least silence_ms, so that no command is in force without its driver")
        # The bound follows from the values, so a robot that brakes slowly needs a lower top speed.
        bound = stop_bound(self)
        if bound.zero_us > STOP_TIME_BOUND_US or bound.distance_m > STOP_DISTANCE_BOUND_M:
            raise ValueError(
                f"with these limits the robot stops {bound.zero_us // 1000} ms and {bound.distance_m:.3f} m after its "
                f"last command; allowed are {STOP_TIME_BOUND_US // 1000} ms and {STOP_DISTANCE_BOUND_M} m. Lower "
                "max_linear_mps, max_angular_rad_s, full_speed_age_ms or silence_ms, or raise accelerations and jerks "
                "if the robot brakes faster"
            )
        return self

    @property
    def max_age_us(self) -> int:
        """Return the age in us of the oldest frame that a command may cite."""
        return self.zero_speed_age_ms * 1000


def age_factor(config: SafetyConfig, age_us: int) -> float:
    """Return the share of the speed limit that a frame of this age permits.

    Args:
        config: `full_speed_age_ms` and `zero_speed_age_ms`.
        age_us: frame age, us.

    Returns:
        1 up to the first age, then falling linearly to 0 at the second.
    """
    full_us, zero_us = config.full_speed_age_ms * 1000, config.zero_speed_age_ms * 1000
    return min(1.0, max(0.0, (zero_us - age_us) / (zero_us - full_us)))


def clamp_twist(twist: Twist, max_linear_mps: float, max_angular_rad_s: float) -> Twist:
    """Scale both axes by one factor until both limits hold, so that the curve stays the same."""
    if max_linear_mps <= 0 or max_angular_rad_s <= 0:
        return STILL
    linear, angular = (max(-_LARGEST, min(_LARGEST, speed)) for speed in (twist.linear_mps, twist.angular_rad_s))
    excess = max(1.0, abs(linear) / max_linear_mps, abs(angular) / max_angular_rad_s)
    if excess == 1.0:
        return twist
    return Twist(linear_mps=linear / excess, angular_rad_s=angular / excess)


class AxisRamp:
    """Moves one speed to its goal within limits of acceleration and jerk, without overshoot."""

    def __init__(self, max_acceleration: float, max_jerk: float) -> None:
        self._max_acceleration = max_acceleration
        self._max_jerk = max_jerk
        self.speed = 0.0
        self._acceleration = 0.0

    def force(self, speed: float) -> None:
        """Continue from `speed`, after a stronger limit has set it."""
        self.speed, self._acceleration = speed, 0.0

    def step(self, goal: float, dt_s: float) -> float:
        """Advance toward `goal`.

        Args:
            goal: m/s or rad/s.
            dt_s: elapsed time, at most one slice, s.

        Returns:
            The new speed.
        """
        error = goal - self.speed
        # The jerk limit never delays the end of an acceleration away from the goal, so braking starts immediately.
        if self._acceleration * error < 0:
            self._acceleration = 0.0
        # The largest acceleration that still returns to zero within the jerk limit when the goal is reached. A larger
        # one would overshoot.
        wanted = math.copysign(min(self._max_acceleration, math.sqrt(2 * self._max_jerk * abs(error))), error)
        change = max(-self._max_jerk * dt_s, min(self._max_jerk * dt_s, wanted - self._acceleration))
        self._acceleration += change
        moved = self._acceleration * dt_s
        # The last step lands exactly on the goal. Otherwise the speed would oscillate around it.
        reach = min(self._max_jerk * dt_s, self._max_acceleration) * dt_s
        if abs(error) <= max(abs(moved), reach):
            self.speed, self._acceleration = goal, 0.0
        else:
            self.speed += moved
        return self.speed


class Ramp:
    """Ramps both axes per elapsed time."""

    def __init__(self, config: SafetyConfig) -> None:
        self._linear = AxisRamp(config.max_acceleration_mps2, config.max_jerk_mps3)
        self._angular = AxisRamp(config.max_acceleration_rad_s2, config.max_jerk_rad_s3)

    def step(self, goal: Twist, elapsed_us: int) -> Twist:
        """Advance both axes.

        Args:
            goal: m/s and rad/s.
            elapsed_us: time since the last step, us.

        Returns:
            The twist to apply now.
        """
        # A late step is cut into slices, so that the speed changes exactly as with steps in time. A bound limits the
        # time of one call after a long pause.
        left_us = min(elapsed_us, _LONGEST_STEP_US)
        while left_us > 0:
            slice_us = min(left_us, TICK_US)
            self._linear.step(goal.linear_mps, slice_us / 1e6)
            self._angular.step(goal.angular_rad_s, slice_us / 1e6)
            left_us -= slice_us
        return Twist(linear_mps=self._linear.speed, angular_rad_s=self._angular.speed)

    def force(self, twist: Twist) -> None:
        """Continue from `twist`, after a stronger limit has set it."""
        self._linear.force(twist.linear_mps)
        self._angular.force(twist.angular_rad_s)


@dataclass(frozen=True, slots=True)
class StopBound:
    """The stop after the last valid command at top speed: when the set speed starts to fall (`falls_us`), when it is
    zero (`ramped_us`), when the wheels stand (`zero_us`), and the distance until then."""

    falls_us: int
    ramped_us: int
    zero_us: int
    distance_m: float


@lru_cache(maxsize=64)  # 5 ms for each configuration, and a process builds the same configuration several times
def stop_bound(config: SafetyConfig) -> StopBound:
    """Compute the stop of `config` with its own ramp, for the worst case, a command on a frame of age zero.

    The driver steps the ramp each TICK_US, or as often as each MIN_TICK_US while commands arrive. The worse result of
    both counts, because the ramp is slower in short steps.
    """
    long, short = _stop(config, TICK_US), _stop(config, MIN_TICK_US)
    return StopBound(
        max(long.falls_us, short.falls_us), max(long.ramped_us, short.ramped_us), max(long.zero_us, short.zero_us),
        max(long.distance_m, short.distance_m),
    )


def _stop(config: SafetyConfig, step_us: int) -> StopBound:
    """Simulate the stop with a ramp that is stepped every `step_us`.

    The result contains one tick for the phase of the driver's loop and the lag of the motors. `zero_us` is the time at
    which the ramp is at zero and the robot is below 2 % of its top speed and its top turn rate.
    """
    ramp, top = Ramp(config), Twist(linear_mps=config.max_linear_mps, angular_rad_s=config.max_angular_rad_s)
    ramp.force(top)
    lag_s = config.motor_lag_ms / 1000
    lags_on = math.exp(-step_us / 1e6 / lag_s) if lag_s else 0.0
    now_us, falls_us, ramped_us, distance_m = 0, 0, 0, 0.0
    twist, wheels_mps, turning_rad_s = top, top.linear_mps, top.angular_rad_s
    while now_us < 2 * _LONGEST_STEP_US and (
        twist != STILL or wheels_mps > _AT_REST * top.linear_mps or turning_rad_s > _AT_REST * top.angular_rad_s
    ):
        now_us += step_us
        # The worst case is a command on a frame captured at its arrival: both age and silence count from then.
        factor = age_factor(config, now_us) if now_us <= config.silence_ms * 1000 else 0.0
        twist = ramp.step(clamp_twist(top, factor * top.linear_mps, factor * top.angular_rad_s), step_us)
        falls_us = falls_us or (now_us if twist.linear_mps < top.linear_mps else 0)
        ramped_us = ramped_us or (now_us if twist == STILL else 0)
        before_mps, wheels_mps = wheels_mps, twist.linear_mps + (wheels_mps - twist.linear_mps) * lags_on
        turning_rad_s = twist.angular_rad_s + (turning_rad_s - twist.angular_rad_s) * lags_on
        # Exact integral of a first-order lag over one step with constant input.
        distance_m += twist.linear_mps * step_us / 1e6 + (before_mps - wheels_mps) * lag_s
    distance_m += top.linear_mps * TICK_US / 1e6
    return StopBound(falls_us + TICK_US, (ramped_us or now_us) + TICK_US, now_us + TICK_US, distance_m)
