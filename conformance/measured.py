"""The motion that a robot measures, and the contents of its motor log, on the robot's clock. Pure.

`applied` is the command that a robot reports. Whether the wheels follow is visible in `moving` and `pose`, if
the robot publishes them, and in a motor log. A single reading above the tolerance is noise of an encoder, not motion.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Planar, Pose

STILL_MPS: Final = 0.03
"""Slower than this is not motion."""
STILL_RAD_S: Final = 0.15
_STEP_US: Final = 200_000
"""Two poses are compared over at least this time, so that a step of an encoder is not motion."""
_STEP_M: Final = 0.01
_STEP_RAD: Final = 0.05
_STILL_WHEEL_RAD_S: Final = 0.05
_CLOCKS_AGREE_US: Final = 10_000_000
"""A motor log has a row at least so close to the robot's newest status; else it is of another run."""


@dataclass(frozen=True, slots=True)
class MeasuredMotion:
    """One reading of a robot's motion. `moving` and `pose` are as in an odometry message."""

    t_us: int
    moving: Planar
    pose: Pose


@dataclass(frozen=True, slots=True)
class Evidence:
    """The robot moves at this time: `t_us` on its clock, with a description."""

    t_us: int
    words: str


def is_motion(moving: Planar) -> bool:
    """Return True unless a measured twist is within the noise of a robot at rest."""
    return abs(moving[0]) > STILL_MPS or abs(moving[1]) > STILL_RAD_S


def evidence_of(readings: Mapping[str, Sequence[MeasuredMotion]]) -> Iterator[Evidence]:
    """Yield each time at which readings prove motion. `readings` are by the channel that published them."""
    for channel, series in readings.items():
        yield from _by_speed(channel, series)
        yield from _by_pose(channel, series)


def _by_speed(channel: str, series: Sequence[MeasuredMotion]) -> Iterator[Evidence]:
    for one, then in pairwise(series):
        if is_motion(one.moving) and is_motion(then.moving):
            yield Evidence(one.t_us, f"`{channel}` measures {_words(one.moving)}")


def _by_pose(channel: str, series: Sequence[MeasuredMotion]) -> Iterator[Evidence]:
    first = 0
    for number, then in enumerate(series):
        while first + 1 < number and then.t_us - series[first + 1].t_us >= _STEP_US:
            first += 1
        one = series[first]
        seconds = (then.t_us - one.t_us) / 1e6
        if seconds < _STEP_US / 1e6:
            continue
        distance_m = math.dist(one.pose[:2], then.pose[:2])
        turned_rad = abs(math.remainder(then.pose[2] - one.pose[2], math.tau))
        if distance_m > _STEP_M or turned_rad > _STEP_RAD:
            change = f"{distance_m:.3f} m and {turned_rad:.2f} rad in {seconds:.1f} s"
            yield Evidence(one.t_us, f"`pose` in `{channel}` changes by {change}")


def _words(moving: Planar) -> str:
    return f"{moving[0]:.2f} m/s, {moving[1]:.2f} rad/s"


def mean_moving(readings: Mapping[str, Sequence[MeasuredMotion]]) -> Planar | None:
    """Return the mean measured twist, or None without a reading of motion."""
    all_moving = [one.moving for series in readings.values() for one in series]
    if not any(map(is_motion, all_moving)):
        return None
    linear, angular = (sum(axis) / len(all_moving) for axis in zip(*all_moving, strict=True))
    return linear, angular


def mean_travel(readings: Mapping[str, Sequence[MeasuredMotion]]) -> Planar | None:
    """Return the mean twist by the poses, m/s along the heading and rad/s, or None where the pose stands still."""
    for series in readings.values():
        if len(series) < 2 or series[-1].t_us - series[0].t_us < _STEP_US:
            continue
        seconds = (series[-1].t_us - series[0].t_us) / 1e6
        steps = [_step(one.pose, then.pose) for one, then in pairwise(series)]
        along_m, turned_rad = (sum(axis) for axis in zip(*steps, strict=True))
        if abs(along_m) > _STEP_M or abs(turned_rad) > _STEP_RAD:
            return along_m / seconds, turned_rad / seconds
    return None


def _step(one: Pose, then: Pose) -> tuple[float, float]:
    """Return the step in meters along the mean heading, and in radians."""
    turned_rad = math.remainder(then[2] - one[2], math.tau)
    heading_rad = one[2] + turned_rad / 2
    along_m = (then[0] - one[0]) * math.cos(heading_rad) + (then[1] - one[1]) * math.sin(heading_rad)
    return along_m, turned_rad


# --- a motor log -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class WheelRow:
    """One line of a motor log: from `t_us` on, the robot's clock, the wheels turn at these speeds."""

    t_us: int
    left_rad_s: float
    right_rad_s: float


def read_motor_log(text: str, name: str) -> list[WheelRow]:
    """Read `t_us,left_rad_s,right_rad_s` and any further columns; the last line may still be written.

    Raises ConfigError for another format.
    """
    rows: list[WheelRow] = []
    for number, line in enumerate(text.splitlines(keepends=True), 1):
        if not line.endswith("\n") or (number == 1 and line.startswith("t_us,")):
            continue
        try:
            t_us, left, right = line.split(",")[:3]
            rows.append(WheelRow(int(t_us), float(left), float(right)))
        except ValueError:
            raise ConfigError(f"invalid --motor-log {name}, line {number}: expected t_us,left_rad_s,right_rad_s; "
                              "name the file that the robot's drive writes") from None
    return rows


def check_motor_log(rows: Sequence[WheelRow], robot_t_us: int, robot: str, name: str) -> None:
    """Raise ConfigError unless the rows are of this run: `robot_t_us` is the time of the robot's newest status."""
    if not rows:
        raise ConfigError(f"--motor-log {name}: no rows; start robot {robot} with a drive that logs to this file")
    last_us = rows[-1].t_us
    if abs(robot_t_us - last_us) > _CLOCKS_AGREE_US:
        raise ConfigError(
            f"--motor-log {name}: its last row is of {last_us / 1e6:.1f} s on the robot's clock, robot {robot} is at "
            f"{robot_t_us / 1e6:.1f} s; name the log of this run"
        )


def evidence_in_log(rows: Sequence[WheelRow], now_us: int) -> Iterator[Evidence]:
    """Yield the end of each interval in which a wheel turns; the newest row holds until `now_us`."""
    ends = [row.t_us for row in rows[1:]] + [now_us]
    for row, end_us in zip(rows, ends, strict=True):
        if max(abs(row.left_rad_s), abs(row.right_rad_s)) > _STILL_WHEEL_RAD_S:
            words = f"the motor log has wheels at {row.left_rad_s:.2f}, {row.right_rad_s:.2f} rad/s"
            yield Evidence(max(row.t_us, end_us - 1), words)
