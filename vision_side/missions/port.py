"""The mission port: `Mission`, its input (`View`) and its output (`Plan`). Pure.

A mission is a plug-in: a class with a pydantic `Config`. Sightline creates it as `Plugin(config, camera)`. A mission
uses only the capture times of the frames as clock, so the same frames give the same plans, byte for byte.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sightline.protocol.messages import CameraModel, FrameHeader, Twist
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.track import Target


@dataclass(frozen=True, slots=True)
class RangeScan:
    """One turn of a range sensor: `ranges_m[i]` at `angle_min_rad + i * angle_increment_rad`, never NaN.

    inf: no obstacle. 0, or above `range_max_m`: unknown. Below `range_min_m`, but not 0: an obstacle too close to
    measure.

    Angles start at the robot's x axis, counter-clockwise positive. Distances start at the sensor. The robot does not
    publish the position of the sensor.

    Args:
        t_us: time of the scan, us of the robot's clock.
        angle_min_rad: angle of the first ray, rad.
        angle_increment_rad: angle between two rays, rad.
        range_min_m: smallest distance that the sensor measures, m.
        range_max_m: largest distance that the sensor measures, m.
        ranges_m: (rays,), one distance per ray, m.
    """

    t_us: int
    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float
    ranges_m: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class View:
    """The inputs of a mission at one frame."""

    header: FrameHeader
    """Capture time, odometry, measured and applied twist."""
    dt_s: float
    """Time since the previous frame, at most 0.5 s; 0 for the first."""
    latency_s: float
    """Estimated time from capture to wheels, s."""
    camera: CameraModel
    """Model of the camera at the size of this frame."""
    detections: tuple[Detection, ...]
    """Detections, best first. Empty means "detected nothing"."""
    picture: DecodedImage | None = None
    """Decoded pixels, valid only during the step. None if another service detects."""
    scan: RangeScan | None = None
    """The newest scan before the answer. Its age is `header.t_us - scan.t_us`."""


@dataclass(frozen=True, slots=True)
class Plan:
    """The answer of a mission to one frame.

    Args:
        twist: m/s and rad/s.
        phase: one or two words for the operator.
        note: the rest of the line for the operator.
        done: True ends the mission; the robot stays where it is.
        target: the detection that it follows, if any.
        bearing_rad: bearing of the target, rad, left positive.
        distance_m: distance of the target, m.
        track: the object that it follows, also while it is hidden, in the odometry frame.
    """

    twist: Twist
    phase: str
    note: str = ""
    done: bool = False
    target: Detection | None = None
    bearing_rad: float | None = None
    distance_m: float | None = None
    track: Target | None = None


class Mission(Protocol):
    """Maps each frame to a plan for the robot.

    A class may set `wants_scan = True` to receive range scans, and `needs_camera = False` to continue unchanged when
    the camera model changes. With `scales = True` it continues when only the image size changes, and uses `view.camera`
    at each step. Any other mission starts again.
    """

    def step(self, view: View) -> Plan:
        """Compute the plan for one frame. Raises nothing.

        Args:
            view: the frame, the detections and the newest scan.

        Returns:
            The twist in m/s and rad/s, with its reason for the operator. The robot's gate limits the twist.
        """
        ...
