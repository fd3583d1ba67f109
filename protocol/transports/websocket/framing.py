"""Implement the sub-protocol `sightline.v1`: hello, framing of messages, and the codec of one peer. Pure.

    uint16 BE length of the header block | header block | payload

The header block is the header of the message, a JSON object, with `"channel"` as its first field. A separate object
precedes a header that is empty, is not an object with fields, or does not name the source of the message:
`{"channel":"twist","source":"guest"}`.
"""

import json
import re
from collections.abc import Hashable
from typing import Annotated, Any, Final, NamedTuple, Protocol

from pydantic import Field

from sightline.protocol import ROLE_PATTERN, VERSION
from sightline.protocol.channels import CHANNELS, KEY_PREFIX, MAX_HEADER_BYTES, Channel
from sightline.protocol.codec import decode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import RobotId, SessionId, Version, WireModel
from sightline.protocol.transports.link import Message

SUBPROTOCOL: Final = "sightline.v1"
# Security limit: a header with the added names.
MAX_BLOCK_BYTES: Final = MAX_HEADER_BYTES + 64
# Security limit: the text of a hello. Every peer must accept a message of this size.
MAX_HELLO_BYTES: Final = 1024

_LENGTH_BYTES: Final = 2
_WITHOUT_SOURCE: Final = frozenset(name.encode("ascii") for name, row in CHANNELS.items() if not row.has_source)
_FIRST: Final = re.compile(rb'\{"channel":"([^"\\]{1,64})",')
_ALONE: Final = re.compile(rb'\{"channel":"([^"\\]{1,64})"(?:,"source":"([^"\\]{0,64})")?\}')


class Hello(WireModel):
    """Names a peer and its wanted channels. It is the first message each way. A change of `wants` repeats it."""

    v: Version = VERSION
    robot: RobotId = Field(description="the robot's id; from a connecting peer the robot that it requests")
    role: str = Field(
        default="",
        pattern=f"^({ROLE_PATTERN})?$",
        description="`source` of the sender's messages toward the robot; empty or `robot` for a robot",
    )
    session: SessionId = Field(description="the sender's start: 8 hex digits drawn at random")
    wants: tuple[Annotated[str, Field(max_length=32)], ...] = Field(
        default=(), max_length=32, description="channels that the other end must send; unknown names are ignored"
    )


class IncomingMessage(NamedTuple):
    """A message from the wire. The key contains unchecked claims of the peer."""

    key: str
    header: bytes
    payload: bytes


def parse_hello(text: str) -> Hello:
    """Read a hello. Raises WireError MALFORMED or UNSUPPORTED_VERSION."""
    return decode(Hello, text.encode("utf-8", "surrogatepass"), MAX_HELLO_BYTES)


def pack(channel: Channel, source: str, role: str, header: bytes, payload: bytes) -> bytes:
    """Pack a message.

    Args:
        channel: the channel.
        source: source of the message, or "" from a robot.
        role: role in the hello of this end: the source of a message whose header names none.
        header: encoded header, may be empty.
        payload: encoded payload.

    Returns:
        One binary WebSocket message.
    """
    return b"".join(pack_pieces(channel, source, role, header, payload))


def pack_pieces(channel: Channel, source: str, role: str, header: bytes, payload: bytes) -> tuple[bytes, bytes]:
    """Pack a message in two pieces. The second is `payload` itself, which avoids a copy of the image."""
    # Parsed only for a forwarded message, because the source of own messages is known.
    if header[:2] == b'{"' and (source in ("", role) or _fields(header).get("source") == source):
        block = b'{"channel":"%b",%b' % (channel.name.encode("ascii"), header[1:])
    else:
        named = f',"source":"{source}"' if source else ""
        block = f'{{"channel":"{channel.name}"{named}}}'.encode("ascii") + header
    return len(block).to_bytes(_LENGTH_BYTES) + block, payload


def unpack(message: bytes, robot: str, role: str) -> IncomingMessage:
    """Unpack a binary message of a peer.

    Args:
        message: one binary WebSocket message.
        robot: robot id of its hello.
        role: role of its hello: the source of a message whose header names none.

    Raises:
        WireError: MALFORMED for broken framing.
    """
    size = int.from_bytes(message[:_LENGTH_BYTES])
    if len(message) < _LENGTH_BYTES + size or size > MAX_BLOCK_BYTES:
        raise WireError(RejectReason.MALFORMED, f"header block of {size} bytes in a message of {len(message)}")
    block, payload = message[_LENGTH_BYTES : _LENGTH_BYTES + size], message[_LENGTH_BYTES + size :]
    alone = _ALONE.match(block)
    if alone is not None:
        source = role if alone[2] is None else alone[2].decode("utf-8", "replace")
        return IncomingMessage(_key(robot, alone[1].decode("utf-8", "replace"), source), block[alone.end() :], payload)
    first = _FIRST.match(block)
    if first is not None and first[1] in _WITHOUT_SOURCE:  # frames are most of the bytes, and need no JSON parser here
        return IncomingMessage(_key(robot, first[1].decode("ascii"), ""), b"{" + block[first.end() :], payload)
    fields = _fields(block)
    name = fields.get("channel") if first is None else first[1].decode("utf-8", "replace")
    if not isinstance(name, str):
        raise WireError(RejectReason.MALFORMED, "the header block is not a JSON object with a channel")
    source = fields.get("source", role)
    header = block if first is None else b"{" + block[first.end() :]
    return IncomingMessage(_key(robot, name, source if isinstance(source, str) else ""), header, payload)


def _fields(block: bytes) -> dict[str, Any]:
    """Parse the block as an object. Returns {} for other data, which the decoder of the header then rejects."""
    try:
        fields = json.loads(block)
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) else {}


def _key(robot: str, name: str, source: str) -> str:
    channel = CHANNELS.get(name)
    tail = f"/{source}" if channel is not None and channel.has_source and source else ""
    return f"{KEY_PREFIX}/{robot}/{name}{tail}"


# The codec of one WebSocket peer: the interface, and `sightline.v1`. Pure.
#
# A codec converts publications to messages, and messages to packets. It does not know the order of sending or the
# socket.


# Counter of first messages, or later texts, that are not a hello.
BAD_HELLO: Final = "BAD_HELLO"
# Counter of hellos that name another robot.
OTHER_ROBOT: Final = "OTHER_ROBOT"
# Counter of messages of the wrong kind, or with broken framing.
BAD_FRAMING: Final = "BAD_FRAMING"


class PeerError(Exception):
    """A peer must be dropped. `code` and the text are the close code and reason, `counted` is the counter."""

    def __init__(self, counted: str, code: int, reason: str) -> None:
        super().__init__(reason)
        self.counted = counted
        self.code = code


class PeerCodec(Protocol):
    """Encodes and decodes the messages of one peer."""

    text: bool
    """True if `write` returns text."""

    @property
    def wants(self) -> tuple[str, ...]:
        """Return the channels that the peer requested. Always empty in the legacy protocol."""
        ...

    def subscribes_to(self, channel: Channel) -> bool:
        """Return True if the peer wants `channel`."""
        ...

    @property
    def form(self) -> Hashable:
        """Return a value that is equal for peers that receive the same bytes."""
        ...

    def write(self, message: Message) -> tuple[bytes, ...]:
        """Encode a publication as one message, in one or more pieces."""
        ...

    def note_sent(self, message: Message) -> None:
        """Note that `message` is being sent to this peer."""
        ...

    def note_gone(self) -> None:
        """Note that the connection has ended."""
        ...

    def read(self, message: str | bytes) -> list[IncomingMessage]:
        """Decode a message into packets, oldest first.

        Raises:
            PeerError: the peer must be dropped.
            WireError: only the message must be dropped.
        """
        ...

    def bound(self, wanted_bytes: int, /) -> int:
        """Return the security limit for one message, in bytes. `wanted_bytes` is the largest payload of this end."""
        ...


class SightlineV1:
    """Codec of `sightline.v1` for a peer of `robot`. `role` is the local role. Before its hello a peer wants nothing.

    `connects` is True at the connecting end.
    """

    text = False

    def __init__(self, robot: str, role: str, *, connects: bool = False) -> None:
        self._robot, self._role, self._connects = robot, role, connects
        self.peer_role = ""
        """Role in the hello of the peer."""
        self.wants: tuple[str, ...] = ()

    @property
    def form(self) -> Hashable:
        return SightlineV1

    def subscribes_to(self, channel: Channel) -> bool:
        return channel.name in self.wants

    def write(self, message: Message) -> tuple[bytes, ...]:
        return pack_pieces(message.channel, message.source, self._role, message.header, message.payload)

    def note_sent(self, message: Message) -> None:
        pass

    def note_gone(self) -> None:
        pass

    def read(self, message: str | bytes) -> list[IncomingMessage]:
        if isinstance(message, str):
            self.accept(message)
            return []
        try:
            return [unpack(message, self._robot, self.peer_role)]
        except WireError as error:
            raise PeerError(BAD_FRAMING, 1007, error.detail) from None

    def bound(self, wanted_bytes: int, /) -> int:
        return max(MAX_HELLO_BYTES, 2 + MAX_BLOCK_BYTES + wanted_bytes)

    def accept(self, text: str) -> None:
        """Process the hello of the peer. Raises PeerError for an invalid hello, and for another robot."""
        try:
            hello = parse_hello(text)
        except WireError as error:
            raise PeerError(BAD_HELLO, 1008, f"invalid hello: {error.detail}") from None
        if hello.robot != self._robot:
            # A listening end describes itself to the other end. A connecting end describes the peer, because its own
            # operator reads the text.
            text = f"this is robot {self._robot}, not {hello.robot}"
            if self._connects:
                text = f"the robot there is {hello.robot}, not {self._robot}"
            raise PeerError(OTHER_ROBOT, 1008, text)
        self.peer_role, self.wants = hello.role, hello.wants
