"""Run any detector on a separate thread and wait for it until the deadline. Shell.

A call that hangs (a name server, a socket, a model) blocks only this thread. While the thread is busy, each newer frame
replaces the one that waits. An answer after the deadline is dropped.
"""

import threading
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, ClassVar, Final

from pydantic import Field

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import SightlineError
from sightline.protocol.log import report_fault
from sightline.protocol.transports.link import LatestSlot, Link
from sightline.vision_side.detect.per_robot import DecoderPool
from sightline.vision_side.detect.plugin_calls import (
    NO_ANSWER_IN_TIME,
    Notices,
    attach_detector,
    checked_results,
    close_detector,
    notices_of,
)
from sightline.vision_side.detect.port import DetectFrame, DetectionResult, Detector
from sightline.vision_side.detect.remote.client import LONGEST_WAIT_S, seconds_left

Results = list[DetectionResult | None]
PixelBound = Annotated[int, Field(ge=256, le=4096 * 4096)]
MAX_PIXELS: Final = 1920 * 1080
FAILED: Final = "FAILED"
"""Counter, next to the rejections of the inner detector, of errors and invalid answers."""
_CLOSE_S: Final = 1.0


class Pending:
    """Requested frames, and the slot for their results."""

    def __init__(self, frames: Sequence[DetectFrame], deadline_us: int) -> None:
        self.frames, self.deadline_us = frames, deadline_us
        self.begun = False
        """True once the inner detector has the frames. Newer frames may replace them before."""
        self._place: LatestSlot[Results] = LatestSlot()

    def answer(self, results: Results) -> None:
        """Put the results into the slot."""
        self._place.put(results)

    def take(self, wait: bool) -> Results | None:
        """Take the results once. Without `wait` it returns immediately. None if no results are there in time."""
        return self._place.take(seconds_left(self.deadline_us) if wait else 0.0)

    @property
    def over(self) -> bool:
        """Return True after the deadline."""
        return monotonic_us() > self.deadline_us


class DeadlineDetector:
    """A `Detector` over another detector, which runs and closes on one separate thread."""

    waits: ClassVar[bool] = True

    def __init__(self, inner: Detector, max_pixels: int = MAX_PIXELS) -> None:
        """Security limit: images of more than `max_pixels` are not decoded."""
        self._inner = inner
        self._decoders = DecoderPool(max_pixels)
        self._failed: Counter[str] = Counter()
        self._news = Notices()
        self._pending: LatestSlot[Pending | None] = LatestSlot()
        self._ending = threading.Event()
        self._ended_by: SightlineError | None = None
        self._thread = threading.Thread(target=self._work, name="detector", daemon=True)
        self._thread.start()

    @property
    def rejected(self) -> Counter[str]:
        """Return the rejections of the inner detector, if it counts them, plus its errors and invalid answers."""
        return Counter(getattr(self._inner, "rejected", Counter())) + self._failed

    @property
    def overtaken(self) -> int:
        """Return the number of frames that newer ones replaced before the inner detector took them."""
        return self._pending.dropped

    def detect(self, frames: Sequence[DetectFrame], deadline_us: int) -> Results:
        """See `Detector`."""
        results = self.request(frames, deadline_us).take(wait=True) if frames else []
        return [None for _ in frames] if results is None else results

    def request(self, frames: Sequence[DetectFrame], deadline_us: int) -> Pending:
        """Request `frames`. They replace frames that still wait."""
        pending = Pending(frames, deadline_us)
        self._pending.put(pending)
        return pending

    def attach(self, link: Link) -> None:
        """Pass a robot's link to the inner detector."""
        attach_detector(self._inner, link)

    def notices(self) -> list[str]:
        """Return the lines of the inner detector, and its first failure."""
        return [*notices_of(self._inner), *self._news.take()]

    def close(self) -> None:
        """End the thread, without waiting for a call that hangs. Raises ConfigError if the inner `close` fails."""
        self._ending.set()
        self._pending.put(None)
        self._thread.join(_CLOSE_S)
        if self._ended_by is not None:
            raise self._ended_by

    def _work(self) -> None:
        while not self._ending.is_set():
            pending = self._pending.take(LONGEST_WAIT_S)
            if pending is not None and not pending.over:
                pending.begun = True
                try:
                    self._answer(pending)
                except Exception as error:  # e.g. no memory for a decoder; it must not end this thread
                    self._fail(f"{type(error).__name__}: {report_fault('detector', error)}")
        try:
            close_detector(self._inner)
        except SightlineError as error:
            self._ended_by = error

    def _answer(self, pending: Pending) -> None:
        frames = [self._decoders.again(one, at) for at, one in enumerate(pending.frames)]
        results = checked_results(self._inner, frames, pending.deadline_us, monotonic_us)
        for why in results:
            if isinstance(why, str) and why is not NO_ANSWER_IN_TIME:
                self._fail(why)
        if not pending.over:
            pending.answer([None if isinstance(one, str) else one for one in results])

    def _fail(self, why: str) -> None:
        """Count a failure; report the first."""
        if not self._failed:
            self._news.add(why)
        self._failed[FAILED] += 1
