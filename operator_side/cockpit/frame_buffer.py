"""The last pictures of a robot, numbered, fetched only while a page asks for them. Shell (a thread).

A page asks for the next one when it has drawn the last: so a slow page gets fewer pictures, never older ones.
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
"""A page that asks for nothing for this long is closed: nobody watches."""
WAIT_S: Final = 1.0
"""How long a page waits for one picture before it asks again."""
_TAKE_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Numbered:
    """One picture of the buffer."""

    number: int
    shot: Shot


class FrameBuffer:
    """The newest `kept` pictures."""

    def __init__(self, kept: int, age_us: Callable[[Shot], int | None] = lambda _shot: None) -> None:
        self._shots: deque[Numbered] = deque(maxlen=kept)
        self._age_us = age_us
        self._news = threading.Condition()
        self._wanted = -1
        self._requested_s = 0.0

    def add(self, shot: Shot) -> None:
        """One more."""
        with self._news:
            self._shots.append(Numbered(self._number + 1, shot))
            self._news.notify_all()

    @property
    def shots(self) -> Sequence[Numbered]:
        """All that are kept, the oldest first."""
        with self._news:
            return tuple(self._shots)

    def of(self, number: int) -> Shot | None:
        """The picture of that number, if it is still kept."""
        return next((one.shot for one in self.shots if one.number == number), None)

    def is_wanted(self, timeout_s: float) -> bool:
        """Wait until somebody wants a picture that is not there yet; False if nobody does."""
        with self._news:
            return bool(self._news.wait_for(lambda: self._wanted >= self._number and not self.is_idle, timeout_s))

    @property
    def is_idle(self) -> bool:
        """Whether nobody asked for a while."""
        return time.monotonic() - self._requested_s > IDLE_S

    def next(self, after: int, timeout_s: float = WAIT_S) -> Numbered | None:
        """The newest, if its number is above `after` or comes to be in time."""
        with self._news:
            after = after if after <= self._number else 0  # a page of an earlier run
            self._wanted, self._requested_s = max(self._wanted, after), time.monotonic()
            self._news.notify_all()
            self._news.wait_for(lambda: self._number > after, timeout_s)
            return self._shots[-1] if self._number > after else None

    def route(self, request: PageRequest, _body: bytes) -> HttpAnswer:
        """`GET /picture?after=N`, the next one, or `?number=N`, that one; 204 if there is none."""
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
    """Take pictures as they are wanted, until `ending`; while nobody looks, nothing is subscribed to."""
    while not ending.is_set():
        if not buffer.is_wanted(_TAKE_S):
            if buffer.is_idle:
                pictures.pause()
            continue
        shot = pictures.take(_TAKE_S)
        if shot is not None:
            buffer.add(shot)
