"""What a robot's wheels were told, as its log drive notes it, held against when something was harmed. Pure."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

from sightline.robot_side.safety.limits import TICK_US, SafetyConfig, stop_bound

_LATE_US: Final = 2 * TICK_US
"""A decision holds for a tick; who notes a twist may hear it a little after the robot."""
_OLD_US: Final = SafetyConfig().zero_speed_age_ms * 1000 + _LATE_US
_RAMPED_OUT_US: Final = (stop_bound(SafetyConfig()).ramped_us + 2 * _LATE_US) // TICK_US * TICK_US
"""Age of a frame, in whole ticks, at which even the ramp that it left behind is at its end; its answer and the zero may
both be late."""
_FASTER_RAD_S: Final = 0.15
"""Less is no gain of speed: turning a twist into wheel speeds rounds."""


class WheelCommand(NamedTuple):
    """One line of the log drive's file."""

    t_us: int
    left_rad_s: float
    right_rad_s: float

    @property
    def moves(self) -> bool:
        """Whether a wheel is to turn."""
        return bool(self.left_rad_s or self.right_rad_s)


def read_wheel_commands(text: str) -> list[WheelCommand]:
    """Whole lines; one that is still being written is left out."""
    parts = [line.split(",") for line in text.split("\n")[:-1]]
    return [WheelCommand(int(t), float(left), float(right)) for t, left, right in parts]


def on_old_sight(rows: Sequence[WheelCommand], answers: Sequence[Sequence[int]]) -> int:
    """Lines that no young frame allows; `answers` are (heard_us, t_us of the frame answered) of every command sent.

    With the youngest frame that was answered by then older than is driven on, no wheel may turn faster than before;
    when even the ramp is at its end, none may turn.
    """
    ordered, known, youngest_us, lines = sorted(answers, key=lambda one: one[0]), 0, 0, 0
    for before, row in pairwise(rows):
        while known < len(ordered) and ordered[known][0] <= row.t_us + _LATE_US:
            youngest_us = max(youngest_us, ordered[known][1])
            known += 1
        age_us = row.t_us - youngest_us
        lines += (age_us > _OLD_US and _is_faster(before, row)) or (age_us > _RAMPED_OUT_US and row.moves)
    return lines


def _is_faster(before: WheelCommand, row: WheelCommand) -> bool:
    return max(abs(row[1]) - abs(before[1]), abs(row[2]) - abs(before[2])) > _FASTER_RAD_S


def moves_again_s(rows: Sequence[WheelCommand], since_us: int, until_us: int) -> float | None:
    """From `since_us` to the end of the longest standstill that ends after it, up to `until_us`.

    0 if the wheels never stood; None if they did not turn again, or nothing is known.
    """
    inside = [row for row in rows if row.t_us < until_us]
    if not inside or not inside[-1].moves:
        return None
    stood_us = [(end_us - begin_us, end_us) for begin_us, end_us in _stands(inside) if end_us > since_us]
    return (max(stood_us)[1] - since_us) / 1e6 if stood_us else 0.0


def _stands(rows: Sequence[WheelCommand]) -> Iterator[tuple[int, int]]:
    """When each standstill began, and when it was over."""
    begin_us: int | None = None
    for row in rows:
        if not row.moves:
            begin_us = row.t_us if begin_us is None else begin_us
        elif begin_us is not None:
            yield begin_us, row.t_us
            begin_us = None
