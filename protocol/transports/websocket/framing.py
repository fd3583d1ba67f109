"""The sub-protocol `sightline.v1`: hello, framing of channel messages, and the codec of one peer. Pure.

    uint16 BE length of the header block | header block | payload

The header block is the message's header, a JSON object, with `"channel"` put in as its first field. A header that is no
object with fields (most of all none) follows an object of its own: `{"channel":"twist","source":"guest"}`.
"""

import json
import re
from collections.abc import Hashable
from typing import Annotated, Any, Final, NamedTuple, Protocol

from pydantic import Field

from sightline.protocol import VERSION
from sightline.protocol.channels import CHANNELS, KEY_PREFIX, MAX_HEADER_BYTES, Channel
from sightline.protocol.codec import decode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import RobotId, SessionId, Version, WireModel
from sightline.protocol.transports.link import Message

SUBPROTOCOL: Final = "sightline.v1"
MAX_BLOCK_BYTES: Final = MAX_HEADER_BYTES + 64
"""Security limit: a header and the names in front of it."""
MAX_HELLO_BYTES: Final = 1024
"""Security limit: the text of a hello; also the least that a peer must be ready to receive as one message."""

_LENGTH_BYTES: Final = 2
_WITHOUT_SOURCE: Final = frozenset(name.encode("ascii") for name, row in CHANNELS.items() if not row.has_source)
_FIRST: Final = re.compile(rb'\{"channel":"([^"\\]{1,64})",(?=")')
_ALONE: Final = re.compile(rb'\{"channel":"([^"\\]{1,64})"(?:,"source":"([^"\\]{0,64})")?\}')


class Hello(WireModel):
    """Who a peer is and what it wants; the first message each way, as JSON text, sent again when `wants` changes."""

    v: Version = VERSION
    robot: RobotId = Field(description="the robot's id; of a peer that connects, the one that it means")
    role: str = Field(
        default="",
        pattern=r"^([a-z][a-z0-9_]{0,15})?$",
        description="`source` of what the sender sends towards the robot; empty or `robot` for a robot",
    )
    session: SessionId = Field(description="the sender's start: 8 hex digits drawn at random")
    wants: tuple[Annotated[str, Field(max_length=32)], ...] = Field(
        default=(), max_length=32, description="channels that the other end is to send; unknown names are ignored"
    )


class IncomingMessage(NamedTuple):
    """What came off the wire; the key is made of what the peer claimed and is still to be checked."""

    key: str
    header: bytes
    payload: bytes


def parse_hello(text: str) -> Hello:
    """Read a hello. Raises WireError MALFORMED or UNSUPPORTED_VERSION."""
    return decode(Hello, text.encode("utf-8", "surrogatepass"), MAX_HELLO_BYTES)


def pack(channel: Channel, source: str, role: str, header: bytes, payload: bytes) -> bytes:
    """One binary message from a peer whose hello said `role`."""
    return b"".join(pack_pieces(channel, source, role, header, payload))


def pack_pieces(channel: Channel, source: str, role: str, header: bytes, payload: bytes) -> tuple[bytes, bytes]:
    """The same in two pieces, the second being `payload` itself: a picture need not be copied."""
    if header[:2] == b'{"' and source in ("", role):
        block = b'{"channel":"%b",%b' % (channel.name.encode("ascii"), header[1:])
    else:
        named = f',"source":"{source}"' if source else ""
        block = f'{{"channel":"{channel.name}"{named}}}'.encode("ascii") + header
    return len(block).to_bytes(_LENGTH_BYTES) + block, payload


def unpack(message: bytes, robot: str, role: str) -> IncomingMessage:
    """Take a binary message of a peer apart; `robot` and `role` are those of its hello.

    The source of a message is its header's, else that of the hello. Raises WireError MALFORMED for broken framing.
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
    if first is not None and first[1] in _WITHOUT_SOURCE:  # most bytes of a link: no need to look any further
        return IncomingMessage(_key(robot, first[1].decode("ascii"), ""), b"{" + block[first.end() :], payload)
    fields = _fields(block)
    name = fields.get("channel") if first is None else first[1].decode("utf-8", "replace")
    if not isinstance(name, str):
        raise WireError(RejectReason.MALFORMED, "the header block is no JSON object that names its channel")
    source = fields.get("source", role)
    header = block if first is None else b"{" + block[first.end() :]
    return IncomingMessage(_key(robot, name, source if isinstance(source, str) else ""), header, payload)


def _fields(block: bytes) -> dict[str, Any]:
    """The block as an object; empty for what is none, which who decodes the header will refuse with a reason."""
    try:
        fields = json.loads(block)
    except (ValueError, RecursionError):
        return {}
    return fields if isinstance(fields, dict) else {}


def _key(robot: str, name: str, source: str) -> str:
    channel = CHANNELS.get(name)
    tail = f"/{source}" if channel is not None and channel.has_source and source else ""
    return f"{KEY_PREFIX}/{robot}/{name}{tail}"


# What is said to one WebSocket peer: what a dialect is, and `sightline.v1`. Pure.  A dialect turns publications into
# messages and messages into packets; whose turn it is and the socket are not its own.


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


class PeerCodec(Protocol):
    """One peer's way of speaking."""

    text: bool
    """Whether `write` gives text."""

    @property
    def wants(self) -> tuple[str, ...]:
        """Channels that the peer said it wants; of a dialect without words for it none."""
        ...

    def subscribes_to(self, channel: Channel) -> bool:
        """Whether the peer wants `channel`."""
        ...

    @property
    def form(self) -> Hashable:
        """Equal for peers that are sent the same bytes."""
        ...

    def write(self, message: Message) -> tuple[bytes, ...]:
        """A publication as one message of the transport, in as many pieces as it is made of."""
        ...

    def note_sent(self, message: Message) -> None:
        """Take note that this peer is now being sent `message`."""
        ...

    def note_gone(self) -> None:
        """Take note that the connection has ended."""
        ...

    def read(self, message: str | bytes) -> list[IncomingMessage]:
        """What a message says, oldest first. Raises PeerError to drop the peer, WireError to drop just the message."""
        ...

    def bound(self, wanted_bytes: int, /) -> int:
        """Security limit on a message from the peer in bytes; `wanted_bytes` is the largest payload this end wants."""
        ...


class SightlineV1:
    """`sightline.v1` with a peer of `robot`; `role` is this end's own. Until it says hello, the peer wants nothing."""

    text = False

    def __init__(self, robot: str, role: str) -> None:
        self._robot, self._role = robot, role
        self.peer_role = ""
        """As its hello says."""
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
        """Take the peer's hello. Raises PeerError, whose text a person can read, for none or another robot's."""
        try:
            hello = parse_hello(text)
        except WireError as error:
            raise PeerError(BAD_HELLO, 1008, f"this text is no hello: {error.detail}") from None
        if hello.robot != self._robot:
            raise PeerError(OTHER_ROBOT, 1008, f"this is robot {self._robot}, not {hello.robot}")
        self.peer_role, self.wants = hello.role, hello.wants
