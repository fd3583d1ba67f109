"""Define the detector port: `Detector`, frames, results, labels, overlap of boxes. Pure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Final, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.channels import DETECTIONS
from sightline.protocol.codec import encode
from sightline.protocol.messages import DetectedBox, DetectedCircle, Detections, FrameHeader
from sightline.vision_side.decode import DecodedImage, Decoder

LONGEST_LABEL: Final = 64
"""Longest label in characters, as on the wire (`DetectedBox.label`)."""
Label = Annotated[str, Field(min_length=1, max_length=LONGEST_LABEL)]
"""A label in a configuration."""


NORMALIZED_PX: Final = 2.0
"""All boxes of a detector within so many pixels of the corner of the image are boxes from 0 to 1."""
COLOR_LABEL: Final = "target"
"""Label of every detection of a color detector. It always counts, because a color detector may be the fallback."""
_NO_TARGETS: Final = ("legs", "light")
"""Labels for other missions. A model that finds balls may also find these."""


def is_followable(label: str, wanted: str) -> bool:
    """Return True if the mission follows detections with this label.

    Args:
        label: label of the detection.
        wanted: configured label, or "" for any except lights and legs.
    """
    return label in (wanted, COLOR_LABEL) if wanted else not label.startswith(_NO_TARGETS)


def is_label(text: str) -> bool:
    """Return True if the wire accepts the label unchanged: 1 to 64 printable characters."""
    return 0 < len(text) <= LONGEST_LABEL and text.isprintable()


def clean_label(text: str) -> str:
    """Convert a text to a valid label.

    Args:
        text: label of a model, any characters and length.

    Returns:
        The first 64 printable characters, or "thing" for a text without any.
    """
    return "".join(letter for letter in text if letter.isprintable())[:LONGEST_LABEL] or "thing"


# The detector port: `Detector`, its frames and its results. Pure.
#
# A `DetectionResult` without detections means "detected nothing", and may start a search. None means "no answer": the
# vision service then sends no twist, and the robot holds.


NO_DEADLINE: Final = 2**63 - 1
"""Deadline for replays, scores and tests, which have no time limit."""


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle in pixels of the encoded image.

    Args:
        cx_px: center, from the left edge.
        cy_px: center, from the top edge.
        radius_px: radius, over 0.
    """

    cx_px: float
    cy_px: float
    radius_px: float


@dataclass(frozen=True, slots=True)
class Detection:
    """One object, in pixels of the encoded image. (0, 0) is the top-left corner of the top-left pixel.

    Args:
        x1_px: left edge.
        y1_px: top edge.
        x2_px: right edge, exclusive.
        y2_px: bottom edge, exclusive.
        score: confidence 0..1; with an outline, the share of the outline that belongs to the object.
        label: class of the object.
        circle: its circle, for round objects.
        outline_px: (N, 2), the visible part of its edge, without edges at the image border or at another object.
        track_id: number of the object, equal in all frames, from detectors with tracking.
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

    @property
    def center_px(self) -> tuple[float, float]:
        """Return the center of the box, (x, y)."""
        return (self.x1_px + self.x2_px) / 2, (self.y1_px + self.y2_px) / 2


LabelTest = Callable[[str], bool]
"""Returns True if a mission may use detections with this label."""


def _any_label(_label: str) -> bool:
    return True


class DetectFrame:
    """One frame for a detector: the received JPEG, and its pixels, decoded once for all detectors."""

    __slots__ = ("_decoder", "_picture", "expected_px", "goes_by", "header", "height_px", "jpeg", "looks_once", "robot",
                 "width_px")

    def __init__(
        self, robot: str, header: FrameHeader, jpeg: bytes, decoder: Decoder, picture: DecodedImage | None = None
    ) -> None:
        """Create a frame.

        Args:
            robot: robot id.
            header: header of the frame.
            jpeg: the image as received.
            decoder: decoder of this robot.
            picture: pixels of `jpeg`, if already decoded; valid until `decoder` decodes another image.
        """
        self.robot = robot
        self.header = header
        self.jpeg = jpeg
        self.width_px, self.height_px = decoder.size_px
        self._decoder = decoder
        self._picture = picture
        self.goes_by: LabelTest = _any_label  # the pipeline sets the test of the robot's mission
        self.expected_px: tuple[float, float] | None = None
        """Expected place of the followed target, (x, y) in px of the encoded image; the pipeline sets it."""
        self.looks_once = False
        """True in a detector service: a second run would cost the other robots their time."""

    def picture(self) -> DecodedImage:
        """Decode the image at the first call.

        Returns:
            The pixels, at half scale from 640x480 up. They are valid until the decoder decodes another image.

        Raises:
            WireError: MALFORMED for an image that does not decode, or not of the size of the camera.
        """
        if self._picture is None:
            self._picture = self._decoder.decode(self.jpeg)
        return self._picture

    @property
    def decoded(self) -> DecodedImage | None:
        """Return the pixels if they are already decoded, otherwise None."""
        return self._picture


@dataclass(frozen=True, slots=True)
class Maker:
    """The origin of a result.

    Args:
        detector: name of the detector, at most 64 characters.
        model_hash: first 16 hex digits of the model's SHA-256, or "" without a model.
        device: device that it runs on, e.g. "cpu", at most 32 characters.
    """

    detector: str
    model_hash: str = ""
    device: str = ""


@dataclass(frozen=True, slots=True)
class DetectionResult:
    """The detections in one frame. The result names that frame field for field.

    Args:
        robot: robot id.
        session: session of the robot, as in the header of the frame.
        seq: number of the frame in the session.
        t_us: capture time, us of the robot's clock.
        width_px: width of the encoded image.
        height_px: height of the encoded image.
        detections: objects, best first, at most 64.
        detector: name of the detector.
        model_hash: first 16 hex digits of the model's SHA-256, or "".
        device: device of the detector, or "".
        compute_us: computing time, us.
    """

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
    """Finds objects in frames of one or more robots.

    A detector class has a pydantic `Config`. Sightline creates it as `Plugin(config)`. Optional members:

        notices()     returns new short lines for the operator
        maker         the `Maker` of its results
        attach(link)  called with the link of each robot before its first frame
        close()       called once at the end
        missing()     on the class; returns why it cannot work here, e.g. a missing package, or ""
        read_model(config)  on the class; loads the model of `config`, so that a configuration check finds its errors
        waits = True  on the class, if it waits for another service; each robot then gets its own detector and thread
    """

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        """Detect objects. Raises nothing for any frame: bytes that do not decode get no answer.

        Args:
            frames: the frames.
            deadline_us: end on this machine's monotonic clock, for a detector that waits for a service.

        Returns:
            One result per frame, in the same order. None means "no answer", never "detected nothing". Boxes are inside
            the image.
        """
        ...


class NoDetector:
    """Detects nothing. It is the detector when another service publishes the boxes."""

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:  # noqa: ARG002
        """Return None for each frame."""
        return [None] * len(frames)


def result_of(
    frame: DetectFrame, detections: Sequence[Detection], maker: Maker, compute_us: int = 0
) -> DetectionResult:
    """Combine detections and frame to a result.

    Args:
        frame: the examined frame.
        detections: objects, best first.
        maker: origin of the result.
        compute_us: computing time, us.

    Returns:
        The result, which names the frame.
    """
    header = frame.header
    return DetectionResult(frame.robot, header.session, header.seq, header.t_us, frame.width_px, frame.height_px,
                           tuple(detections), maker.detector, maker.model_hash, maker.device, compute_us)


def clipped(one: Detection, width_px: int, height_px: int) -> Detection | None:
    """Clip a box to the image.

    Args:
        one: detection in pixels of the encoded image.
        width_px: width of the image.
        height_px: height of the image.

    Returns:
        The detection with its box inside the image, or None for a box outside of it.
    """
    # With this order of arguments a nan stays a nan, and fails the comparison below.
    x1, y1 = max(one.x1_px, 0.0), max(one.y1_px, 0.0)
    x2, y2 = min(one.x2_px, float(width_px)), min(one.y2_px, float(height_px))
    if not (x1 < x2 and y1 < y2):
        return None
    if (x1, y1, x2, y2) == (one.x1_px, one.y1_px, one.x2_px, one.y2_px):
        return one
    return replace(one, x1_px=x1, y1_px=y1, x2_px=x2, y2_px=y2)


# The overlap of two boxes. Pure.


Corners = tuple[float, float, float, float]
"""x1, y1, x2, y2."""


def corners(one: Detection) -> Corners:
    """Return the corners of a detection's box, px."""
    return one.x1_px, one.y1_px, one.x2_px, one.y2_px


def overlap(one: Corners, other: Corners) -> float:
    """Compute the intersection over union of two boxes.

    Args:
        one: corners, px.
        other: corners in the same image, px.

    Returns:
        0 for boxes without a common area, to 1 for equal boxes.
    """
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    if width <= 0 or height <= 0:
        return 0.0
    common = width * height
    return common / (_area(one) + _area(other) - common)


def _area(box: Corners) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])


def is_normalized(boxes: NDArray[np.floating]) -> bool:
    """Return True if all boxes (K, 4) with an area lie within two pixels of the corner, as boxes from 0 to 1 do."""
    areas = boxes[(boxes[:, 2:] > boxes[:, :2]).all(axis=1)]
    return len(areas) > 0 and bool(areas.max() < NORMALIZED_PX)


def detections_payload(result: DetectionResult) -> bytes:
    """Encode the boxes for the channel `detections`, best first. The last ones are dropped if it would be too long.

    Raises ValueError for a result of a plug-in that the wire cannot carry.
    """
    boxes = tuple(_box(one) for one in result.detections)
    message = Detections(width_px=result.width_px, height_px=result.height_px, boxes=boxes, detector=result.detector,
                         device=result.device, model=result.model_hash)
    while len(payload := encode(message)) > DETECTIONS.max_payload_bytes:
        message = message.model_copy(update={"boxes": message.boxes[:-1]})
    return payload


def _box(one: Detection) -> DetectedBox:
    circle = one.circle
    ring = DetectedCircle(cx_px=circle.cx_px, cy_px=circle.cy_px, radius_px=circle.radius_px) if circle else None
    return DetectedBox(label=one.label, score=one.score, x1_px=one.x1_px, y1_px=one.y1_px, x2_px=one.x2_px,
                       y2_px=one.y2_px, circle=ring, track=one.track_id)
