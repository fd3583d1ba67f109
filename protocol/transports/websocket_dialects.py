"""What is said to one WebSocket peer: what a dialect is, and `sightline.v1`. Pure.

A dialect turns publications into messages and messages into packets; whose turn it is and the socket are not its own.
"""

from collections.abc import Hashable
from typing import Final, Protocol

from sightline.protocol.channels import Channel
from sightline.protocol.errors import WireError
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.websocket.framing import (
    MAX_BLOCK_BYTES,
    MAX_HELLO_BYTES,
    IncomingMessage,
    pack_pieces,
    parse_hello,
    unpack,
)

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

    def hears(self, channel: Channel) -> bool:
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

    def hears(self, channel: Channel) -> bool:
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
