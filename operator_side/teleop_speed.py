"""How fast teleop drives: speeds that keys change, and a ramp for speeding up. Pure."""

from dataclasses import dataclass
from typing import Final

from sightline.protocol.messages import STILL, Status, Twist

_STEP: Final = 1.1
"""A key press changes a speed by 10 %."""
_LEAST_MPS: Final = 0.02
_LEAST_RAD_S: Final = 0.1
_RAMP_MPS2: Final = 0.8
_RAMP_RAD_S2: Final = 5.0
_FIRST_STEP_US: Final = 30_000
"""A press moves the robot with the very first command."""
_LONGEST_STEP_US: Final = 100_000


@dataclass(slots=True)
class Speeds:
    """Wanted top speeds, within what the robot says it can do."""

    linear_mps: float
    angular_rad_s: float
    most_mps: float = 3.0
    most_rad_s: float = 10.0

    def change(self, linear: int, angular: int) -> None:
        """By 10 % up (1) or down (-1) each."""
        self.linear_mps *= _STEP**linear
        self.angular_rad_s *= _STEP**angular
        self._keep()

    def limit(self, status: Status) -> None:
        """The robot's own limits; a robot that says none keeps what was."""
        self.most_mps = status.max_linear_mps or self.most_mps
        self.most_rad_s = status.max_angular_rad_s or self.most_rad_s
        self._keep()

    def _keep(self) -> None:
        self.linear_mps = max(min(_LEAST_MPS, self.most_mps), min(self.most_mps, self.linear_mps))
        self.angular_rad_s = max(min(_LEAST_RAD_S, self.most_rad_s), min(self.most_rad_s, self.angular_rad_s))


class SpeedUp:
    """Brings the twist to its goal: up by a ramp, down at once. A release is zero in the very next command."""

    def __init__(self) -> None:
        self.twist = STILL
        self._stepped_us: int | None = None

    def step(self, goal: Twist, now_us: int) -> Twist:
        """The twist to command now."""
        elapsed_us = _FIRST_STEP_US if self._stepped_us is None else min(_LONGEST_STEP_US, now_us - self._stepped_us)
        self._stepped_us = now_us
        self.twist = Twist(
            linear_mps=_towards(self.twist.linear_mps, goal.linear_mps, _RAMP_MPS2 * elapsed_us / 1e6),
            angular_rad_s=_towards(self.twist.angular_rad_s, goal.angular_rad_s, _RAMP_RAD_S2 * elapsed_us / 1e6),
        )
        return self.twist


def _towards(speed: float, goal: float, change: float) -> float:
    """`goal` where that is slower the same way; else nearer to it by `change`, from zero where the way reverses."""
    start = speed if speed * goal > 0 else 0.0
    if abs(goal) <= abs(start):
        return goal
    return min(goal, start + change) if goal > 0 else max(goal, start - change)
