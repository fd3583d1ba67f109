"""Requests to a robot (arm, stop, reset ...), repeated until the robot answers. Shell (waits, threads).

    with open_link("r1", connect=[...], role="operator") as link:
        Operator(link).arm()
"""

import math
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
from sightline.protocol.proof import session_digest
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.stop_datagram import STOP_SLOW_S

SOURCE: Final = "operator"
REPEAT_S: Final = 0.2
STOP_PERIOD_S: Final = 0.05
_KEPT_REPLIES = 64
_RECENT_S: Final = 0.5  # five periods of a robot's status
_CITES_STATUS = (Verb.ARM, Verb.RESET, Verb.ACQUIRE)
"""Requests that permit motion, which must cite a status younger than two seconds. Other requests need not."""


@dataclass(frozen=True, slots=True)
class StatusReport:
    """A robot's status and its time stamp."""

    stamp: Stamp
    status: Status


def read_report(message: Message) -> StatusReport:
    """Decode a `status` message.

    Raises:
        WireError: the header or the payload is invalid.
    """
    return StatusReport(decode(Stamp, message.header), decode(Status, message.payload, STATUS.max_payload_bytes))


class Operator:
    """Sends an operator's requests to one robot. Every wait has a limit and raises LinkError without an answer.

    Thread-safe.
    """

    def __init__(self, link: Link) -> None:
        """Subscribe to the status and the replies of the robot.

        Args:
            link: open link to the robot, with the role `operator`.
        """
        self._link = link
        self._session = secrets.token_hex(4)
        self._digest = session_digest(SOURCE, self._session)
        self._seq = self._id = 0
        self._changed = threading.Condition()
        self._report: StatusReport | None = None
        self._recent: dict[str, tuple[float, Status]] = {}
        """Session -> newest status and its time. A second session is a restart, or another robot with this id."""
        self._twin_s = -math.inf
        self._reports = 0
        self._version_trouble = ""
        self._replies: OrderedDict[int, Reply] = OrderedDict()
        link.subscribe(STATUS, self._on_status)
        link.subscribe(REPLY, self._on_reply)

    @property
    def robot(self) -> str:
        """Return the robot's id."""
        return self._link.robot

    @property
    def report(self) -> StatusReport | None:
        """Return the newest status received."""
        return self._report

    def wait_report(self, timeout_s: float = 2.0) -> StatusReport:
        """Wait for the next status.

        Args:
            timeout_s: longest wait, s.

        Returns:
            A status that arrived after the call.

        Raises:
            LinkError: no status in time, or a status of another protocol version.
        """
        with self._changed:
            seen, self._version_trouble = self._reports, ""
            if not self._changed.wait_for(lambda: self._reports > seen or self._version_trouble, timeout_s):
                raise LinkError(
                    f"no status from robot '{self.robot}' after {timeout_s:g} s; run `sightline robots`"
                )
            if self._reports == seen:
                raise LinkError(f"robot '{self.robot}' uses another protocol version: {self._version_trouble}")
            assert self._report is not None
            return self._report

    def request(self, verb: Verb, timeout_s: float = 2.0) -> Reply:
        """Send one request and repeat it until the reply.

        Args:
            verb: the request.
            timeout_s: longest wait, s. A verb that cites a status waits once for the status and once for the reply.

        Returns:
            The reply of the robot. `ok` is False for a rejection.

        Raises:
            LinkError: no reply in time.
        """
        if verb in _CITES_STATUS:
            self.wait_report(timeout_s)  # a new status, because the stored one may precede a STOP or disarm
        return self._request(verb, self._report, timeout_s)

    def _request(self, verb: Verb, cited: StatusReport | None, timeout_s: float) -> Reply:
        """Send a request repeatedly with the same cited status, so that a STOP in between wins."""
        number, deadline_s = self._new_id(), time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            self._send(number, verb, cited)
            with self._changed:
                if self._changed.wait_for(lambda: number in self._replies, REPEAT_S):
                    return self._checked(self._replies[number])
        raise LinkError(f"no answer from robot '{self.robot}' to {verb} after {timeout_s:g} s; repeat the command")

    def _checked(self, reply: Reply) -> Reply:
        if not reply.ok and time.monotonic() - self._twin_s < _RECENT_S:
            raise LinkError(f"two robots have the id '{self.robot}'; end one of them, `sightline robots` lists both")
        return reply

    def arm(self, patience_s: float = 5.0) -> Reply:
        """Request arming. Repeat it while a condition is missing (valid commands, wheels at zero).

        A repetition cites a newer status. It is not sent if this status shows another state or reason than the first
        one, because another operator may have stopped the robot meanwhile.

        Args:
            patience_s: time for the conditions, s.

        Returns:
            The last reply. `ok` is False if the robot did not arm.

        Raises:
            LinkError: no answer from the robot, or two robots with this id.
        """
        deadline_s = time.monotonic() + patience_s
        first = seen = self.wait_report()
        reply = self._request(Verb.ARM, seen, 2.0)
        while not reply.ok and reply.detail.startswith(RejectReason.NOT_ALLOWED) and time.monotonic() < deadline_s:
            seen = self.wait_report()
            if (seen.status.state, seen.status.reason) != (first.status.state, first.status.reason):
                break
            reply = self._request(Verb.ARM, seen, 2.0)
        return reply

    def reset(self, patience_s: float = 1.5) -> Reply:
        """Request a reset. Repeat it while the wheels still turn.

        Every repetition cites the same status, so a STOP in between wins.

        Args:
            patience_s: time for the wheels, s.

        Returns:
            The last reply. `ok` is False if the robot did not reset.

        Raises:
            LinkError: no answer from the robot.
        """
        deadline_s = time.monotonic() + patience_s
        cited = self.wait_report()
        reply = self._request(Verb.RESET, cited, 2.0)
        while not reply.ok and reply.detail.startswith(RejectReason.NOT_ALLOWED) and time.monotonic() < deadline_s:
            self.wait_report()
            reply = self._request(Verb.RESET, cited, 2.0)
        return reply

    def stop(
        self, on_slow: Callable[[], None], timeout_s: float = 10.0, is_proven: Callable[[], bool] = lambda: False
    ) -> Status | None:
        """Send STOP at 20 Hz until a status that arrives afterwards shows STOPPED and wheels at zero.

        Args:
            on_slow: called once if no status shows STOPPED after 300 ms.
            timeout_s: longest wait, s.
            is_proven: returns True if the stop is proven in another way, which ends the repetition.

        Returns:
            The status that shows the stop, or None if `is_proven` returned True.

        Raises:
            LinkError: at `timeout_s`; the robot may still move.
        """
        number, started_s = self._new_id(), time.monotonic()
        # The stored status may be from before another operator's reset, on a link that is dead now.
        seen, warned = self._reports, False
        while time.monotonic() - started_s < timeout_s and not is_proven():
            self._send(number, Verb.STOP, None)
            with self._changed:
                if self._changed.wait_for(lambda: self._reports > seen and self._is_stopped(), STOP_PERIOD_S):
                    assert self._report is not None
                    return self._report.status
                is_latched = self._reports > seen and self._has_state_stopped()
            if not warned and not is_latched and time.monotonic() - started_s > STOP_SLOW_S:
                warned = True
                on_slow()
        if is_proven():
            return None
        raise LinkError(
            f"robot '{self.robot}' did not confirm STOP within {timeout_s:g} s; cut its power by hand"
        )

    def _has_state_stopped(self) -> bool:
        return all(status.state is State.STOPPED for _, status in self._recent.values())

    def _is_stopped(self) -> bool:
        return self._has_state_stopped() and all(one.applied == (0.0, 0.0) for _, one in self._recent.values())

    def _new_id(self) -> int:
        with self._changed:  # two threads may send requests at the same time, e.g. arm and disarm
            self._id += 1
            return self._id

    def _send(self, number: int, verb: Verb, report: StatusReport | None) -> None:
        """Publish a request. Next: `robot_side/pipe.py`: `NetworkEnd.forward`."""
        echo = None if report is None else Echo.of(report.stamp)
        with self._changed:
            self._seq += 1
            header = RequestHeader(source=SOURCE, session=self._session, seq=self._seq, echo=echo)
        self._link.publish(REQUEST, encode(header), encode(Request(id=number, verb=verb)), SOURCE)

    # --- on a thread of the transport: store and return ----------------------------------------------------------

    def _on_status(self, message: Message) -> None:
        try:
            report = read_report(message)
        except WireError as error:
            if error.reason is RejectReason.UNSUPPORTED_VERSION:
                with self._changed:
                    self._version_trouble = error.detail
                    self._changed.notify_all()
            return
        with self._changed:
            self._note(report)
            self._report = report
            self._reports += 1
            self._changed.notify_all()

    def _note(self, report: StatusReport) -> None:
        now_s, session = time.monotonic(), report.stamp.session
        self._recent = {one: known for one, known in self._recent.items() if now_s - known[0] < _RECENT_S}
        last = self._report.stamp.session if self._report else session
        if session in self._recent and session != last:
            self._twin_s = now_s  # this session returned after another one
        self._recent[session] = now_s, report.status

    def _on_reply(self, message: Message) -> None:
        try:
            reply = decode(Reply, message.payload, REPLY.max_payload_bytes)
        except WireError:
            return
        if reply.to != self._digest:
            return
        with self._changed:
            self._replies.setdefault(reply.id, reply)
            if len(self._replies) > _KEPT_REPLIES:
                self._replies.popitem(last=False)
            self._changed.notify_all()
