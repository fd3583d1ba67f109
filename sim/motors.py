"""A wheel's motor and encoder: acceleration limit, lag, slip, steps. Pure."""

import math
from random import Random

from sightline.sim.robot import Wheels

SLIP_EVERY_STEPS = 25  # 0.1 s of 4 ms steps


class Motor:
    """Latches the speed it is given and follows it as a small gear motor does."""

    def __init__(self, model: Wheels, step_s: float, seed: str) -> None:
        self._model = model
        self._most_change_rad_s = model.max_accel_mps2 / model.radius_m * step_s
        self._follow = 1.0 - math.exp(-step_s / model.lag_s) if model.lag_s else 1.0
        self._draw = Random(seed)
        self._wanted_rad_s = self._ramped_rad_s = self._speed_rad_s = 0.0
        self._steps = 0
        self._kept = 1.0
        self._turned_rad = self._shaft_rad = 0.0

    def set(self, speed_rad_s: float) -> None:
        """Latch a speed; beyond the motor's own it gives its own. Raises ValueError unless finite."""
        if not math.isfinite(speed_rad_s):
            raise ValueError(f"wheel speed {speed_rad_s}")
        most = self._model.max_rad_s
        self._wanted_rad_s = max(-most, min(most, speed_rad_s))

    def step(self) -> float:
        """One physics step later: the speed at which the wheel should roll over the floor, rad/s."""
        change = self._wanted_rad_s - self._ramped_rad_s
        self._ramped_rad_s += max(-self._most_change_rad_s, min(self._most_change_rad_s, change))
        self._speed_rad_s += (self._ramped_rad_s - self._speed_rad_s) * self._follow
        if self._model.slip and self._steps % SLIP_EVERY_STEPS == 0:
            self._kept = 1.0 - self._draw.uniform(0.0, 2.0 * self._model.slip)
        self._steps += 1
        return self._speed_rad_s * self._kept

    def rolled(self, turned_rad: float) -> None:
        """Tell the encoder how far the wheel has rolled since the beginning, rad."""
        self._shaft_rad += (turned_rad - self._turned_rad) / self._kept
        self._turned_rad = turned_rad

    @property
    def angle_rad(self) -> float:
        """What the encoder counts: turning of the shaft, slip included, in whole encoder steps."""
        step_rad = math.tau / self._model.encoder_steps
        return math.floor(self._shaft_rad / step_rad) * step_rad
