"""When to say "cannot reach": every way seen is closed, or nothing was gained for too long. Pure."""

import math
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.vision_side.missions.port import View

_GAIN_M = 0.1
_DETOUR_M, _MAX_DETOURS = 0.3, 8
_APPLIED = 1e-3


class ProgressCheckerConfig(Config):
    """How long to wait before giving up."""

    closed_s: Annotated[float, Field(ge=0, le=60)] = 1.5
    """With every way closed the robot stands still for this long: a ghost in a scan or somebody passing may go."""
    stuck_s: Annotated[float, Field(gt=0, le=3600)] = 20.0
    """Driving this long without coming nearer by the known way, and without anything new seen, is going round."""


class ProgressChecker:
    """Counts the time that brought nothing."""

    def __init__(self, config: ProgressCheckerConfig) -> None:
        self._config = config
        self.start_again()

    def start_again(self) -> None:
        """There is a new goal."""
        self._closed_s = self._stuck_s = 0.0
        self._best_m = math.inf
        self._discoveries = -1
        self._detours = 0

    def step(self, view: View, left_m: float | None, discoveries: int) -> str:
        """Why to give up, or nothing. `left_m` is None where no way is left.

        A robot that is held (disarmed, stopped) is not running out of time: only driving counts as being stuck.
        """
        if left_m is None:
            self._closed_s += view.dt_s
            return "every way that was seen is closed" if self._closed_s >= self._config.closed_s else ""
        self._closed_s = 0.0
        if discoveries != self._discoveries:
            self._discoveries, self._best_m, self._stuck_s, self._detours = discoveries, left_m, 0.0, 0
        elif left_m < self._best_m - _GAIN_M:
            self._best_m, self._stuck_s = left_m, 0.0
        else:
            self._wait(view, left_m)
        return f"no progress in {self._config.stuck_s:.0f} s" if self._stuck_s >= self._config.stuck_s else ""

    def _wait(self, view: View, left_m: float) -> None:
        """A plan that turned out longer has to be driven first: so a few of them are no standstill."""
        if left_m > self._best_m + _DETOUR_M and self._detours < _MAX_DETOURS:
            self._best_m = left_m
            self._detours += 1
        if max(map(abs, view.header.applied)) > _APPLIED:
            self._stuck_s += view.dt_s
