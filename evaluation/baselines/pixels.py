"""Band, P and PI steering in pixels. Pure."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.port import Plan, View

_FURTHEST_PX = 1e6  # as on the wire; a box of a plug-in may be anywhere


@dataclass(frozen=True, slots=True)
class Blob:
    """Position and radius in pixels of the encoded image. Without a circle: box center and half of its longer side."""

    detection: Detection
    x_px: float
    radius_px: float
    area_px: float


def largest(view: View) -> Blob | None:
    """Return the detection with the largest area, or None without one."""
    blobs = [_blob(one) for one in view.detections]
    return max(blobs, key=lambda blob: blob.area_px, default=None)


def _blob(one: Detection) -> Blob:
    if one.circle is not None:
        radius = one.circle.radius_px
        return Blob(one, _bounded(one.circle.cx_px, _FURTHEST_PX), radius, math.pi * radius * radius)
    width, height = one.x2_px - one.x1_px, one.y2_px - one.y1_px
    return Blob(one, _bounded(one.center_px[0], _FURTHEST_PX), max(width, height) / 2, width * height)


# Band steering, a baseline: one of three fixed twists, by the position and size of the target in the image. Pure.
#
# The law of a legacy Gazebo robot, its numbers as defaults. `centre_share` is a share of the whole width, as there.
# The robot therefore turns only if the target almost leaves the image; docs/how-to/missions.md has sane numbers.


Share = Annotated[float, Field(ge=0, le=1)]


class BandConfig(Config):
    """Numbers of the legacy article. Shares are of the image width."""

    min_radius_share: Share = 0.05
    max_radius_share: Share = 1 / 3
    """A target that looks smaller or larger than this is not followed."""
    centre_share: Share = 0.30
    """Within this share on either side of the center the robot drives straight on."""
    averaged: Annotated[int, Field(ge=1, le=100)] = 5
    """Positions of the target that are averaged."""
    linear_mps: Annotated[float, Field(ge=0, le=5)] = 0.1
    """Speed straight on and while turning."""
    angular_rad_s: Annotated[float, Field(ge=0, le=10)] = 0.5


class Band:
    """Drives forward, left or right at fixed speeds, or stops."""

    Config = BandConfig

    def __init__(self, config: BandConfig, camera: CameraModel) -> None:
        self._config, self._width_px = config, camera.width_px
        self._seen_px: deque[float] = deque(maxlen=config.averaged)

    def step(self, view: View) -> Plan:
        """Return the plan for one frame."""
        blob = largest(view)
        if blob is None:
            return Plan(STILL, "no target")
        self._seen_px.append(blob.x_px)
        middle_px = round(sum(self._seen_px) / len(self._seen_px)) - (self._width_px // 2 - 1)  # whole pixels, as there
        config, share = self._config, blob.radius_px / self._width_px
        if not config.min_radius_share <= share <= config.max_radius_share:
            return Plan(STILL, "too near" if share > config.max_radius_share else "too far", target=blob.detection)
        if abs(middle_px) <= config.centre_share * self._width_px:
            return Plan(Twist(linear_mps=config.linear_mps, angular_rad_s=0.0), "forward", target=blob.detection)
        left = middle_px < 0
        turn = config.angular_rad_s if left else -config.angular_rad_s
        return Plan(Twist(linear_mps=config.linear_mps, angular_rad_s=turn), "left" if left else "right",
                    target=blob.detection)


# P steering in pixels at five commands a second, a baseline. Pure.  The law of a legacy ball-chasing car, its numbers
# as defaults: each decision holds for 0.2 s, however the target moves in that time. docs/how-to/missions.md has
# sane numbers.


Pixels = Annotated[float, Field(ge=0, le=1e4)]


class PixelPConfig(Config):
    """Numbers of the legacy article, in pixels of the encoded image."""

    angular_rad_s_per_px: Annotated[float, Field(ge=0, le=1)] = 0.009
    min_radius_px: Pixels = 10.0
    """Smallest radius of a target."""
    stop_radius_px: Pixels = 50.0
    """Radius from which a target is near enough: only turn."""
    centred_px: Pixels = 20.0
    """Offset from the center below which it drives fast."""
    fast_mps: Annotated[float, Field(ge=0, le=5)] = 0.5
    slow_mps: Annotated[float, Field(ge=0, le=5)] = 0.2
    period_s: Annotated[float, Field(ge=0, le=5)] = 0.2
    """Time between two decisions; 0: one per image."""


class PixelP:
    """Turns by the pixel offset from the center; two speeds."""

    Config = PixelPConfig

    def __init__(self, config: PixelPConfig, camera: CameraModel) -> None:
        self._config, self._width_px = config, camera.width_px
        self._decided_us: int | None = None
        self._plan = Plan(STILL, "no target")

    def step(self, view: View) -> Plan:
        """Compute a new plan when it is due, else return the last one."""
        t_us = view.header.t_us
        if self._decided_us is None or t_us - self._decided_us >= self._config.period_s * 1e6:
            self._decided_us = t_us
            self._plan = self._decide(largest(view))
        return self._plan

    def _decide(self, blob: Blob | None) -> Plan:
        config = self._config
        if blob is None or blob.radius_px <= config.min_radius_px:
            return Plan(STILL, "no target")
        off_px = self._width_px // 2 - int(blob.x_px)  # left positive, whole pixels, as in the legacy code
        turn = config.angular_rad_s_per_px * off_px
        if blob.radius_px > config.stop_radius_px:
            return Plan(Twist(linear_mps=0.0, angular_rad_s=turn), "near", target=blob.detection)
        centred = abs(off_px) < config.centred_px
        speed = config.fast_mps if centred else config.slow_mps
        return Plan(Twist(linear_mps=speed, angular_rad_s=turn), "straight" if centred else "turning",
                    target=blob.detection)


# PI steering in pixels, a baseline: slower for a nearer target, and an integral that ignores time. Pure.  The
# law of a legacy robot that was split over a WebSocket, its numbers as defaults: speed 200 / area without a limit,
# and an unbounded integral per image. Its other faults (the position of another outline than
# the largest, an integral that restarted with each image) are not repeated.
# docs/how-to/missions.md has sane numbers.


Bound = Annotated[float | None, Field(gt=0, le=1e6)]


class PixelPiConfig(Config):
    """Numbers of the legacy article, in pixels of the encoded image. None means no bound, as in the article."""

    area_mps: Annotated[float, Field(gt=0, le=1e5)] = 200.0
    """Speed for an area of one pixel; it falls with the area."""
    angular_rad_s_per_px: Annotated[float, Field(ge=-1, le=1)] = -0.005
    integral_share: Annotated[float, Field(ge=0, le=10)] = 0.007
    dead_band_rad_s: Annotated[float, Field(ge=0, le=10)] = 0.1
    """Smaller corrections become zero. The integral continues."""
    min_area_px: Annotated[float, Field(ge=0, le=1e6)] = 40.0
    """A smaller target is not followed."""
    stop_area_px: Bound = None
    """Area from which it only turns."""
    max_linear_mps: Bound = None
    max_integral_rad_s: Bound = None
    """Bound of the sum of all corrections."""


class PixelPi:
    """Turns by proportion and sum of the pixel offset from the center."""

    Config = PixelPiConfig

    def __init__(self, config: PixelPiConfig, camera: CameraModel) -> None:
        self._config, self._width_px = config, camera.width_px
        self._sum_rad_s = 0.0

    def step(self, view: View) -> Plan:
        """Return the plan for one frame."""
        blob, config = largest(view), self._config
        if blob is None or blob.area_px <= config.min_area_px:
            return Plan(STILL, "no target")
        correction = (blob.x_px - self._width_px / 2) * config.angular_rad_s_per_px
        self._sum_rad_s = _bounded(self._sum_rad_s + correction, config.max_integral_rad_s)
        steady = abs(correction) <= config.dead_band_rad_s
        angular = 0.0 if steady else correction + config.integral_share * self._sum_rad_s
        near = config.stop_area_px is not None and blob.area_px >= config.stop_area_px
        linear = 0.0 if near else _bounded(config.area_mps / blob.area_px, config.max_linear_mps)
        twist = Twist(linear_mps=_bounded(linear, _SANITY), angular_rad_s=_bounded(angular, _SANITY))
        return Plan(twist, "straight" if steady else "turning", target=blob.detection)


_SANITY = 100.0  # m/s, rad/s: an integral that grew for an hour, or a box of almost no area, still fits on the wire


def _bounded(value: float, limit: float | None) -> float:
    return value if limit is None else max(-limit, min(limit, value))
