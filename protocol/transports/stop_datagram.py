"""The STOP datagram: one fixed size both ways, and with keys an HMAC. Pure; standard library only.

    0   4  `STOP`                           48  16  challenge: random at each start of the receiver
    4   1  version, 1                       64   8  number of valid STOPs that the receiver has counted
    5   1  kind: `Kind`                     72   8  newest of those numbers that the driver process has applied
    6   1  state: index in `STATES`         80  32  HMAC-SHA256 of bytes 0 to 79, or zeros
    7   1  bit 0: wheels at zero, bit 1: latch on disk, bit 2: the receiver accepts only an HMAC
    8  32  robot id, filled with zeros
    40  8  counter of the sender            all integers big-endian; the sender of a STOP leaves 6, 7, 64 and 72 zero

An answer is not longer than the request, so that the port cannot amplify traffic to a forged address.
"""

import struct
from _operator import _compare_digest as compare_digest
from enum import IntEnum
from typing import Final, NamedTuple

from sightline.protocol.errors import RejectReason, WireError

try:
    from _sha2 import sha256  # type: ignore[import-not-found]  # Python 3.12 and later
except ImportError:
    from _sha256 import sha256  # type: ignore[import-not-found]

STOP_PORT: Final = 7448
"""UDP port next to the default port of a link. For any other port of a link it is the next higher port, too."""
DATAGRAM_BYTES: Final = 112
CHALLENGE_BYTES: Final = 16
NO_CHALLENGE: Final = bytes(CHALLENGE_BYTES)
STOP_SLOW_S: Final = 0.3
"""Time without proof of a STOP after which the operator is warned."""
STATES: Final = ("", "DISARMED", "HOLD", "ACTIVE", "DEGRADED", "STOPPED", "FAULT")
"""States of the gate by their number in a datagram. The first one means that the driver process is silent."""
STOPPED: Final = STATES.index("STOPPED")
_FORM: Final = struct.Struct(">4s4B32sQ16sQQ")
_MAGIC: Final = b"STOP"
_VERSION: Final = 1
_HMAC_BYTES, _BLOCK_BYTES = 32, 64
_INNER, _OUTER = (bytes(byte ^ pad for byte in range(256)) for pad in (0x36, 0x5C))
_AT_REST, _STORED, _KEYED = 1, 2, 4


class Kind(IntEnum):
    """Purpose of a datagram."""

    STOP = 1
    """To a receiver. With `NO_CHALLENGE`, a receiver with a secret only answers with its challenge."""
    ANSWER = 2
    """From a receiver, with the counter of the request."""
    REGISTER = 3
    """From a receiver to a router: forward the STOPs of this robot to the sender of this datagram."""


class StopDatagram(NamedTuple):
    """One datagram. Only an answer uses the fields after `challenge`."""

    kind: Kind
    robot: str
    counter: int
    challenge: bytes = NO_CHALLENGE
    state: int = 0
    at_rest: bool = False
    stored: bool = False
    keyed: bool = False
    received: int = 0
    applied: int = 0


def pack_stop(one: StopDatagram, secret: bytes = b"") -> bytes:
    """Encode a datagram, with an HMAC if there is a secret."""
    flags = _AT_REST * one.at_rest | _STORED * one.stored | _KEYED * one.keyed
    head = _FORM.pack(_MAGIC, _VERSION, one.kind, one.state, flags, one.robot.encode("ascii"), one.counter,
                      one.challenge, one.received, one.applied)
    return head + (_hmac(head, secret) if secret else bytes(_HMAC_BYTES))


def unpack_stop(data: bytes) -> StopDatagram:
    """Decode a datagram in constant time. Does not check the HMAC.

    Raises:
        WireError: MALFORMED, or UNSUPPORTED_VERSION.
    """
    if len(data) != DATAGRAM_BYTES:
        raise WireError(RejectReason.MALFORMED, f"a STOP datagram has {DATAGRAM_BYTES} bytes")
    magic, version, kind, state, flags, robot, counter, challenge, received, applied = _FORM.unpack_from(data)
    if magic != _MAGIC:
        raise WireError(RejectReason.MALFORMED, "a STOP datagram begins with STOP")
    if version != _VERSION:
        raise WireError(RejectReason.UNSUPPORTED_VERSION, f"version {version % 256}, expected {_VERSION}")
    name = robot.rstrip(b"\0")
    if not Kind.STOP <= kind <= Kind.REGISTER or state >= len(STATES) or not name.isascii():
        raise WireError(RejectReason.MALFORMED, "unknown kind or state, or an invalid robot id")
    return StopDatagram(Kind(kind), name.decode("ascii"), counter, challenge, state, bool(flags & _AT_REST),
                        bool(flags & _STORED), bool(flags & _KEYED), received, applied)


def challenge_of(seed: bytes, host: str, port: int) -> bytes:
    """Return the challenge for one address. It needs no memory.

    Args:
        seed: random bytes of this start.
        host: address of the peer, as the kernel writes it.
        port: its UDP port.
    """
    return _hmac(f"{host} {port}".encode(), seed)[:CHALLENGE_BYTES]


def check_hmac(data: bytes, secret: bytes) -> None:
    """Raise WireError WRONG_KEY unless `data` ends in the HMAC of `secret`. Takes constant time."""
    # In constant time, because otherwise the time of the answer reveals the correct part of a guess.
    if not compare_digest(data[_FORM.size :], _hmac(data[: _FORM.size], secret)):
        raise WireError(RejectReason.WRONG_KEY, "the HMAC is not that of this STOP secret")


def _hmac(head: bytes, secret: bytes) -> bytes:
    """Return HMAC-SHA256. The module `hmac` would load OpenSSL, 3 MB. Source: RFC 2104."""
    key = (secret if len(secret) <= _BLOCK_BYTES else sha256(secret).digest()).ljust(_BLOCK_BYTES, b"\0")
    inner = sha256(key.translate(_INNER) + head).digest()
    return bytes(sha256(key.translate(_OUTER) + inner).digest())


# The sender of STOP: the datagrams to send, and the answers that prove the stop.


_UNANSWERED: Final = 5
"""STOPs in a row without an answer, after which the receiver may have restarted with another challenge."""
_RECENT: Final = 25
"""Number of datagrams, half a second of them. A receiver without an answer to any of them is gone."""
_MAX_RECEIVERS: Final = 8
"""Security limit: receivers, by their challenges, that count for one STOP."""


class StopRequests:
    """STOP of one robot, for one sender. The caller sends `datagrams()` repeatedly and passes each answer."""

    def __init__(self, robot: str, secret: bytes, counter: int) -> None:
        """Begin a STOP.

        Args:
            robot: robot id.
            secret: STOP secret, or b"" without keys.
            counter: random start below 2^63. A third party cannot guess a counter that was sent.
        """
        self.answer: StopDatagram | None = None
        """Newest answer."""
        self.has_other_secret = False
        """True if an answer had the HMAC of another secret."""
        self._receivers: dict[bytes, tuple[StopDatagram, int | None]] = {}
        """Challenge -> newest answer, and number of this STOP. The applied number must be at least this number."""
        self._robot, self._secret = robot, secret
        self._first = self._next = counter
        self._unanswered = 0

    def datagrams(self) -> list[bytes]:
        """Return the datagrams to send now: a STOP, and with a secret the challenge request until it is known."""
        challenges = sorted(self._live(), key=lambda challenge: -self._receivers[challenge][0].counter)
        if not challenges or (self._secret and self._unanswered >= _UNANSWERED):
            challenges.insert(0, NO_CHALLENGE)
        self._unanswered += 1
        return [self._pack(challenge) for challenge in challenges]

    def _pack(self, challenge: bytes) -> bytes:
        self._next += 1
        return pack_stop(StopDatagram(Kind.STOP, self._robot, self._next, challenge), self._secret)

    def on_datagram(self, data: bytes) -> bool:
        """Process a received datagram. Returns True for a new challenge: send the STOP immediately.

        Only an answer to this STOP counts, with a secret only with its HMAC.
        """
        try:
            one = unpack_stop(data)
            if one.kind is not Kind.ANSWER or one.robot != self._robot or not self._first < one.counter <= self._next:
                return False
            if self._secret:
                check_hmac(data, self._secret)
        except WireError as error:
            self.has_other_secret |= error.reason is RejectReason.WRONG_KEY
            return False
        self._unanswered = 0
        # Another challenge is another start of the receiver, or a second robot with this id, with its own numbers.
        self._receivers = self._live()
        is_new = one.challenge not in self._receivers
        if is_new and len(self._receivers) >= _MAX_RECEIVERS:
            return False
        since = None if is_new else self._receivers[one.challenge][1]
        # An answer to a challenge request has no number, because the request is not counted as a STOP.
        if one.received:
            since = min(one.received, since or one.received)
        self.answer, self._receivers[one.challenge] = one, (one, since)
        return is_new and bool(self._secret)

    def _live(self) -> dict[bytes, tuple[StopDatagram, int | None]]:
        """Return the receivers that answered one of the last datagrams, or else the one that answered last."""
        return {challenge: known for challenge, known in self._receivers.items()
                if known[0] is self.answer or known[0].counter > self._next - _RECENT}

    @property
    def is_latched(self) -> bool:
        """Return True once the robot has applied this STOP. Its wheels may still turn."""
        return self.answer is not None and all(
            since is not None and one.applied >= since and one.state == STOPPED for one, since in self._live().values())

    @property
    def is_stopped(self) -> bool:
        """Return True once the robot has applied this STOP and its wheels are at zero."""
        return self.is_latched and all(one.at_rest for one, _ in self._live().values())

    @property
    def is_stored(self) -> bool:
        """Return True if the STOP is on the disk of the robot, too."""
        return self.is_stopped and all(one.stored for one, _ in self._live().values())

    @property
    def lacks_secret(self) -> bool:
        """Return True if the receiver accepts only datagrams with an HMAC, and this side has no secret."""
        return not self._secret and self.answer is not None and self.answer.keyed
