"""P steering in pixels at five commands a second, a baseline. Pure.

The law of an older ball-chasing car, its numbers as defaults: whatever it decided holds for 0.2 s, however the target
moves meanwhile. See docs/missions.md for sane numbers.
"""

from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.evaluation.baselines.pixels import Blob, largest
from sightline.vision_side.missions.port import Plan, View

Pixels = Annotated[float, Field(ge=0, le=1e4)]


class PixelPConfig(Config):
    """The write-up's numbers, in pixels of the encoded picture."""

    angular_rad_s_per_px: Annotated[float, Field(ge=0, le=1)] = 0.009
    min_radius_px: Pixels = 10.0
    """A target that looks no larger is none."""
    stop_radius_px: Pixels = 50.0
    """A target that looks larger is near enough: only turn."""
    centred_px: Pixels = 20.0
    """Nearer to the middle than this: drive fast."""
    fast_mps: Annotated[float, Field(ge=0, le=5)] = 0.5
    slow_mps: Annotated[float, Field(ge=0, le=5)] = 0.2
    period_s: Annotated[float, Field(ge=0, le=5)] = 0.2
    """From one decision to the next; 0: with each picture."""


class PixelP:
    """Turns by the pixels off the middle; two speeds."""

    Config = PixelPConfig

    def __init__(self, config: PixelPConfig, camera: CameraModel) -> None:
        self._config, self._width_px = config, camera.width_px
        self._decided_us: int | None = None
        self._plan = Plan(STILL, "no target")

    def step(self, view: View) -> Plan:
        """The plan for one frame: a new one when it is time, else the last."""
        t_us = view.header.t_us
        if self._decided_us is None or t_us - self._decided_us >= self._config.period_s * 1e6:
            self._decided_us = t_us
            self._plan = self._decide(largest(view))
        return self._plan

    def _decide(self, blob: Blob | None) -> Plan:
        config = self._config
        if blob is None or blob.radius_px <= config.min_radius_px:
            return Plan(STILL, "no target")
        off_px = self._width_px // 2 - int(blob.x_px)  # left positive, whole pixels, as there
        turn = config.angular_rad_s_per_px * off_px
        if blob.radius_px > config.stop_radius_px:
            return Plan(Twist(linear_mps=0.0, angular_rad_s=turn), "near", target=blob.detection)
        centred = abs(off_px) < config.centred_px
        speed = config.fast_mps if centred else config.slow_mps
        return Plan(Twist(linear_mps=speed, angular_rad_s=turn), "straight" if centred else "turning",
                    target=blob.detection)
