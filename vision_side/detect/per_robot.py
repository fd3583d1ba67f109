"""State per robot: a memory that a new session resets, and a pool of decoders. Pure."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Final, Generic, TypeVar

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import DetectFrame

Memory = TypeVar("Memory")

MAX_ROBOTS: Final = 1_000
"""Robots with a stored memory. With fewer, robots that take turns would lose their memory just before their turn. The
robot that was not seen for the longest time is forgotten first."""


class PerSession(Generic[Memory]):
    """One memory for each robot."""

    def __init__(self, begin: Callable[[], Memory]) -> None:
        self._begin = begin
        self._kept: OrderedDict[str, tuple[object, Memory]] = OrderedDict()

    def find(self, robot: str) -> Memory | None:
        """Return the memory of the robot's newest session, or None."""
        return self._kept[robot][1] if robot in self._kept else None

    def of(self, robot: str, session: object) -> Memory:
        """Return the memory of a session. The key `session` may have more parts than the session id."""
        before = self._kept.pop(robot, None)
        memory = before[1] if before is not None and before[0] == session else self._begin()
        self._kept[robot] = session, memory
        if len(self._kept) > MAX_ROBOTS:
            self._kept.popitem(last=False)
        return memory


# Frames for a detector on a separate thread, because the decoder of the pipeline replaces its pixels meanwhile. Pure.


MAX_DECODERS: Final = 64
"""Security limit: stored decoders, one for each robot and place in a batch. The longest unused one is removed first.

A decoded image of 1920x1080 at half scale is 1.6 MB, 100 MB in all. A robot whose decoder was removed gets a new one.
"""


class DecoderPool:
    """Decoders of one thread."""

    def __init__(self, max_pixels: int) -> None:
        """Security limit: images of more than `max_pixels` are not decoded."""
        self._max_pixels = max_pixels
        self._decoders: OrderedDict[tuple[str, int], Decoder] = OrderedDict()

    def again(self, frame: DetectFrame, place: int = 0) -> DetectFrame:
        """Return the frame with the decoder of its robot and `place`. It is valid until that decoder's next frame."""
        copy = self.frame(frame.robot, frame.header, frame.jpeg, (frame.width_px, frame.height_px), place)
        copy.goes_by, copy.expected_px, copy.looks_once = frame.goes_by, frame.expected_px, frame.looks_once
        return copy

    def frame(
        self, robot: str, header: FrameHeader, jpeg: bytes, size_px: tuple[int, int], place: int = 0
    ) -> DetectFrame:
        """Return a frame of known size."""
        decoder = self._decoders.pop((robot, place), None)
        if decoder is None or decoder.size_px != size_px:
            decoder = Decoder(*size_px, self._max_pixels)
        self._decoders[robot, place] = decoder
        if len(self._decoders) > MAX_DECODERS:
            self._decoders.popitem(last=False)
        return DetectFrame(robot, header, jpeg, decoder)
