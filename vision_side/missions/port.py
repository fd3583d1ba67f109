"""The mission port: `Mission`, what it may go by (`View`), and what it answers (`Plan`). Pure.

A mission is a plug-in: a class with a pydantic `Config`, built as `Plugin(config, camera)`. It knows no clock but the
frames' capture times, so the same frames give the same plans, byte for byte.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import CameraModel, FrameHeader, Twist
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Detection


@dataclass(frozen=True, slots=True)
class RangeScan:
    """One turn of a range sensor: `ranges_m[i]` at `angle_min_rad + i * angle_increment_rad`, inf = nothing, never NaN.

    Angles about the robot's x axis, counter-clockwise positive; distances from the sensor, whose place the robot does
    not tell.
    """

    t_us: int
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    ranges_m: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class View:
    """All that a mission may go by, at one frame."""

    header: FrameHeader
    """Capture time, odometry, measured and applied twist."""
    dt_s: float
    """Since the frame before, at most 0.5; 0 for the first."""
    latency_s: float
    """Capture to wheels, estimated."""
    camera: CameraModel
    detections: tuple[Detection, ...]
    """Empty means "saw nothing"."""
    picture: DecodedImage | None = None
    """Decoded pixels, valid during the step only; None where another service detects."""
    scan: RangeScan | None = None
    """The newest that came before the frame was answered; its age is `header.t_us - scan.t_us`."""


@dataclass(frozen=True, slots=True)
class Plan:
    """What a mission answers to one frame. `phase` is one or two words for a person, `note` the rest of the line.

    `done` ends the mission: the robot stays where it is. `target`, `bearing_rad` (left positive) and `distance_m` tell
    what it goes by, where there is such a thing.
    """

    twist: Twist
    phase: str
    note: str = ""
    done: bool = False
    target: Detection | None = None
    bearing_rad: float | None = None
    distance_m: float | None = None


class Mission(Protocol):
    """Decides what the robot does next.

    Its class may say two things about itself: `wants_scan = True` for who goes by range scans (without it none is
    subscribed to), and `needs_camera = False` for who goes on unchanged when the robot gets another camera model.
    """

    def step(self, view: View) -> Plan:
        """The plan for one frame. Raises nothing."""
        ...
