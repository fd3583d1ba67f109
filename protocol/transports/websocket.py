"""WebSocket as a `Link`: `sightline.v1`, or the older text dialect, with threads; newest-only per peer. Shell.

    with open_websocket("r1", listen="ws://127.0.0.1:9090") as link:
        link.publish(STATUS, header, payload)

Nothing is passed on between peers: who listens speaks with each who connects, and they do not hear one another.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from protocol.channels import CHANNELS, FRAME, Channel, parse_key
from protocol.codec import encode
from protocol.errors import ConfigError, LinkError
from protocol.transports.link import LatestSlot, Message
from protocol.transports.link_rules import INEXACT_KEY, LinkRules
from protocol.transports.websocket_dial import Dialer
from protocol.transports.websocket_dialects import BAD_HELLO, V1, Dialect, LegacyToRobot, LegacyToVision, PeerError
from protocol.transports.websocket_endpoints import Endpoint, parse_endpoint
from protocol.transports.websocket_framing import Hello, Packet
from protocol.transports.websocket_listen import Listener
from protocol.transports.websocket_peer import OPEN_S, Peer

if TYPE_CHECKING:
    from websockets.sync.connection import Connection

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
) -> WebSocketLink:
    """Open a link to `robot`; use it in a `with`.

    Endpoints are `ws://host:port` and `ws-legacy://host:port` (`protocol.transports.websocket_endpoints`). Who listens
    reaches `connect` in the background; a lost connection is made again by itself. `role` is the default source of what
    is published towards the robot. Raises ConfigError for a robot id, endpoint or limit that is none or for a missing
    `websockets`; LinkError for a port in use, if nobody answers within `timeout_s`, or if who answers will not speak.
    """
    rules = LinkRules(robot, role, max_frame_bytes)
    doors, far = [[parse_endpoint(text) for text in _listed(ends)] for ends in (listen, connect)]
    if not doors and not far:
        raise ConfigError("no endpoint: give one to listen on (--listen) or to connect to (--connect)")
    try:
        import websockets  # noqa: F401
    except ImportError:
        raise ConfigError("websockets is not installed: pip install 'sightline[websocket]'") from None
    link = WebSocketLink(rules)
    try:
        link.open(doors, far)
        if not doors:
            link.wait_connected(timeout_s)
    except LinkError:
        link.close()
        raise
    return link


def _listed(ends: str | Sequence[str]) -> Sequence[str]:
    return (ends,) if isinstance(ends, str) else ends


class WebSocketLink:
    """A `Link` over any number of WebSocket connections. A link does not hear what it publishes itself."""

    def __init__(self, rules: LinkRules) -> None:
        """Made by `open_websocket`."""
        self.robot = rules.robot
        self._rules = rules
        self._session = secrets.token_hex(4)
        self._callbacks: defaultdict[str, list[Callable[[Message], None]]] = defaultdict(list)
        self._peers: tuple[Peer, ...] = ()  # replaced, never changed, so that publishing needs no lock
        self._joining = threading.Lock()
        self._joined = threading.Event()
        self._listeners: list[Listener] = []
        self._dialers: list[Dialer] = []
        self._closed = False
        self._in_callback = threading.local()
        self._dropped: Counter[str] = Counter()

    @property
    def refused(self) -> Counter[str]:
        """Messages and peers turned away, by reason (`protocol.transports.link_rules`, `websocket_*`)."""
        return self._rules.refused

    @property
    def callback_errors(self) -> int:
        """How often a subscriber's callback raised."""
        return self._rules.callback_errors

    @property
    def dropped(self) -> Counter[str]:
        """Publications replaced by a newer one before a peer had room for them, by channel."""
        return sum((peer.outbox.dropped for peer in self._peers), self._dropped)

    @property
    def connected(self) -> bool:
        """Whether at least one peer is connected; never blocks. A silent peer counts for two seconds."""
        return not self._closed and bool(self._peers)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """As `Link` says; towards the robot `source` defaults to the link's role."""
        self._rules.check(channel, header, payload)
        key = self._rules.key(channel, source)
        if not self.connected:
            return False
        message = Message(channel, key.rpartition("/")[2] if channel.has_source else "", header, payload)
        for peer in self._peers:
            peer.offer(message)
        return True

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback`, on a peer's thread, for every message with the exact key and within bounds."""
        with self._joining:
            self._callbacks[channel.name].append(callback)
            for peer in self._peers:
                peer.limit(self._wanted_bytes())
                peer.tell(self._hello())

    def latest(self, channel: Channel) -> LatestSlot[Message]:
        """Subscribe with a slot that holds the newest message of `channel`."""
        slot: LatestSlot[Message] = LatestSlot()
        self.subscribe(channel, slot.put)
        return slot

    def has_listener(self, channel: Channel) -> bool:
        """Whether a peer said that it wants `channel`; never blocks on the network."""
        return self.connected and any(peer.hears(channel) for peer in self._peers)

    def close(self) -> None:
        """Tell the peers and end it; idempotent, over within two seconds, safe even inside a callback."""
        with self._joining:
            if self._closed:
                return
            self._closed = True
        for dialer in self._dialers:
            dialer.close()
        reason = f"this end of the link to robot {self.robot} is closing"
        closes: list[Callable[[str], None]] = [peer.close for peer in self._peers]
        closes += [listener.close for listener in self._listeners]
        threads = [threading.Thread(target=end, args=(reason,), name="websocket-close", daemon=True) for end in closes]
        for thread in threads:
            thread.start()
        if not getattr(self._in_callback, "now", False):  # a peer is gone when its callbacks are: one cannot wait
            deadline_s = time.monotonic() + CLOSE_S
            for thread in threads:
                thread.join(max(0.0, deadline_s - time.monotonic()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # --- opening -------------------------------------------------------------------------------------------------

    def open(self, doors: Sequence[Endpoint], far: Sequence[Endpoint]) -> None:
        """Listen on `doors` and begin to connect to `far`. Raises LinkError for a door that cannot be listened on."""
        refuse = self._rules.refuse
        self._listeners = []
        for end in doors:
            self._listeners.append(Listener(end, partial(self._serve, end, True), refuse))
        self._dialers = [Dialer(end, partial(self._serve, end, False), refuse) for end in far]

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

    def _serve(self, end: Endpoint, listening: bool, connection: Connection) -> None:
        """Speak with one peer until it is gone. Raises PeerError or ConnectionClosed if it says no proper hello."""
        dialect = self._dialect(end, listening)
        with self._joining:
            hello, wanted_bytes = self._hello(), self._wanted_bytes()
        connection.protocol.max_message_size = dialect.bound(wanted_bytes)
        if isinstance(dialect, V1):
            _greet(connection, dialect, hello, listening)
        peer = Peer(connection, dialect)
        if self._join(peer, hello):
            try:
                peer.run(self._deliver, self._rules.refuse)
            finally:
                self._leave(peer)

    def _join(self, peer: Peer, told: str) -> bool:
        with self._joining:
            if self._closed:
                return False
            self._peers = (*self._peers, peer)
            peer.limit(self._wanted_bytes())
            if told != self._hello():
                peer.tell(self._hello())
        self._joined.set()
        return True

    def _leave(self, peer: Peer) -> None:
        with self._joining:
            self._peers = tuple(other for other in self._peers if other is not peer)
            self._dropped += peer.outbox.dropped

    def _dialect(self, end: Endpoint, listening: bool) -> Dialect:
        if end.legacy is None:
            return V1(self.robot, self._rules.role)
        if listening:
            return LegacyToVision(self.robot, end.legacy, _now_us)
        bound = self._rules.payload_bound(FRAME)
        return LegacyToRobot(self.robot, end.legacy, _now_us, secrets.token_hex(4), bound)

    def _hello(self) -> str:
        wants, role = tuple(self._callbacks), self._rules.role
        return encode(Hello(robot=self.robot, role=role, session=self._session, wants=wants)).decode("utf-8")

    def _wanted_bytes(self) -> int:
        """The largest payload that this end has asked for."""
        return max((self._rules.payload_bound(CHANNELS[name]) for name in self._callbacks), default=0)

    def _deliver(self, packet: Packet) -> None:
        parsed = parse_key(packet.key)
        if parsed is None:
            self._rules.refuse(INEXACT_KEY)
            return
        self._in_callback.now = True
        try:
            for callback in tuple(self._callbacks.get(parsed[1].name, ())):
                self._rules.deliver(parsed[1], packet.key, packet.header, packet.payload, callback)
        finally:
            self._in_callback.now = False


def _greet(connection: Connection, dialect: V1, hello: str, listening: bool) -> None:
    """Exchange hellos; who connects speaks first."""
    if not listening:
        connection.send(hello)
    try:
        answer = connection.recv(OPEN_S)
    except TimeoutError:
        raise PeerError(BAD_HELLO, 1008, f"no hello within {OPEN_S:g} s") from None
    if not isinstance(answer, str):
        raise PeerError(BAD_HELLO, 1003, "the first message must be a hello, as text")
    dialect.accept(answer)
    if listening:
        connection.send(hello)


def _now_us() -> int:
    return time.monotonic_ns() // 1000
