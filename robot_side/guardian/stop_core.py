"""Logic of the STOP port: the receiver next to a driver process, and the forwarder next to a router. Pure.

Packets between receiver and driver process, over one `SOCK_SEQPACKET` pair that outlives both:

    receiver -> driver   `S` number                              a valid STOP came
                         `C` reason count ... address            ignored datagrams since the last such packet
                         `L` text                                a line for the log
    driver -> receiver   `R` number state at_rest stored         newest applied STOP, and the current state
"""

import struct
from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable
from typing import Final, NamedTuple

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.transports.stop_datagram import (
    NO_CHALLENGE,
    STATES,
    Kind,
    StopDatagram,
    challenge_of,
    check_hmac,
    pack_stop,
    unpack_stop,
)

_NUMBER: Final = struct.Struct(">cQ")
_REPORT: Final = struct.Struct(">cQB??")
_REPORT_US: Final = 1_000_000
_SILENT_US: Final = 500_000
"""Age of the last report after which the state of the driver process is unknown. It reports ten times a second."""
_LOST_US: Final = 50_000
"""A live driver process applies a STOP within a tick. A later report without the STOP shows that the process has not
read it: an earlier process did, and died."""


class DriverReport(NamedTuple):
    """State of the driver process: `applied` is the number of the newest STOP that it has latched."""

    applied: int
    state: str
    at_rest: bool
    stored: bool


def pack_report(report: DriverReport) -> bytes:
    """Encode a report."""
    return _REPORT.pack(b"R", report.applied, STATES.index(report.state), report.at_rest, report.stored)


def pack_number(number: int) -> bytes:
    """Encode that a valid STOP came."""
    return _NUMBER.pack(b"S", number)


def unpack_number(packet: bytes) -> int:
    """Decode a packet of `pack_number`."""
    return int(_NUMBER.unpack(packet)[1])


class IgnoredDatagrams:
    """Counts ignored datagrams by reason, and reports them once a second."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._address = ""
        self._report_us = 0

    def add(self, error: WireError, address: str) -> None:
        """Count a datagram from `address`."""
        self._counts[error.reason] += 1
        self._address = address

    def report(self, send: Callable[[bytes], bool], now_us: int) -> None:
        """Send the counts, with the address of the last datagram. If it cannot be sent, try again after a second."""
        if not self._counts or now_us < self._report_us:
            return
        self._report_us = now_us + _REPORT_US
        words = [*(f"{reason} {count}" for reason, count in self._counts.items()), self._address]
        if send(b"C" + " ".join(words).encode()):
            self._counts.clear()


def unpack_ignored(packet: bytes) -> tuple[dict[str, int], str]:
    """Decode a packet of `IgnoredDatagrams`."""
    *words, address = packet[1:].decode().split(" ")
    return dict(zip(words[::2], map(int, words[1::2]), strict=True)), address


class ReceiverCore:
    """Logic of the STOP port of one robot."""

    def __init__(self, robot: str, secret: bytes, challenge: bytes, number: int) -> None:
        """Begin without a report of the driver process.

        Args:
            robot: robot id.
            secret: STOP secret, or b"" to accept every STOP.
            challenge: random bytes of this start.
            number: number before the first STOP. No earlier receiver reached it, e.g. the time since boot, us.
        """
        self._robot, self._secret, self._challenge = robot, secret, challenge
        self._received = self._sent = self._applied = number
        self._sent_us = self._report_us = 0
        self._report = DriverReport(0, "", False, False)
        self._has_lost = False

    def on_stop(self, data: bytes, one: StopDatagram, now_us: int) -> bytes:
        """Process a STOP. Returns the answer.

        Args:
            data: the datagram.
            one: the decoded datagram.
            now_us: time of the receiver.

        Raises:
            WireError: the caller must ignore the datagram.
        """
        # Answers have the challenge and an HMAC, so a reflected answer must not count as a STOP.
        if one.kind is not Kind.STOP:
            raise WireError(RejectReason.MALFORMED, "expected a STOP")
        if one.robot != self._robot:
            raise WireError(RejectReason.OTHER_ROBOT, "for another robot")
        if self._secret and one.challenge == NO_CHALLENGE:
            return self._pack(StopDatagram(Kind.ANSWER, self._robot, one.counter, self._challenge, keyed=True))
        if self._secret:
            if one.challenge != self._challenge:
                raise WireError(RejectReason.OTHER_SESSION, "of an earlier start of the robot")
            check_hmac(data, self._secret)
        self._received += 1
        applied, state, at_rest, stored = self._report
        if now_us - self._report_us > _SILENT_US:
            state, at_rest = "", False
        return self._pack(StopDatagram(
            Kind.ANSWER, self._robot, one.counter, self._challenge, STATES.index(state), at_rest, stored,
            bool(self._secret), self._received, applied,
        ))

    def _pack(self, answer: StopDatagram) -> bytes:
        return pack_stop(answer, self._secret)

    def on_report(self, packet: bytes, now_us: int) -> None:
        """Process a report of the driver process."""
        _, applied, state, at_rest, stored = _REPORT.unpack(packet)
        self._report, self._report_us = DriverReport(applied, STATES[state], at_rest, stored), now_us
        self._applied = max(self._applied, applied)
        self._has_lost = self._sent > self._applied and now_us - self._sent_us >= _LOST_US

    def packet(self, now_us: int) -> bytes | None:
        """Return the next STOP packet for the driver process, or None. One packet at a time is in flight."""
        is_free = self._sent <= self._applied or self._has_lost
        if self._received <= self._applied or not is_free:
            return None
        self._sent, self._sent_us, self._has_lost = self._received, now_us, False
        return pack_number(self._sent)


class Registration:
    """Registers a robot at one router, so that the router forwards STOPs to it.

    With a secret it answers each challenge at the source address of the challenge. A router has one challenge for each
    address of the robot, which may have two address families, or another port of a NAT.
    """

    def __init__(self, robot: str, secret: bytes, counter: int) -> None:
        """Begin. `counter` is a random start, below 2^63."""
        self._robot, self._secret = robot, secret
        self._first = self._counter = counter

    def datagram(self) -> bytes:
        """Return the datagram to send now, about once a second. With a secret it requests the challenge."""
        self._counter += 2
        return self._pack(self._counter, NO_CHALLENGE)

    def _pack(self, counter: int, challenge: bytes) -> bytes:
        return pack_stop(StopDatagram(Kind.REGISTER, self._robot, counter, challenge), self._secret)

    def awaits(self, one: StopDatagram) -> bool:
        """Return True if the datagram answers this registration."""
        return one.kind is Kind.ANSWER and self._first < one.counter <= self._counter + bool(self._secret)

    def on_answer(self, data: bytes, one: StopDatagram) -> bytes | None:
        """Process an expected answer. Returns the datagram to send back immediately, or None.

        Raises:
            WireError: it has no valid HMAC.
        """
        if not self._secret:
            return None
        check_hmac(data, self._secret)
        # An odd number belongs to a datagram with a challenge. Its answer needs no reply, otherwise replies never end.
        return None if (one.counter - self._first) % 2 else self._pack(one.counter + 1, one.challenge)


# The forwarder next to a router.


MAX_ROBOTS: Final = 1024
"""Security limit: robots of one router."""
MAX_PLACES: Final = 8
"""Security limit: addresses of one robot id. Without keys a third party may use the same id, so STOP goes to all."""
MAX_OPERATORS: Final = 64
"""Security limit: operator addresses with STOPs that wait for an answer."""
MAX_WAITING: Final = 64
"""Security limit: waiting STOPs of one address, so that a flood from another address removes none. 0.6 s of STOPs."""
_NO_HMAC: Final = bytes(32)
_FRESH_US: Final = 3_000_000
Origin = tuple[int, tuple[str, int]]
"""Socket of a datagram, and the address of its sender."""


class ForwarderCore:
    """Forwards STOPs to the registered robots, and returns the answers."""

    def __init__(self, secret: bytes, seed: bytes) -> None:
        """Begin without robots. With a secret, only robots with this secret may register.

        Args:
            secret: STOP secret, or b"".
            seed: random bytes of this start.
        """
        self._secret, self._seed = secret, seed
        self._robots: dict[str, dict[str, tuple[Origin, int]]] = {}
        """Robot id -> host -> address and time of the last registration."""
        self._waiting: OrderedDict[str, OrderedDict[Hashable, Origin]] = OrderedDict()
        """Host -> robot and counter of a STOP -> its sender."""

    def on_datagram(self, data: bytes, origin: Origin, now_us: int) -> list[tuple[bytes, Origin]]:
        """Process a datagram. Returns the datagrams to send.

        Raises:
            WireError: the caller must ignore the datagram.
        """
        one = unpack_stop(data)
        if one.kind is Kind.REGISTER:
            return self._register(data, one, origin, now_us)
        if one.kind is Kind.ANSWER:
            stop = one.robot, one.counter
            sender = next((stops[stop] for stops in self._waiting.values() if stop in stops), None)
            known = origin[1][0] in self._robots.get(one.robot, {})
            return [(data, sender)] if sender is not None and known else []
        places = self._robots.get(one.robot)
        if not places:
            raise WireError(RejectReason.OTHER_ROBOT, "for a robot that is not registered here")
        if self._secret and data.endswith(_NO_HMAC):
            # Without an HMAC, because a third party could pass one to an operator with the secret.
            return [(pack_stop(StopDatagram(Kind.ANSWER, one.robot, one.counter, keyed=True)), origin)]
        if self._secret:
            check_hmac(data, self._secret)
        self._note_sender(one, origin)
        return [(data, place) for place, _ in places.values()]

    def _note_sender(self, one: StopDatagram, origin: Origin) -> None:
        host = origin[1][0]
        stops = self._waiting.setdefault(host, OrderedDict())
        self._waiting.move_to_end(host)
        stops[one.robot, one.counter] = origin
        if len(stops) > MAX_WAITING:
            stops.popitem(last=False)
        if len(self._waiting) > MAX_OPERATORS:
            self._waiting.popitem(last=False)

    def _register(
        self, data: bytes, one: StopDatagram, origin: Origin, now_us: int
    ) -> list[tuple[bytes, Origin]]:
        # It depends on the address. Otherwise a recorded registration could direct STOPs to any address.
        challenge = challenge_of(self._seed, *origin[1][:2])
        if self._secret and one.challenge != NO_CHALLENGE:
            if one.challenge != challenge:
                raise WireError(RejectReason.OTHER_SESSION, "of an earlier start of the router, or of another address")
            check_hmac(data, self._secret)
        if not self._secret or one.challenge != NO_CHALLENGE:
            self._place(one.robot, origin, now_us)
        answer = StopDatagram(Kind.ANSWER, one.robot, one.counter, challenge, keyed=bool(self._secret))
        return [(pack_stop(answer, self._secret), origin)]

    def _place(self, robot: str, origin: Origin, now_us: int) -> None:
        """Store the address of a robot. A robot that still registers is never forgotten for another sender."""
        if robot not in self._robots and len(self._robots) >= MAX_ROBOTS:
            quiet = next((name for name, places in self._robots.items() if not _is_fresh(places, now_us)), None)
            if quiet is None:
                return
            del self._robots[quiet]
        places = self._robots.setdefault(robot, {})
        host = origin[1][0]
        if host not in places and len(places) >= MAX_PLACES:
            oldest = min(places, key=lambda name: places[name][1])
            if now_us - places[oldest][1] < _FRESH_US:
                return
            del places[oldest]
        places[host] = origin, now_us


def _is_fresh(places: dict[str, tuple[Origin, int]], now_us: int) -> bool:
    return any(now_us - seen_us < _FRESH_US for _, seen_us in places.values())
