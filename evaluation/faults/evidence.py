"""Compare the motor log and the event logs of a stop with the bounds. Pure except for the logs.

It trusts no software under test. The simulation stamps the motor log, and each sender stamps its event log.
"""

import itertools
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from sightline.evaluation.checks import Check, at_most
from sightline.protocol.clock import monotonic_us
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.robot_side.safety.limits import TICK_US

FALLS_MS: Final = 340.0
ZERO_MS: Final = 700.0
DISTANCE_M: Final = 0.25
OLD_US: Final = 400_000
"""The promise: no motion on an older frame. A literal, so that a changed default of the robot fails the rows."""
RAMPED_US: Final = 506_000
"""The promised age of a frame at which the ramp that it left behind is at its end. A literal, too."""
MEMORY_MB: Final = 5.0
_LEAVES_MAXIMUM: Final = 0.99
"""Speed counts as falling from where it leaves 99 % of its maximum for good."""
_FASTER_MPS: Final = 0.005
"""Smallest gain of speed. The conversion between wheel speed and twist rounds."""
_AT_REST_MPS: Final = 0.01
"""A wheel is at zero when its motor is set to zero and its rim moves slower than this: 2 % of top speed, as in the
bound that the robot computes."""
_RAMPED_OUT_US: Final = RAMPED_US + 2 * TICK_US
HELD_US: Final = 100_000
"""The robot sets its motors every 20 ms. In a pause of this length or longer, each tick counts as a line."""


@dataclass(frozen=True, slots=True)
class MotorRow:
    """One line of the motor log: commanded speeds, and true wheel angles."""

    t_us: int
    left_rad_s: float
    right_rad_s: float
    left_rad: float
    right_rad: float


@dataclass(frozen=True, slots=True)
class SentCommand:
    """One good command by its sender's log: send time, and capture time of its frame."""

    t_us: int
    frame_us: int


@dataclass(frozen=True, slots=True)
class Blind:
    """From `from_us` to `until_us` (None: to the end) no new command is based on a fresh frame.

    With `by_frame` this applies to captured frames: if only images are cut, one in flight may still be answered.
    """

    from_us: int
    until_us: int | None = None
    by_frame: bool = False

    def is_earlier(self, one: SentCommand) -> bool:
        """Return True for a command from before the fault."""
        return (one.frame_us if self.by_frame else one.t_us) <= self.from_us

    def hides(self, one: SentCommand, now_us: int) -> bool:
        """Return True if a command must not move the wheels at `now_us`."""
        return not self.is_earlier(one) and (self.until_us is None or now_us < self.until_us)


@dataclass(frozen=True, slots=True)
class Stop:
    """Figures counted from the last valid command. None: not within the window."""

    falls_ms: float | None
    zero_ms: float | None
    distance_m: float


def read_motors(text: str) -> list[MotorRow]:
    """Return the complete lines of `motors.csv`. A line that is still being written is left out."""
    lines = text.split("\n")[1:-1]
    parts = [line.split(",") for line in lines]
    return [MotorRow(int(t), float(left), float(right), float(a), float(b)) for t, left, right, a, b in parts]


def wheel_mps(row: MotorRow) -> float:
    """Return the commanded speed of the faster wheel at its rim, m/s."""
    return max(abs(row.left_rad_s), abs(row.right_rad_s)) * DiffDriveConfig().wheel_radius_m


def _rim_m(before: MotorRow, after: MotorRow) -> float:
    """Return the distance that the faster wheel rolls between two rows, m."""
    turned_rad = max(abs(after.left_rad - before.left_rad), abs(after.right_rad - before.right_rad))
    return turned_rad * DiffDriveConfig().wheel_radius_m


def _axle_m(before: MotorRow, after: MotorRow) -> float:
    """Return the distance that the midpoint of the axle moves between two rows, m."""
    turned_rad = (after.left_rad - before.left_rad + after.right_rad - before.right_rad) / 2
    return abs(turned_rad) * DiffDriveConfig().wheel_radius_m


def measure_stop(rows: Sequence[MotorRow], since_us: int, until_us: int | None = None) -> Stop:
    """Measure the stop after the last valid command at `since_us`, within the log up to `until_us`."""
    before = [row for row in rows if row.t_us <= since_us]
    after = [row for row in rows if row.t_us > since_us and (until_us is None or row.t_us <= until_us)]
    window = [*before[-1:], *after]
    if len(window) < 2:
        return Stop(None, None, 0.0)
    distance_m = sum(_axle_m(a, b) for a, b in itertools.pairwise(window))
    return Stop(_falls_ms(window, since_us), _zero_ms(window, since_us), distance_m)


def _falls_ms(window: Sequence[MotorRow], since_us: int) -> float | None:
    highest_mps = max(map(wheel_mps, window))
    if highest_mps == 0:
        return 0.0
    fast = [index for index, row in enumerate(window) if wheel_mps(row) >= _LEAVES_MAXIMUM * highest_mps]
    return _ms_after(window, fast[-1] + 1, since_us)


def _zero_ms(window: Sequence[MotorRow], since_us: int) -> float | None:
    commanded = [index for index, row in enumerate(window) if wheel_mps(row) > 0]
    spans = list(itertools.pairwise(_thinned(window)))
    rolling = [b.t_us for a, b in spans if _rim_m(a, b) > _AT_REST_MPS * (b.t_us - a.t_us) / 1e6]
    if not spans or rolling[-1:] == [spans[-1][1].t_us]:
        return None
    commanded_ms = _ms_after(window, max(commanded, default=-1) + 1, since_us)
    rolled_ms = ((end_us - since_us) / 1000 for end_us in rolling[-1:])
    return None if commanded_ms is None else max(commanded_ms, *rolled_ms, 0.0)


def _thinned(window: Sequence[MotorRow]) -> list[MotorRow]:
    """Return rows at least a tick apart: angles change with physics steps of 4 ms, rows come with commands."""
    kept = list(window[:1])
    for row in window:
        if row.t_us - kept[-1].t_us >= TICK_US:
            kept.append(row)
    return kept


def _ms_after(window: Sequence[MotorRow], index: int, since_us: int) -> float | None:
    return max(0.0, (window[index].t_us - since_us) / 1000) if index < len(window) else None


def last_valid_us(sent: Iterable[SentCommand], blind: Blind) -> int | None:
    """Return when the last command left that counted at the start of the blindness; None without one."""
    return max((one.t_us for one in sent if blind.is_earlier(one)), default=None)


def held_rows(rows: Sequence[MotorRow], from_us: int, until_us: int) -> list[MotorRow]:
    """Add a line for each tick of a pause in the log that begins at `from_us` or later; the log ends at `until_us`."""
    times_us = held_us([row.t_us for row in rows], from_us, until_us)
    return [replace(row, t_us=t_us) for row, each_us in zip(rows, times_us, strict=True) for t_us in each_us]


def held_us(lines_us: Sequence[int], from_us: int, until_us: int) -> Iterator[Sequence[int]]:
    """Yield for each line its own time, and each tick of a long pause after it, us.

    Motors keep the speed of the last command, so a robot that stops sending may drive on without a line.
    """
    for t_us, end_us in zip(lines_us, [*lines_us[1:], until_us], strict=False):
        is_held = t_us >= from_us and end_us - t_us > HELD_US
        yield range(t_us, end_us, TICK_US) if is_held else (t_us,)


def moved_on_old_sight(rows: Sequence[MotorRow], sent: Sequence[SentCommand], blind: Blind | None) -> int:
    """Count the log lines whose motion no young frame allows.

    If the newest frame of any valid command is older than 400 ms (and one tick, for which a decision holds), the
    wheels must not accelerate. Once the ramp must have ended, they must stand.
    """
    return sum(
        (age_us > OLD_US + TICK_US and wheel_mps(row) > wheel_mps(before) + _FASTER_MPS)
        or (age_us > _RAMPED_OUT_US and wheel_mps(row) > 0)
        for (before, row), age_us in zip(itertools.pairwise(rows), _ages_us(rows[1:], sent, blind), strict=True)
    )


def _ages_us(rows: Iterable[MotorRow], sent: Sequence[SentCommand], blind: Blind | None) -> Iterable[float]:
    """Return for each row the age of the youngest frame of a valid command so far, us."""
    ordered = sorted(sent, key=lambda one: one.t_us)
    for row in rows:
        frames = (
            one.frame_us for one in ordered
            if one.t_us <= row.t_us and not (blind and blind.hides(one, row.t_us))
        )
        yield row.t_us - max(frames, default=float("-inf"))


def most_gain_mps2(rows: Sequence[MotorRow], since_us: int, over_us: int = 100_000) -> float:
    """Return the largest change of a set wheel speed over `over_us`, at its rim, since `since_us`."""
    radius_m = DiffDriveConfig().wheel_radius_m
    late = [row for row in rows if row.t_us >= since_us]
    most, first = 0.0, 0
    for row in late:
        while row.t_us - late[first].t_us > over_us:
            first += 1
        change_rad_s = abs((row.left_rad_s + row.right_rad_s - late[first].left_rad_s - late[first].right_rad_s) / 2)
        most = max(most, change_rad_s * radius_m / (over_us / 1e6))
    return most


def stop_checks(stop: Stop, zero_ms: float = ZERO_MS, distance_m: float = DISTANCE_M) -> list[Check]:
    """Check the stop against its bounds."""
    return [
        at_most("falls", stop.falls_ms, "ms", min(FALLS_MS, zero_ms)),
        at_most("zero", stop.zero_ms, "ms", zero_ms),
        at_most("distance", stop.distance_m, "m", distance_m),
    ]


# The event logs of the bench's processes while they run: one line per event. Shell (files).
#
# `good,T_US,FRAME_US`    a command that the robot must apply was sent, citing the frame captured at FRAME_US
# `injected,T_US,0`       the fault was injected once more
# `requested,T_US,0`      a request of an operator was sent


GOOD: Final = "good"
INJECTED: Final = "injected"
FLOOD_AT_LEAST: Final = 20_000
"""Commands of a flood. It lasts longer if a process cannot send 10,000 a second."""
REQUESTED: Final = "requested"


class EventLog:
    """Appends events. A line is in the file when `note` returns."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def note(self, kind: str, frame_us: int = 0) -> None:
        """Append one event with the time now."""
        os.write(self._file, f"{kind},{monotonic_us()},{frame_us}\n".encode())


def read_events(path: Path, kind: str) -> list[SentCommand]:
    """Read the events of `kind`, oldest first, or none without a file."""
    if not path.exists():
        return []
    rows = [line.split(",") for line in path.read_text("ascii").split("\n")[:-1]]
    return [SentCommand(int(t), int(frame)) for what, t, frame in rows if what == kind]
