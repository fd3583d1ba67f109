"""Requests to a robot (arm, stop, reset ...), repeated until the robot answers. Shell (waits, threads).

    with open_link("r1", connect=[...], role="operator") as link:
        Operator(link).arm()
"""

import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from sightline.protocol.channels import REPLY, REQUEST, STATUS
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import LinkError, RejectReason, WireError
from sightline.protocol.messages import Echo, Reply, Request, RequestHeader, Stamp, State, Status, Verb
from sightline.protocol.transports.link import Link, Message

SOURCE: Final = "operator"
REPEAT_S: Final = 0.2
STOP_PERIOD_S: Final = 0.05
STOP_SLOW_S: Final = 0.3
"""A STOP that is not seen to work within this is told to the person, while it goes on being repeated."""
_KEPT_REPLIES = 64
_CITES_STATUS = (Verb.ARM, Verb.RESET, Verb.ACQUIRE)
"""What permits motion must name a status younger than two seconds; what ends it need not."""


@dataclass(frozen=True, slots=True)
class StatusReport:
    """A robot's status and when it said so."""

    stamp: Stamp
    status: Status


def read_report(message: Message) -> StatusReport:
    """Decode a `status` message. Raises WireError."""
    return StatusReport(decode(Stamp, message.header), decode(Status, message.payload, STATUS.max_payload_bytes))


class Operator:
    """One person at one robot. Every method that waits is bounded and raises LinkError when nobody answers."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._session = secrets.token_hex(4)
        self._seq = self._id = 0
        self._news = threading.Condition()
        self._report: StatusReport | None = None
        self._reports = 0
        self._version_trouble = ""
        self._replies: OrderedDict[int, Reply] = OrderedDict()
        link.subscribe(STATUS, self._on_status)
        link.subscribe(REPLY, self._on_reply)

    @property
    def report(self) -> StatusReport | None:
        """The newest status heard."""
        return self._report

    def wait_report(self, timeout_s: float = 2.0) -> StatusReport:
        """The next status. Raises LinkError when none comes, saying so of a robot of another protocol version."""
        with self._news:
            seen, self._version_trouble = self._reports, ""
            if not self._news.wait_for(lambda: self._reports > seen or self._version_trouble, timeout_s):
                raise LinkError(
                    f"robot {self._link.robot!r} is not heard within {timeout_s:g} s; `sightline robots` lists who is"
                )
            if self._reports == seen:
                raise LinkError(f"robot {self._link.robot!r} speaks another protocol: {self._version_trouble}")
            assert self._report is not None
            return self._report

    def request(self, verb: Verb, timeout_s: float = 2.0) -> Reply:
        """Ask once, repeating it until the reply comes. Raises LinkError when none comes in time."""
        if verb in _CITES_STATUS:
            self.wait_report(timeout_s)  # one of now: not from before an earlier STOP or disarm
        self._id += 1
        cited = self._report  # of when it was asked: a STOP that somebody says meanwhile stands above it
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            self._send(verb, cited)
            with self._news:
                if self._news.wait_for(lambda: self._id in self._replies, REPEAT_S):
                    return self._replies[self._id]
        raise LinkError(f"robot {self._link.robot!r} does not answer {verb} within {timeout_s:g} s")

    def arm(self, patience_s: float = 5.0) -> Reply:
        """Arm; while the robot says that something is missing (live commands, wheels at zero) ask again."""
        deadline_s = time.monotonic() + patience_s
        reply = self.request(Verb.ARM)
        while not reply.ok and reply.detail.startswith(RejectReason.NOT_ALLOWED) and time.monotonic() < deadline_s:
            self.wait_report()
            reply = self.request(Verb.ARM)
        return reply

    def stop(self, on_slow: Callable[[], None], timeout_s: float = 10.0) -> Status:
        """Say STOP at 20 Hz until a status says STOPPED. `on_slow` is called once if that takes over 300 ms.

        Raises LinkError after `timeout_s`: then it is not known whether the robot has stopped.
        """
        self._id += 1
        started_s = time.monotonic()
        told = False
        while time.monotonic() - started_s < timeout_s:
            self._send(Verb.STOP, None)
            with self._news:
                if self._news.wait_for(self._is_stopped, STOP_PERIOD_S):
                    assert self._report is not None
                    return self._report.status
            if not told and time.monotonic() - started_s > STOP_SLOW_S:
                told = True
                on_slow()
        raise LinkError(
            f"robot {self._link.robot!r} did not confirm STOP within {timeout_s:g} s; cut its power by hand"
        )

    def _is_stopped(self) -> bool:
        return self._report is not None and self._report.status.state is State.STOPPED

    def _send(self, verb: Verb, report: StatusReport | None) -> None:
        """Publish a request. Next: `robot_side/pipe.py`: `NetworkEnd.forward`."""
        self._seq += 1
        echo = None if report is None else Echo.of(report.stamp)
        header = RequestHeader(source=SOURCE, session=self._session, seq=self._seq, echo=echo)
        self._link.publish(REQUEST, encode(header), encode(Request(id=self._id, verb=verb)), SOURCE)

    # --- on the transport's thread: store and return -------------------------------------------------------------

    def _on_status(self, message: Message) -> None:
        try:
            report = read_report(message)
        except WireError as error:
            if error.reason is RejectReason.UNSUPPORTED_VERSION:
                with self._news:
                    self._version_trouble = error.detail
                    self._news.notify_all()
            return
        with self._news:
            self._report = report
            self._reports += 1
            self._news.notify_all()

    def _on_reply(self, message: Message) -> None:
        try:
            reply = decode(Reply, message.payload, REPLY.max_payload_bytes)
        except WireError:
            return
        if reply.to != self._session:
            return
        with self._news:
            self._replies.setdefault(reply.id, reply)
            if len(self._replies) > _KEPT_REPLIES:
                self._replies.popitem(last=False)
            self._news.notify_all()
