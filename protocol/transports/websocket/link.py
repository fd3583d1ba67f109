"""`WebSocketLink`: subscriptions and peers behind the `Link` interface. Shell.

That is what it subscribed to; and where all connect, what is said only while watched, as long as one of them watches.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Protocol

from sightline.protocol.channels import CHANNELS, FRAME, TWIST, Channel, parse_key
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.endpoints import WebSocketEndpoint, parse_websocket_endpoint
from sightline.protocol.transports.link import INEXACT_KEY, BaseLink, LinkRules, Message
from sightline.protocol.transports.websocket.client import Client as Dialer
from sightline.protocol.transports.websocket.connection import Connection
from sightline.protocol.transports.websocket.framing import Hello, IncomingMessage, PeerCodec, SightlineV1
from sightline.protocol.transports.websocket.legacy import DriverSlot, LegacyClient, LegacyToRobot, LegacyToVision
from sightline.protocol.transports.websocket.peer import Peer, Promote, Publication, exchange_hellos
from sightline.protocol.transports.websocket.server import KeyFolder, Server

_log: Final = logging.getLogger(__name__)

Callback = Callable[[Message], None]
_WATCHED = tuple(one for one in CHANNELS.values() if one.while_watched)


class Subscriber(Protocol):
    """Another end."""

    def subscribes_to(self, channel: Channel) -> bool:
        """Whether it wants `channel`."""
        ...

    def limit(self, wanted_bytes: int) -> None:
        """Accept no larger messages than what is wanted makes necessary."""
        ...

    def tell(self, hello: str) -> None:
        """Say it who this end is and what it wants."""
        ...


class Subscriptions:
    """The wants of one link. `announced` is what its peers know of them."""

    def __init__(self, rules: LinkRules, session: str) -> None:
        self._rules, self._session = rules, session
        self._callbacks: dict[str, list[Callback]] = {}
        self.announced: tuple[str, ...] = ()

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
        """The hello that says what was announced last."""
        about = Hello(robot=self._rules.robot, role=self._rules.role, session=self._session, wants=self.announced)
        return encode(about).decode("utf-8")

    def bound(self) -> int:
        """The largest payload of what was announced last, in bytes."""
        return max((self._rules.payload_bound(CHANNELS[name]) for name in self.announced), default=0)

    def tell(self, peer: Subscriber) -> None:
        """Announce to one peer what the others know."""
        peer.limit(self.bound())
        peer.tell(self.hello())

    def announce(self, peers: Sequence[Subscriber], passing_on: bool) -> None:
        """Tell all `peers` what is wanted now, if it changed. `passing_on`: what one says is for the others too."""
        watched = (one.name for one in _WATCHED if passing_on and any(peer.subscribes_to(one) for peer in peers))
        names = tuple(dict.fromkeys((*self._callbacks, *watched)))
        if names != self.announced:
            self.announced = names
            for peer in peers:
                self.tell(peer)


# WebSocket as a `Link`: `sightline.v1`, or the older text dialect, with threads; newest-only per peer. Shell.
# with open_websocket("r1", listen="ws://127.0.0.1:9090") as link:         link.publish(STATUS, header, payload)  Only
# what the table of channels calls passed on goes from peer to peer: who listens speaks with each who connects, and
# they do not hear one another.


CLOSE_S: Final = 1.5
"""A close that takes longer is left to daemon threads, so that no process hangs on a dead peer."""


def open_websocket(
    robot: str,
    *,
    listen: str | Sequence[str] = (),
    connect: str | Sequence[str] = (),
    role: str = "",
    timeout_s: float = 5.0,
    max_frame_bytes: int = FRAME.max_payload_bytes,
    secure: str = "",
) -> WebSocketLink:
    """Open a link to `robot`; use it in a `with`.

    Endpoints are `ws://host:port`, `wss://` and `ws-legacy://` (`sightline.protocol.transports.endpoints`). Who listens
    reaches `connect` in the background; a lost connection is made again by itself. `role` is the default source of what
    is published towards the robot. `secure` is a folder of tokens and certificates (`security.py`, `tls.py`).
    Raises ConfigError for a robot id, endpoint, limit or folder that is none, for an endpoint open to anybody, and for
    a missing `websockets`; LinkError for a port in use, if nobody answers within `timeout_s`, or if who answers will
    not speak.
    """
    rules = LinkRules(robot, role, max_frame_bytes)
    near, far = [[parse_websocket_endpoint(text) for text in _listed(ends)] for ends in (listen, connect)]
    if not near and not far:
        raise ConfigError("no endpoint: give one to listen on (--listen) or to connect to (--connect)")
    try:
        import websockets  # noqa: F401
    except ImportError:
        raise ConfigError("websockets is not installed: pip install 'sightline-robot[websocket]'") from None
    link = WebSocketLink(rules)
    try:
        link.open(near, far, secure)
        if not near:
            link.wait_connected(timeout_s)
    except (LinkError, ConfigError):
        link.close()
        raise
    return link


def _listed(ends: str | Sequence[str]) -> Sequence[str]:
    return (ends,) if isinstance(ends, str) else ends


class WebSocketLink(BaseLink):
    """A `Link` over any number of WebSocket connections. A link does not hear what it publishes itself."""

    def __init__(self, rules: LinkRules) -> None:
        """Made by `open_websocket`."""
        super().__init__(rules)
        self._subscriptions = Subscriptions(rules, secrets.token_hex(4))
        # Who drives comes first. Replaced, never changed, so that publishing needs no lock.
        self._peers: tuple[Peer, ...] = ()
        self._joining = threading.Lock()
        self._joined = threading.Event()
        self._listeners: list[Server] = []
        self._dialers: list[Dialer] = []
        self._in_callback = threading.local()
        self._dropped: Counter[str] = Counter()
        self._driver_slot = DriverSlot()
        self._repeat_limiter = RepeatLimiter()

    @property
    def dropped(self) -> Counter[str]:
        """As `Link`."""
        return sum((peer.queue.dropped for peer in self._peers), self._dropped)

    @property
    def connected(self) -> bool:
        """Whether at least one peer is connected; never blocks. A silent peer counts for two seconds."""
        return not self._closed and bool(self._peers)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """As `Link`."""
        self._rules.check(channel, header, payload)
        key = self._rules.key(channel, source)
        if not self.connected:
            return False
        post = Publication(Message(channel, key.rpartition("/")[2] if channel.has_source else "", header, payload))
        for peer in self._peers:
            peer.offer(post)
        return True

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback`, on a peer's thread, for every message with the exact key and within bounds."""
        with self._joining:
            self._subscriptions.add(channel, callback)
            self._announce()

    def unsubscribe(self, channel: Channel) -> None:
        """End every subscription to `channel`."""
        with self._joining:
            self._subscriptions.drop(channel)
            self._announce()

    def has_listener(self, channel: Channel) -> bool:
        """Whether a peer said that it wants `channel`; never blocks on the network."""
        return self.connected and any(peer.subscribes_to(channel) for peer in self._peers)

    def close(self) -> None:
        """Tell the peers and end it; idempotent, over within two seconds, safe even inside a callback."""
        with self._joining:
            if self._closed:
                return
            self._closed = True
        for dialer in self._dialers:
            dialer.close()
        reason, peers = f"this end of the link to robot {self.robot} is closing", self._peers
        for peer in peers:
            peer.close(reason)
        for listener in self._listeners:
            listener.close(reason)
        deadline_s = time.monotonic() + CLOSE_S
        for peer in () if getattr(self._in_callback, "now", False) else peers:  # a callback's own peer waits for it
            peer.wait_gone(max(0.0, deadline_s - time.monotonic()))

    # --- opening -------------------------------------------------------------------------------------------------

    def open(self, near: Sequence[WebSocketEndpoint], far: Sequence[WebSocketEndpoint], secure: str) -> None:
        """Listen on `near` and begin to connect to `far`. Raises what `open_websocket` does."""
        refuse, keys = self._rules.reject, KeyFolder(secure, self._rules.role)
        for end in near:
            self._listeners.append(Server(end, partial(self._serve, end), refuse, self._tell, keys))
        for end in far:
            self._dialers.append(Dialer(end, partial(self._serve, end), refuse, keys))

    def wait_connected(self, timeout_s: float) -> None:
        """Wait for the first peer. Raises LinkError with the reason if there is none."""
        deadline_s = time.monotonic() + timeout_s
        while not self._joined.wait(0.01):
            late = time.monotonic() > deadline_s
            for dialer in self._dialers:
                if dialer.trouble and (late or dialer.turned_away.is_set()):
                    raise LinkError(f"{dialer.endpoint.text} refused: {dialer.trouble}")
            if late:
                where = " or ".join(dialer.endpoint.text for dialer in self._dialers)
                raise LinkError(f"nobody answers at {where}; is the robot running? tried for {timeout_s:g} s")

    # --- peers, on threads of their own ------------------------------------------------------------------------------

    def _serve(self, end: WebSocketEndpoint, wire: Connection, settle: Promote | None = None) -> None:
        """Speak with one peer until it is gone; `settle` gives it a place where this end listens.

        Raises PeerError or ConnectionClosed if it says no proper hello.
        """
        dialect = self._dialect(end, settle is not None, "{}:{}".format(*wire.address))
        with self._joining:
            announced, hello = self._subscriptions.announced, self._subscriptions.hello()
            wanted_bytes = self._subscriptions.bound()
        peer = Peer(wire, dialect, self._on_change)
        peer.limit(wanted_bytes)
        if isinstance(dialect, SightlineV1):
            exchange_hellos(wire, dialect, hello, settle)
        elif settle is not None:
            settle("")
        if self._join(peer, announced):
            try:
                peer.run(self._deliver, self._rules.reject)
            finally:
                self._leave(peer)
                dialect.note_gone()

    def _join(self, peer: Peer, announced: tuple[str, ...]) -> bool:
        with self._joining:
            if self._closed:
                return False
            self._peers = (*self._peers, peer)
            if announced != self._subscriptions.announced:
                self._subscriptions.tell(peer)
            self._announce()
        self._joined.set()
        return True

    def _leave(self, peer: Peer) -> None:
        with self._joining:
            self._peers = tuple(other for other in self._peers if other is not peer)
            self._dropped += peer.queue.dropped
            self._announce()

    def _on_change(self) -> None:
        """A peer wants something else now, which may be what another says only while it is watched."""
        with self._joining:
            self._announce()

    def _announce(self) -> None:
        """With the lock held."""
        self._subscriptions.announce(self._peers, bool(self._listeners))

    def _put_first(self, peer: Peer) -> None:
        """Who drives is sent everything before those who watch."""
        with self._joining:
            self._peers = (peer, *(other for other in self._peers if other is not peer))

    def _pass_on(self, sender: Peer, message: Message) -> None:
        """Where all connect, what one has found is for the others too."""
        post = Publication(message)
        for peer in self._peers:
            if peer is not sender:
                peer.offer(post)

    def _dialect(self, end: WebSocketEndpoint, listening: bool, who: str) -> PeerCodec:
        if end.legacy is None:
            return SightlineV1(self.robot, self._rules.role)
        if listening:
            client = LegacyClient(who, self._driver_slot, self._tell)
            return LegacyToVision(self.robot, end.legacy, monotonic_us, client)
        bound = self._rules.payload_bound(FRAME)
        return LegacyToRobot(self.robot, end.legacy, monotonic_us, secrets.token_hex(4), bound)

    def _tell(self, text: str) -> None:
        with self._joining:
            count = self._repeat_limiter.due(text, monotonic_us())
        if count:
            _log.warning("%s%s", text, f" ({count} times)" if count > 1 else "")

    def _deliver(self, peer: Peer, packet: IncomingMessage) -> None:
        parsed = parse_key(packet.key)
        if parsed is None:
            self._rules.reject(INEXACT_KEY)
            return
        if not peer.admits(packet.key, self._rules.reject, self._tell):
            return
        if parsed[1] is TWIST and self._peers[0] is not peer:
            self._put_first(peer)
        callbacks = self._subscriptions.of(parsed[1])
        if parsed[1].passed_on and self._listeners:
            callbacks = (partial(self._pass_on, peer), *callbacks)
        self._in_callback.now = True
        try:
            for callback in callbacks:
                self._rules.deliver(parsed[1], packet.key, packet.header, packet.payload, callback)
        finally:
            self._in_callback.now = False
