"""What is said to one WebSocket peer: `sightline.v1`, or the older text dialect from either end. Pure.

A dialect turns publications into messages and messages into packets; whose turn it is and the socket are not its own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

from protocol.channels import ACK, FRAME, KEY_PREFIX, TWIST, Channel, key_for
from protocol.codec import decode, encode
from protocol.errors import WireError
from protocol.legacy import decode_picture, encode_picture, parse_dashed, text_bound
from protocol.messages import AnswerHeader, Echo, FrameHeader
from protocol.transports.link import Message
from protocol.transports.websocket_framing import (
    MAX_BLOCK_BYTES,
    MAX_HELLO_BYTES,
    Packet,
    pack,
    parse_hello,
    unpack,
)
from protocol.twist_text import format_twist

GUEST: Final = "guest"
GUEST_SESSION: Final = "00000000"
"""The session of everybody who speaks without headers."""
MAX_COMMAND_TEXT_BYTES: Final = 256
"""Security limit: a text towards a robot; a twist over its own 64 bytes is still counted, not a reason to hang up."""

BAD_HELLO: Final = "BAD_HELLO"
"""Counted for a first message, or a later text, that is no hello."""
OTHER_ROBOT: Final = "OTHER_ROBOT"
"""Counted for a hello that names another robot."""
BAD_FRAMING: Final = "BAD_FRAMING"
"""Counted for a message of the wrong kind, or one that cannot be taken apart."""


class PeerError(Exception):
    """A peer must be dropped: `code` and the text are its close code and reason, `counted` is what it counts as."""

    def __init__(self, counted: str, code: int, reason: str) -> None:
        super().__init__(reason)
        self.counted = counted
        self.code = code


class Dialect(Protocol):
    """One peer's way of speaking."""

    text: bool
    """Whether `write` gives text."""

    def hears(self, channel: Channel) -> bool:
        """Whether the peer wants `channel`."""
        ...

    def write(self, message: Message) -> bytes:
        """A publication as one message of the transport."""
        ...

    def read(self, message: str | bytes) -> list[Packet]:
        """What a message says, oldest first. Raises PeerError to drop the peer, WireError to drop just the message."""
        ...

    def bound(self, wanted_bytes: int, /) -> int:
        """Security limit on a message from the peer in bytes; `wanted_bytes` is the largest payload this end wants."""
        ...


class V1:
    """`sightline.v1` with a peer of `robot`; `role` is this end's own. Until it says hello, the peer wants nothing."""

    text = False

    def __init__(self, robot: str, role: str) -> None:
        self._robot, self._role = robot, role
        self._peer_role = ""
        self._wants: tuple[str, ...] = ()

    def hears(self, channel: Channel) -> bool:
        return channel.name in self._wants

    def write(self, message: Message) -> bytes:
        return pack(message.channel, message.source, self._role, message.header, message.payload)

    def read(self, message: str | bytes) -> list[Packet]:
        if isinstance(message, str):
            self.accept(message)
            return []
        try:
            return [unpack(message, self._robot, self._peer_role)]
        except WireError as error:
            raise PeerError(BAD_FRAMING, 1007, error.detail) from None

    def bound(self, wanted_bytes: int, /) -> int:
        return max(MAX_HELLO_BYTES, 2 + MAX_BLOCK_BYTES + wanted_bytes)

    def accept(self, text: str) -> None:
        """Take the peer's hello. Raises PeerError, whose text a person can read, for none or another robot's."""
        try:
            hello = parse_hello(text)
        except WireError as error:
            raise PeerError(BAD_HELLO, 1008, f"this text is no hello: {error.detail}") from None
        if hello.robot != self._robot:
            raise PeerError(OTHER_ROBOT, 1008, f"this is robot {self._robot}, not {hello.robot}")
        self._peer_role, self._wants = hello.role, hello.wants


@dataclass(frozen=True, slots=True)
class LegacyOptions:
    """How the older dialect is spoken: line ends in the base64 text, and `linear-angular` instead of the bar."""

    newlines: bool = True
    dashed: bool = False


class LegacyToVision:
    """The robot's end of the older dialect: pictures out as base64, `linear|angular` in, as source `guest`.

    Such a peer cannot acknowledge. Each of its twists is also taken as the answer to the newest picture it was sent,
    so that it gets pictures at the rate of its own answers.
    """

    text = True

    def __init__(self, robot: str, options: LegacyOptions, now_us: Callable[[], int]) -> None:
        """`now_us` reads a monotonic clock."""
        self._robot, self._options, self._now_us = robot, options, now_us
        self._sent: tuple[bytes, int] | None = None
        self._answers = 0

    def hears(self, channel: Channel) -> bool:
        return channel is FRAME

    def write(self, message: Message) -> bytes:
        text = encode_picture(message.payload, self._options.newlines)
        self._sent = message.header, self._now_us()
        return text

    def read(self, message: str | bytes) -> list[Packet]:
        if isinstance(message, bytes):
            raise PeerError(BAD_FRAMING, 1003, "binary message; this port speaks text: linear|angular")
        twist = Packet(key_for(self._robot, TWIST, GUEST), b"", self._barred(message.encode("utf-8", "surrogatepass")))
        return [twist, *self._acknowledgement()]

    def bound(self, _wanted_bytes: int, /) -> int:
        return MAX_COMMAND_TEXT_BYTES

    def _barred(self, text: bytes) -> bytes:
        """The twist with a bar. What is no twist stays as it is: the robot refuses it, and says why in `status`."""
        try:
            return format_twist(parse_dashed(text)) if self._options.dashed else text
        except WireError:
            return text

    def _acknowledgement(self) -> list[Packet]:
        sent, self._sent = self._sent, None
        if sent is None:
            return []
        header, sent_us = sent
        try:
            frame = decode(FrameHeader, header)
        except WireError:  # published without one: there is no credit to return
            return []
        self._answers += 1
        echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
        # How much of the time was computing is unknown; called computing, none of it widens the window.
        spent_us = max(0, self._now_us() - sent_us)
        answer = AnswerHeader(source=GUEST, session=GUEST_SESSION, seq=self._answers, echo=echo, compute_us=spent_us)
        return [Packet(key_for(self._robot, ACK, GUEST), encode(answer), b"")]


class LegacyToRobot:
    """Vision's end of the older dialect: base64 text in as frames, twists out as bare text.

    The header of a frame is made up here: the session stands for this connection, `t_us` is the time of arrival on
    this machine's clock, and what the robot did is not known.
    """

    text = True

    def __init__(
        self, robot: str, options: LegacyOptions, now_us: Callable[[], int], session: str, max_frame_bytes: int
    ) -> None:
        """`session` is 8 hex digits, new for each connection; `now_us` reads a monotonic clock."""
        self._robot, self._options, self._now_us = robot, options, now_us
        self._session, self._max_frame_bytes = session, max_frame_bytes
        self._seq = 0
        self._last_us = -1

    def hears(self, channel: Channel) -> bool:
        return channel is TWIST

    def write(self, message: Message) -> bytes:
        return message.payload.replace(b"|", b"-") if self._options.dashed else message.payload

    def read(self, message: str | bytes) -> list[Packet]:
        if isinstance(message, bytes):
            raise PeerError(BAD_FRAMING, 1003, "binary message; the older dialect is text: base64 pictures")
        jpeg = decode_picture(message.encode("utf-8", "surrogatepass"), self._max_frame_bytes)
        self._seq += 1
        self._last_us = max(self._now_us(), self._last_us + 1)
        header = FrameHeader(session=self._session, seq=self._seq, t_us=self._last_us)
        return [Packet(f"{KEY_PREFIX}/{self._robot}/{FRAME.name}", encode(header), jpeg)]

    def bound(self, _wanted_bytes: int, /) -> int:
        return text_bound(self._max_frame_bytes)
