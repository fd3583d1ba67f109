"""The newest images of a robot, numbered, fetched only while a page requests them. Shell (a thread).

A page requests the next image after it drew the last one. So a slow page gets fewer images, but not older ones.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

from sightline.operator_side.client.pictures import Pictures, Shot
from sightline.operator_side.cockpit.http_server import HttpAnswer, PageRequest

IDLE_S: Final = 3.0
"""Time without a request after which a page counts as closed."""
WAIT_S: Final = 1.0
"""Longest wait for an image before a page repeats its request."""
_TAKE_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Numbered:
    """One image of the buffer."""

    number: int
    shot: Shot


class FrameBuffer:
    """The newest `kept` images."""

    def __init__(self, kept: int, age_us: Callable[[Shot], int | None] = lambda _shot: None) -> None:
        self._shots: deque[Numbered] = deque(maxlen=kept)
        self._age_us = age_us
        self._changed = threading.Condition()
        self._wanted = -1
        self._requested_s = 0.0

    def add(self, shot: Shot) -> None:
        """Append an image."""
        with self._changed:
            self._shots.append(Numbered(self._number + 1, shot))
            self._changed.notify_all()

    @property
    def shots(self) -> Sequence[Numbered]:
        """Return all images, the oldest first."""
        with self._changed:
            return tuple(self._shots)

    def of(self, number: int) -> Shot | None:
        """Return the image with this number, or None if it is gone."""
        return next((one.shot for one in self.shots if one.number == number), None)

    def is_wanted(self, timeout_s: float) -> bool:
        """Wait until a page requests an image that is missing. Returns False at `timeout_s`."""
        with self._changed:
            return bool(self._changed.wait_for(lambda: self._wanted >= self._number and not self.is_idle, timeout_s))

    @property
    def is_idle(self) -> bool:
        """Return True if the last request is too old."""
        return time.monotonic() - self._requested_s > IDLE_S

    def next(self, after: int, timeout_s: float = WAIT_S) -> Numbered | None:
        """Wait for an image with a number above `after`. Returns the newest one, or None at `timeout_s`."""
        with self._changed:
            after = after if 0 <= after <= self._number else 0  # the page is from an earlier run
            self._wanted, self._requested_s = max(self._wanted, after), time.monotonic()
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._number > after, timeout_s)
            return self._shots[-1] if self._number > after else None

    def route(self, request: PageRequest, _body: bytes) -> HttpAnswer:
        """Answer `GET /picture?after=N` with the next image, `?number=N` with image N; 204 without an image."""
        if "number" in request:
            shot = self.of(int(request["number"]))
            found = Numbered(int(request["number"]), shot) if shot else None
        else:
            found = self.next(int(request.get("after", "0")))
        if found is None:
            return HttpAnswer(status=204)
        age_us = self._age_us(found.shot)
        about = {"X-Number": str(found.number), "X-Channel": found.shot.channel.name, "X-Seq": str(found.shot.seq),
                 "X-Age-Us": "" if age_us is None else str(age_us)}
        return HttpAnswer(found.shot.jpeg, "image/jpeg", headers=about)

    @property
    def _number(self) -> int:
        return self._shots[-1].number if self._shots else 0


def fill(buffer: FrameBuffer, pictures: Pictures, ending: threading.Event) -> None:
    """Take images on request until `ending`. Without requests it unsubscribes."""
    while not ending.is_set():
        if not buffer.is_wanted(_TAKE_S):
            if buffer.is_idle:
                pictures.pause()
            continue
        shot = pictures.take(_TAKE_S)
        if shot is not None:
            buffer.add(shot)
