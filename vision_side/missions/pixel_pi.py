"""PI steering in pixels, a baseline: the nearer the target looks the slower, and an integral without time. Pure.

The law of an older robot that was split over a WebSocket, its numbers as defaults: speed 200 / area, whatever that
comes to, and an integral per picture that nothing bounds. What else was wrong there (the position of another outline
than the largest, an integral that began anew with each picture) is not repeated. See docs/missions.md for sane numbers.
"""

from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.evaluation.baselines.pixels import largest
from sightline.vision_side.missions.port import Plan, View

Bound = Annotated[float | None, Field(gt=0, le=1e6)]


class PixelPiConfig(Config):
    """The write-up's numbers, in pixels of the encoded picture; None is no bound, as there."""

    area_mps: Annotated[float, Field(gt=0, le=1e5)] = 200.0
    """Speed for an area of one pixel; it falls with the area."""
    angular_rad_s_per_px: Annotated[float, Field(ge=-1, le=1)] = -0.005
    integral_share: Annotated[float, Field(ge=0, le=10)] = 0.007
    dead_band_rad_s: Annotated[float, Field(ge=0, le=10)] = 0.1
    """Smaller corrections are none; the integral goes on."""
    min_area_px: Annotated[float, Field(ge=0, le=1e6)] = 40.0
    """A target that looks no larger is not followed."""
    stop_area_px: Bound = None
    """From this area on only turn."""
    max_linear_mps: Bound = None
    max_integral_rad_s: Bound = None
    """Of the sum of all corrections."""


class PixelPi:
    """Turns by proportion and sum of the pixels off the middle."""

    Config = PixelPiConfig

    def __init__(self, config: PixelPiConfig, camera: CameraModel) -> None:
        self._config, self._width_px = config, camera.width_px
        self._sum_rad_s = 0.0

    def step(self, view: View) -> Plan:
        """The plan for one frame."""
        blob, config = largest(view), self._config
        if blob is None or blob.area_px <= config.min_area_px:
            return Plan(STILL, "no target")
        correction = (blob.x_px - self._width_px / 2) * config.angular_rad_s_per_px
        self._sum_rad_s = _bounded(self._sum_rad_s + correction, config.max_integral_rad_s)
        steady = abs(correction) <= config.dead_band_rad_s
        angular = 0.0 if steady else correction + config.integral_share * self._sum_rad_s
        near = config.stop_area_px is not None and blob.area_px >= config.stop_area_px
        linear = 0.0 if near else _bounded(config.area_mps / blob.area_px, config.max_linear_mps)
        twist = Twist(linear_mps=linear, angular_rad_s=_bounded(angular, _SANITY))
        return Plan(twist, "straight" if steady else "turning", target=blob.detection)


_SANITY = 100.0  # rad/s: an integral that grew for an hour is still a number that fits on the wire


def _bounded(value: float, limit: float | None) -> float:
    return value if limit is None else max(-limit, min(limit, value))
