"""What one end of WebSocket connections wants to hear, and who is called with it. Pure.

That is what it subscribed to; and where all connect, what is said only while watched, as long as one of them watches.
"""

from collections.abc import Callable, Sequence
from typing import Protocol

from sightline.protocol.channels import CHANNELS, Channel
from sightline.protocol.codec import encode
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.link_rules import LinkRules
from sightline.protocol.transports.websocket.framing import Hello

Callback = Callable[[Message], None]
_WATCHED = tuple(one for one in CHANNELS.values() if one.while_watched)


class Subscriber(Protocol):
    """Another end."""

    def hears(self, channel: Channel) -> bool:
        """Whether it wants `channel`."""
        ...

    def limit(self, wanted_bytes: int) -> None:
        """Accept no larger messages than what is wanted makes necessary."""
        ...

    def tell(self, hello: str) -> None:
        """Say it who this end is and what it wants."""
        ...


class Subscriptions:
    """The wants of one link. `told` is what its peers know of them."""

    def __init__(self, rules: LinkRules, session: str) -> None:
        self._rules, self._session = rules, session
        self._callbacks: dict[str, list[Callback]] = {}
        self.told: tuple[str, ...] = ()

    def add(self, channel: Channel, callback: Callback) -> None:
        """One more that is called for `channel`."""
        self._callbacks.setdefault(channel.name, []).append(callback)

    def drop(self, channel: Channel) -> None:
        """Nobody is called for `channel` any more."""
        self._callbacks.pop(channel.name, None)

    def of(self, channel: Channel) -> tuple[Callback, ...]:
        """Who is called for `channel`."""
        return tuple(self._callbacks.get(channel.name, ()))

    def hello(self) -> str:
        """The hello that says what was told last."""
        about = Hello(robot=self._rules.robot, role=self._rules.role, session=self._session, wants=self.told)
        return encode(about).decode("utf-8")

    def bound(self) -> int:
        """The largest payload of what was told last, in bytes."""
        return max((self._rules.payload_bound(CHANNELS[name]) for name in self.told), default=0)

    def tell(self, peer: Subscriber) -> None:
        """Tell one peer what the others were told."""
        peer.limit(self.bound())
        peer.tell(self.hello())

    def retell(self, peers: Sequence[Subscriber], passing_on: bool) -> None:
        """Tell all `peers` what is wanted now, if it changed. `passing_on`: what one says is for the others too."""
        watched = (one.name for one in _WATCHED if passing_on and any(peer.hears(one) for peer in peers))
        names = tuple(dict.fromkeys((*self._callbacks, *watched)))
        if names != self.told:
            self.told = names
            for peer in peers:
                self.tell(peer)
