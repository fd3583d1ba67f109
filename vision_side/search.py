"""Bounded search: turn on the spot after "saw nothing", towards the side last seen. Pure.

Only pictures that were decoded and held nothing are counted; no picture means no search. The budget is spent by
turning, as odometry shows it: a disarmed robot keeps its whole search for when it may move.
"""

import math

from sightline.protocol.messages import Planar, Pose, Twist
from sightline.vision_side.config import SearchConfig


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
