"""Sabotages of a run: each replaces one part of the loop by a broken one, and the score must fail. Pure.

`Seams` are the places of lockstep at which something can be replaced. `SABOTAGES` is the table of names.
"""

import array
import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random

import numpy as np

from sightline.protocol.errors import ConfigError
from sightline.robot_side.ports import Ranges, WheelAngles
from sightline.vision_side.detect.plugin_calls import DetectorWrapper
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Detector, clipped

LATE_US = 1_000_000
"""Delay of each answer under `answers-late`."""
_ASIDE = 0.25  # of the image's width: offset of the wrong object from the right one
_TURNED_RAD = 100.0

Detections = tuple[Detection, ...]


@dataclass(frozen=True, slots=True)
class Seams:
    """Places at which a sabotage replaces a part. By default each returns its input.

    Args:
        wheels: commanded speeds (left, right) to those that the motors receive.
        camera: captured JPEG to the JPEG that the stream receives.
        angles: angles of the encoders to those that the driver reads.
        scan: range scan to the scan that the driver reads.
        detections: found objects and the size of the image (width, height) to those that the mission receives.
        late_us: added computing time of each answer.
    """

    wheels: Callable[[float, float], tuple[float, float]] = lambda left, right: (left, right)
    camera: Callable[[bytes], bytes] = lambda jpeg: jpeg
    angles: Callable[[WheelAngles], WheelAngles] = lambda angles: angles
    scan: Callable[[Ranges], Ranges] = lambda scan: scan
    detections: Callable[[Detections, tuple[int, int]], Detections] = lambda found, _size: found
    late_us: int = 0


HEALTHY = Seams()


class SeamDetector(DetectorWrapper):
    """A detector whose results pass through a seam."""

    def __init__(self, inner: Detector, seams: Seams) -> None:
        super().__init__(inner)
        self._seams = seams

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Return the results with the detections of the seam."""
        return [
            result and replace(result, detections=self._seams.detections(
                result.detections, (result.width_px, result.height_px)))
            for result in self.inner.detect(frames, deadline_us)
        ]


def _aside(one: Detection, away_px: float) -> Detection:
    outline = None if one.outline_px is None else one.outline_px + np.array([away_px, 0.0])
    circle = None if one.circle is None else replace(one.circle, cx_px=one.circle.cx_px + away_px)
    return replace(one, x1_px=one.x1_px + away_px, x2_px=one.x2_px + away_px, circle=circle, outline_px=outline)


def _wrong_object(found: Detections, size_px: tuple[int, int]) -> Detections:
    """Return objects next to the real ones."""
    moved = (clipped(_aside(one, _ASIDE * size_px[0]), *size_px) for one in found)
    return tuple(one for one in moved if one is not None)


def _frozen(_seed: int) -> Seams:
    first: list[bytes] = []

    def camera(jpeg: bytes) -> bytes:
        first.append(jpeg)
        del first[1:]
        return first[0]

    return Seams(camera=camera)


def _random_odometry(seed: int) -> Seams:
    draw = Random(f"{seed} odometry")

    def angles(real: WheelAngles) -> WheelAngles:
        left_rad, right_rad = (draw.uniform(-_TURNED_RAD, _TURNED_RAD) for _ in range(2))
        return WheelAngles(left_rad, right_rad, real.t_us)

    return Seams(angles=angles)


def _range_blind(scan: Ranges) -> Ranges:
    return replace(scan, ranges_m=array.array("f", [math.inf] * len(scan.ranges_m)))


SABOTAGES: Mapping[str, Callable[[int], Seams]] = {
    "steering-flipped": lambda _seed: Seams(wheels=lambda left, right: (right, left)),
    "detector-blind": lambda _seed: Seams(detections=lambda _found, _size: ()),
    "detector-wrong-object": lambda _seed: Seams(detections=_wrong_object),
    "wheels-dead": lambda _seed: Seams(wheels=lambda _left, _right: (0.0, 0.0)),
    "one-wheel-dead": lambda _seed: Seams(wheels=lambda left, _right: (left, 0.0)),
    "robot-only-rotates": lambda _seed: Seams(wheels=lambda left, right: ((left - right) / 2, (right - left) / 2)),
    "frames-frozen": _frozen,
    "answers-late": lambda _seed: Seams(late_us=LATE_US),
    "odometry-random": _random_odometry,
    "range-blind": lambda _seed: Seams(scan=_range_blind),
}
"""Seams by name of the sabotage and seed of the run."""

_WITHOUT_DETECTOR = (
    "the mission goes to waypoints by odometry and range sensor, and uses no detection",
    frozenset({"thymio", "thymio-box", "thymio-closed", "thymio-slalom", "thymio-trap"}),
)
UNAFFECTED: Mapping[str, tuple[str, frozenset[str]]] = {
    "range-blind": (
        "the robot never comes near an obstacle, so that the range sensor limits nothing",
        frozenset({
            "ball", "ball-eight", "behind", "blocks", "blocks-eight", "blocks-red", "blocks-yellow", "blue-sphere",
            "blue-sphere-eight", "chaser", "chaser-circle", "chaser-eight", "circle", "eight", "pushed", "static",
            "three-balls", "three-boxes", "traffic-light", "traffic-light-boxes", "walls",
        }),
    ),
    "detector-blind": _WITHOUT_DETECTOR,
    "detector-wrong-object": _WITHOUT_DETECTOR,
}
"""Reason and scenarios by sabotage: pairs in which it cannot change anything. A run then equals the healthy one."""


def sabotages_named(names: Sequence[str]) -> list[str]:
    """Return the sabotages of a list with `all` and commas. Raises ConfigError with the nearest name."""
    wanted = [one.strip() for name in names for one in name.split(",")]
    for one in wanted:
        if one != "all" and one not in SABOTAGES:
            near = max(SABOTAGES, key=lambda name: _likeness(one, name))
            raise ConfigError(
                f"unknown sabotage {one!r}; did you mean {near!r}? There are all, {', '.join(SABOTAGES)}"
            )
    return list(SABOTAGES) if "all" in wanted else list(dict.fromkeys(wanted))


def _likeness(given: str, name: str) -> float:
    """Return the similarity of a text to a name or one of its words, 0 to 1."""
    return max(difflib.SequenceMatcher(None, given, part).ratio() for part in (name, *name.split("-")))


def reason_of(sabotage: str, scenario: str) -> str | None:
    """Return why a sabotage changes nothing in a scenario, or None if it must break a bound."""
    reason, scenarios = UNAFFECTED.get(sabotage, ("", frozenset[str]()))
    return reason if scenario in scenarios else None
