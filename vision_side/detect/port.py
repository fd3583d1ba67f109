"""The detector port: `Detector`, frames, results, labels, overlap of boxes. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.decode import DecodedImage, Decoder

LONGEST_LABEL: Final = 64
"""As on the wire (`DetectedBox.label`), in characters."""
Label = Annotated[str, Field(min_length=1, max_length=LONGEST_LABEL)]
"""One that is configured."""


COLOR_LABEL: Final = "target"
"""What the colour detectors call what they find, whatever it is. It always counts: one of them may be the fallback."""
_NO_TARGETS: Final = ("legs", "light")
"""What other missions are for; a model that knows balls may know these too."""


def is_followable(label: str, wanted: str) -> bool:
    """Whether what is called `label` is followed: what is `wanted`, if anything is, and what has the target's colour;
    else all but lights and legs."""
    return label in (wanted, COLOR_LABEL) if wanted else not label.startswith(_NO_TARGETS)


def is_label(text: str) -> bool:
    """Whether it can be said as it is."""
    return 0 < len(text) <= LONGEST_LABEL and text.isprintable()


def clean_label(text: str) -> str:
    """`text` as the wire allows it: one printable line, bounded; never empty."""
    return "".join(letter for letter in text if letter.isprintable())[:LONGEST_LABEL] or "thing"


# The detector port: `Detector`, the frames it is given and what it returns. Pure.
#
# "Saw nothing" is a `DetectionResult` without detections; "no answer" is None in its place. Only the first may start a
# search; the second goes the way of silence: the robot is not steered by it and holds.


NO_DEADLINE: Final = 2**63 - 1
"""For who has all the time there is: replays, judges, tests."""


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in pixels of the encoded picture."""

    cx_px: float
    cy_px: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class Detection:
    """One object, in pixels of the encoded picture; (0, 0) is the top-left corner of the top-left pixel.

    `x2_px` and `y2_px` are exclusive. `score` (0..1) is how sure the detector is; of an outline, the share that is the
    object's own. `outline_px` (N, 2) is the part of its edge that is in view, where the detector knows it: edges that
    the picture's border or another object made are left out. `track_id` is the same from frame to frame for one
    object, from detectors that tell.
    """

    x1_px: float
    y1_px: float
    x2_px: float
    y2_px: float
    score: float
    label: str
    circle: Circle | None = None
    outline_px: NDArray[np.float64] | None = field(default=None, compare=False, repr=False)
    track_id: int | None = None


LabelTest = Callable[[str], bool]
"""Whether a mission may go by what has this label."""


def _any_label(_label: str) -> bool:
    return True


class DetectFrame:
    """One frame to look at: the JPEG as it came, and its pixels for who asks, decoded once for all who share it."""

    __slots__ = ("_decoder", "_picture", "goes_by", "header", "height_px", "jpeg", "robot", "width_px")

    def __init__(
        self, robot: str, header: FrameHeader, jpeg: bytes, decoder: Decoder, picture: DecodedImage | None = None
    ) -> None:
        """`decoder` is the robot's, and `picture` what it made of `jpeg`, if it did; valid until it decodes another."""
        self.robot = robot
        self.header = header
        self.jpeg = jpeg
        self.width_px, self.height_px = decoder.size_px
        self._decoder = decoder
        self._picture = picture
        self.goes_by: LabelTest = _any_label  # that of the robot's mission, where the pipeline knows one

    def picture(self) -> DecodedImage:
        """The pixels. Raises WireError MALFORMED for what is no picture of the camera's size."""
        if self._picture is None:
            self._picture = self._decoder.decode(self.jpeg)
        return self._picture

    @property
    def decoded(self) -> DecodedImage | None:
        """The pixels, if they were decoded already."""
        return self._picture


@dataclass(frozen=True, slots=True)
class Maker:
    """Who made a result: the detector's name, the first 16 digits of its model's SHA-256, and what it ran on."""

    detector: str
    model_hash: str = ""
    device: str = ""


@dataclass(frozen=True, slots=True)
class DetectionResult:
    """What was seen in one frame, best first; it names that frame field for field."""

    robot: str
    session: str
    seq: int
    t_us: int
    width_px: int
    height_px: int
    detections: tuple[Detection, ...]
    detector: str
    model_hash: str = ""
    device: str = ""
    compute_us: int = 0


class Detector(Protocol):
    """Finds objects in frames, of one robot or of several.

    A class of this kind has a pydantic `Config` and is built as `Plugin(config)`. It may have `notices()`, which
    returns the few short lines for the operator that it did not return before; `maker`, the `Maker` of its results;
    `attach(link)`, called with each robot's link before its first frame; `close()`, called once at the end; and, on the
    class, `waits = True` if it waits for another service: each robot of a fleet then has its own detector and thread.
    """

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """One result for each frame, in their order; None is "no answer", never "saw nothing".

        `deadline_us` is on this machine's monotonic clock: a detector that waits for a service gives up by then.
        Boxes lie in the picture. Raises nothing for any frame: bytes that do not decode get no answer.
        """
        ...


class NoDetector:
    """The detector where boxes are published by another service: no frame gets an answer here."""

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """None for each."""
        return [None] * len(frames)


def result_of(
    frame: DetectFrame, detections: Sequence[Detection], maker: Maker, compute_us: int = 0
) -> DetectionResult:
    """`detections` as the result for `frame`."""
    header = frame.header
    return DetectionResult(frame.robot, header.session, header.seq, header.t_us, frame.width_px, frame.height_px,
                           tuple(detections), maker.detector, maker.model_hash, maker.device, compute_us)


def clipped(one: Detection, width_px: int, height_px: int) -> Detection | None:
    """The part of `one` that is in the picture, or None if there is none; for boxes that a model drew beyond it."""
    # In this order of arguments, what is no number stays none, and fails the comparison.
    x1, y1 = max(one.x1_px, 0.0), max(one.y1_px, 0.0)
    x2, y2 = min(one.x2_px, float(width_px)), min(one.y2_px, float(height_px))
    if not (x1 < x2 and y1 < y2):
        return None
    if (x1, y1, x2, y2) == (one.x1_px, one.y1_px, one.x2_px, one.y2_px):
        return one
    return replace(one, x1_px=x1, y1_px=y1, x2_px=x2, y2_px=y2)


# How much two boxes have in common. Pure.


Corners = tuple[float, float, float, float]
"""x1, y1, x2, y2."""


def corners(one: Detection) -> Corners:
    """Of its box."""
    return one.x1_px, one.y1_px, one.x2_px, one.y2_px


def overlap(one: Corners, other: Corners) -> float:
    """Intersection over union, 0 to 1."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    if width <= 0 or height <= 0:
        return 0.0
    common = width * height
    return common / (_area(one) + _area(other) - common)


def _area(box: Corners) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])
