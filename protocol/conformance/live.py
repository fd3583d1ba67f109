"""A bench in real time: the peer is somebody at an endpoint. Shell (a lock, a clock, a link's threads)."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Final, Self

from protocol.channels import Channel
from protocol.conformance.bench import Bench
from protocol.conformance.case import NotApplicableError
from protocol.transports.link import Link, Message

_WAITING: Final = 1024  # messages that a case has not yet looked at; it looks every few milliseconds
_NAP_S: Final = 0.005


class LiveBench(Bench):
    """Use it in a `with`. Callbacks of the link only store; the case's thread handles what was stored."""

    def __init__(
        self,
        robot: str,
        open_it: Callable[[], Link],
        hears: Sequence[Channel],
        put_it: Callable[[str, bytes, bytes], None] | None = None,
        *,
        endpoint: str = "",
        older: str = "",
        token: str = "",
    ) -> None:
        """`open_it` opens the kit's link, again after each `leave`; `put_it` sends what a link refuses to send.

        Raises what `open_it` raises.
        """
        super().__init__(robot, endpoint, older, token)
        self._open_it, self._hears, self._put_it = open_it, hears, put_it
        self._link: Link | None = None
        self._news = threading.Condition()
        self._waiting: deque[Message] = deque(maxlen=_WAITING)
        self._dropped: Counter[str] = Counter()
        self.join()

    @property
    def now_us(self) -> int:
        return time.monotonic_ns() // 1000

    @property
    def dropped_here(self) -> Counter[str]:
        return self._dropped + _refused(self._link)

    def send(self, channel: Channel, header: bytes, payload: bytes, source: str) -> None:
        if self._link is not None:
            self._link.publish(channel, header, payload, source)

    def put(self, key: str, header: bytes, payload: bytes) -> None:
        if self._put_it is None:
            raise NotApplicableError("the kit has no way to send on this transport what the rules forbid")
        self._put_it(key, header, payload)

    def leave(self) -> None:
        if self._link is not None:
            self._link.close()
            self._dropped += _refused(self._link)
            self._link = None

    def join(self) -> None:
        self._link = self._open_it()
        for channel in self._hears:
            self._link.subscribe(channel, self._store)

    def _store(self, message: Message) -> None:
        with self._news:
            self._waiting.append(message)
            self._news.notify()

    def _pass_time(self, until_us: int) -> None:
        with self._news:
            if not self._waiting:
                self._news.wait(min(_NAP_S, max(0, until_us - self.now_us) / 1e6))
            waiting = list(self._waiting)
            self._waiting.clear()
        for message in waiting:
            self._hear(message)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.leave()


def _refused(link: Link | None) -> Counter[str]:
    return Counter(getattr(link, "refused", Counter()))
