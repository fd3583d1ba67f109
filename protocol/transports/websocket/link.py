"""Implement `Link` on WebSocket: subscriptions, peers, and the forwarding at a listening end. Shell.

A link announces its subscribed channels. A listening end also announces overlays while a peer watches them.
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
from sightline.protocol.errors import ConfigError, LinkError, install_command
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.diagnosis import unresolved_host
from sightline.protocol.transports.endpoints import WebSocketEndpoint, parse_websocket_endpoint
from sightline.protocol.transports.link import INEXACT_KEY, BaseLink, LinkRules, Message
from sightline.protocol.transports.websocket.client import Client as Dialer
from sightline.protocol.transports.websocket.connection import Connection
from sightline.protocol.transports.websocket.framing import (
    MAX_HELLO_BYTES,
    Hello,
    IncomingMessage,
    PeerCodec,
    SightlineV1,
)
from sightline.protocol.transports.websocket.legacy import (
    DriverSlot,
    LegacyClient,
    LegacyCommands,
    LegacyToRobot,
    LegacyToVision,
)
from sightline.protocol.transports.websocket.legacy_text import text_bound
from sightline.protocol.transports.websocket.peer import Peer, Promote, Publication, exchange_hellos
from sightline.protocol.transports.websocket.server import KeyFolder, Server

_log: Final = logging.getLogger(__name__)

Callback = Callable[[Message], None]
_WATCHED = tuple(one for one in CHANNELS.values() if one.while_watched)


class Subscriber(Protocol):
    """A peer that receives the announcements of this end."""

    def subscribes_to(self, channel: Channel) -> bool:
        """Return True if the peer wants `channel`."""
        ...

    def limit(self, wanted_bytes: int) -> None:
        """Limit incoming messages to the largest payload that this end wants."""
        ...

    def send_hello(self, hello: str) -> None:
        """Send the hello of this end."""
        ...


class Subscriptions:
    """The subscriptions of one link. `announced` is the list that its peers have received."""

    def __init__(self, rules: LinkRules, session: str) -> None:
        self._rules, self._session = rules, session
        self._callbacks: dict[str, list[Callback]] = {}
        self.announced: tuple[str, ...] = ()

    def add(self, channel: Channel, callback: Callback) -> None:
        """Add a callback of `channel`."""
        self._callbacks.setdefault(channel.name, []).append(callback)

    def drop(self, channel: Channel) -> None:
        """Remove all callbacks of `channel`."""
        self._callbacks.pop(channel.name, None)

    def of(self, channel: Channel) -> tuple[Callback, ...]:
        """Return the callbacks of `channel`."""
        return tuple(self._callbacks.get(channel.name, ()))

    def hello(self) -> str:
        """Return the hello with the newest announcement."""
        about = Hello(robot=self._rules.robot, role=self._rules.role, session=self._session, wants=self.announced)
        return encode(about).decode("utf-8")

    def bound(self) -> int:
        """Return the largest payload of all announced channels, in bytes."""
        return max((self._rules.payload_bound(CHANNELS[name]) for name in self.announced), default=0)

    def send_hello(self, peer: Subscriber) -> None:
        """Send the newest announcement to one peer."""
        peer.limit(self.bound())
        peer.send_hello(self.hello())

    def announce(self, peers: Sequence[Subscriber], passing_on: bool) -> None:
        """Announce a changed list of channels to all `peers`. `passing_on` is True at a listening end."""
        # A listening end subscribes to an overlay only while another peer wants it, to save the encoding.
        watched = (one.name for one in _WATCHED if passing_on and any(peer.subscribes_to(one) for peer in peers))
        names = tuple(dict.fromkeys((*self._callbacks, *watched)))
        if names != self.announced:
            self.announced = names
            for peer in peers:
                self.send_hello(peer)


# WebSocket as a `Link`: `sightline.v1` or the legacy protocol, with threads, newest-only per peer. Shell.
#
#     with open_websocket("r1", listen="ws://127.0.0.1:9090") as link:
#         link.publish(STATUS, header, payload)
#
# A message goes from peer to peer only on the channels that the table marks as forwarded.


# Time limit of a close. A longer one continues on daemon threads, so that no process hangs on a dead peer.
CLOSE_S: Final = 1.5


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

    A listening end connects to `connect` in the background. It reconnects after a loss.

    Args:
        robot: robot id.
        listen: `ws://host:port`, `wss://` or `ws-legacy://`, see `sightline.protocol.transports.endpoints`.
        connect: endpoints to connect to.
        role: default source of messages toward the robot.
        timeout_s: longest wait for the first answer, if there are only endpoints to connect to.
        max_frame_bytes: security limit for the payload of a frame.
        secure: folder of tokens and certificates, or "".

    Raises:
        ConfigError: an argument is invalid, an endpoint accepts every client, or `websockets` is missing.
        LinkError: a port is in use, no peer answers in time, or the peer rejects this end.
    """
    rules = LinkRules(robot, role, max_frame_bytes)
    near, far = [[parse_websocket_endpoint(text) for text in _listed(ends)] for ends in (listen, connect)]
    if not near and not far:
        raise ConfigError("no endpoint; pass one to listen on (--listen) or to connect to (--connect)")
    try:
        import websockets  # noqa: F401
    except ImportError:
        raise ConfigError(f"websockets is not installed: {install_command('websocket')}") from None
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
    """A `Link` over any number of WebSocket connections. It does not receive its own publications."""

    def __init__(self, rules: LinkRules) -> None:
        """Use `open_websocket` instead of this constructor."""
        super().__init__(rules)
        self._subscriptions = Subscriptions(rules, secrets.token_hex(4))
        # The driver is first. The tuple is replaced, never changed, so that publishing needs no lock.
        self._peers: tuple[Peer, ...] = ()
        self._joining = threading.Lock()
        self._joined = threading.Event()
        self._listeners: list[Server] = []
        self._dialers: list[Dialer] = []
        self._in_callback = threading.local()
        self._dropped: Counter[str] = Counter()
        self._driver_slot = DriverSlot()
        self._commands: dict[str, LegacyCommands] = {}
        self._repeat_limiter = RepeatLimiter()

    @property
    def dropped(self) -> Counter[str]:
        """Return the publications that newer ones replaced, by channel, including those of former peers."""
        return sum((peer.queue.dropped for peer in self._peers), self._dropped)

    @property
    def connected(self) -> bool:
        """Return True if at least one peer is connected. Never blocks. A silent peer counts for two seconds."""
        return not self._closed and bool(self._peers)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Send a message to every peer that wants it, see `Link`."""
        self._rules.check(channel, header, payload)
        key = self._rules.key(channel, source)
        if not self.connected:
            return False
        post = Publication(Message(channel, key.rpartition("/")[2] if channel.has_source else "", header, payload))
        for peer in self._peers:
            peer.offer(post)
        return True

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback` on the thread of a peer for every message with the exact key and within bounds."""
        with self._joining:
            self._subscriptions.add(channel, callback)
            self._announce()

    def unsubscribe(self, channel: Channel) -> None:
        """End every subscription to `channel`."""
        with self._joining:
            self._subscriptions.drop(channel)
            self._announce()

    def has_listener(self, channel: Channel) -> bool:
        """Return True if a peer requested `channel`. Never blocks on the network."""
        return self.connected and any(peer.subscribes_to(channel) for peer in self._peers)

    def close(self) -> None:
        """Close with a reason for the peers. Idempotent, returns within two seconds, safe inside a callback."""
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
        # A peer waits for the end of its callback, so that callback must not wait for the peer.
        for peer in () if getattr(self._in_callback, "now", False) else peers:
            peer.wait_gone(max(0.0, deadline_s - time.monotonic()))

    # --- opening -------------------------------------------------------------------------------------------------

    def open(self, near: Sequence[WebSocketEndpoint], far: Sequence[WebSocketEndpoint], secure: str) -> None:
        """Listen on `near` and begin to connect to `far`. Raises the errors of `open_websocket`."""
        reject, keys = self._rules.reject, KeyFolder(secure, self._rules.role)
        for end in near:
            self._listeners.append(Server(end, partial(self._serve, end), reject, self._log_line, keys))
        for end in far:
            max_bytes = MAX_HELLO_BYTES
            if end.legacy is not None:  # a legacy robot may send its first image immediately
                max_bytes = text_bound(self._rules.payload_bound(FRAME))
                self._commands[end.text] = LegacyCommands(end.text, end.legacy, self._log_line)
            self._dialers.append(Dialer(end, partial(self._serve, end), reject, keys, max_bytes))

    def wait_connected(self, timeout_s: float) -> None:
        """Wait for the first peer. Raises LinkError with the cause after `timeout_s`."""
        deadline_s = time.monotonic() + timeout_s
        while not self._joined.wait(0.01):
            late = time.monotonic() > deadline_s
            for dialer in self._dialers:
                if dialer.trouble and (late or dialer.turned_away.is_set()):
                    raise LinkError(f"cannot connect to {dialer.endpoint.text}: {dialer.trouble}")
            if late:
                where = " or ".join(dialer.endpoint.text for dialer in self._dialers)
                if host := unresolved_host(dialer.endpoint.host for dialer in self._dialers):
                    raise LinkError(f"host '{host}' in {where} does not resolve; check the name or use an IP address")
                raise LinkError(f"no answer from {where} after {timeout_s:g} s; start the robot or check the address")

    # --- peers, each on a separate thread ----------------------------------------------------------------------------

    def _serve(self, end: WebSocketEndpoint, wire: Connection, settle: Promote | None = None) -> None:
        """Serve one peer until it is gone.

        Args:
            end: endpoint of the connection.
            wire: the connection.
            settle: assigns a client place at a listening end, or None at a connecting end.

        Raises:
            PeerError: the hello is invalid, or no place is free.
            ConnectionClosed: the peer closed before its hello.
        """
        codec = self._codec(end, settle is not None, "{}:{}".format(*wire.address))
        with self._joining:
            announced, hello = self._subscriptions.announced, self._subscriptions.hello()
            wanted_bytes = self._subscriptions.bound()
        peer = Peer(wire, codec, self._on_change, self._commands.get(end.text) if settle is None else None)
        peer.limit(wanted_bytes)
        if isinstance(codec, SightlineV1):
            exchange_hellos(wire, codec, hello, settle)
        elif settle is not None:
            settle("")
        if self._join(peer, announced):
            try:
                peer.run(self._deliver, self._rules.reject)
            finally:
                self._leave(peer)
                codec.note_gone()

    def _join(self, peer: Peer, announced: tuple[str, ...]) -> bool:
        with self._joining:
            if self._closed:
                return False
            self._peers = (*self._peers, peer)
            # The hello to this peer does not contain a subscription that was added since then.
            if announced != self._subscriptions.announced:
                self._subscriptions.send_hello(peer)
            self._announce()
        self._joined.set()
        return True

    def _leave(self, peer: Peer) -> None:
        with self._joining:
            self._peers = tuple(other for other in self._peers if other is not peer)
            # Replaced, never changed, because other threads read it without the lock.
            self._dropped = self._dropped + peer.queue.dropped
            self._announce()

    def _on_change(self) -> None:
        """Announce again after a peer changed its wants, which can start or stop an overlay of another peer."""
        with self._joining:
            self._announce()

    def _announce(self) -> None:
        """Announce the current list. Call it with the lock held."""
        self._subscriptions.announce(self._peers, bool(self._listeners))

    def _put_first(self, peer: Peer) -> None:
        """Move the driver to the front, so that it receives each message before the viewers."""
        with self._joining:
            self._peers = (peer, *(other for other in self._peers if other is not peer))

    def _pass_on(self, sender: Peer, message: Message) -> None:
        """Forward a message of one peer to the others, because they connect only to this end."""
        post = Publication(message)
        for peer in self._peers:
            if peer is not sender:
                peer.offer(post)

    def _codec(self, end: WebSocketEndpoint, listening: bool, who: str) -> PeerCodec:
        if end.legacy is None:
            return SightlineV1(self.robot, self._rules.role, connects=not listening)
        if listening:
            client = LegacyClient(who, self._driver_slot, self._log_line)
            return LegacyToVision(self.robot, end.legacy, monotonic_us, client)
        bound = self._rules.payload_bound(FRAME)
        return LegacyToRobot(self.robot, self._commands[end.text], monotonic_us, secrets.token_hex(4), bound)

    def _log_line(self, text: str) -> None:
        with self._joining:
            count = self._repeat_limiter.due(text, monotonic_us())
        if count:
            _log.warning("%s%s", text, f" ({count} times)" if count > 1 else "")

    def _deliver(self, peer: Peer, packet: IncomingMessage) -> None:
        parsed = parse_key(packet.key)
        if parsed is None:
            self._rules.reject(INEXACT_KEY)
            return
        if not peer.admits(packet.key, self._rules.reject, self._log_line):
            return
        # A peer that sends twists is the driver. Its next frame must not wait behind the copies for the viewers.
        if parsed[1] is TWIST and self._peers[0] is not peer:
            self._put_first(peer)
        callbacks = self._subscriptions.of(parsed[1])
        # Only a listening end forwards, because its peers have no other connection to each other.
        if parsed[1].passed_on and self._listeners:
            callbacks = (partial(self._pass_on, peer), *callbacks)
        self._in_callback.now = True
        try:
            for callback in callbacks:
                self._rules.deliver(parsed[1], packet.key, packet.header, packet.payload, callback)
        finally:
            self._in_callback.now = False
