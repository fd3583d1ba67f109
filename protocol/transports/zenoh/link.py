"""`ZenohLink` for one robot, and `ZenohFleet` for many robots over one session. Shell.

    with open_zenoh("r1", listen=["tcp/127.0.0.1:7447"]) as link:
        link.publish(STATUS, header, payload)

A session that is not closed keeps the interpreter from exiting, so a link is always used in a `with`.
"""

from __future__ import annotations

import secrets
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

from sightline.protocol.channels import FRAME, KEY_PREFIX, KNOWN_SOURCES, STATUS, Channel, parse_key, pattern_for
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.endpoints import check_zenoh_endpoints
from sightline.protocol.transports.link import NOT_A_PUT, BaseLink, FleetLink, Link, LinkRules, Message
from sightline.protocol.transports.security import ROBOT_ROLE, load_role_keys
from sightline.protocol.transports.zenoh.presence import PeerInfo, PresenceAnnouncer, query_presence
from sightline.protocol.transports.zenoh.session import CLOSED_SESSION, open_session

if TYPE_CHECKING:
    import zenoh


CLOSE_S: Final = 1.5
"""A close that takes longer is left to a daemon thread, so that no process hangs on a dead peer."""
EXPRESS_UP_TO_BYTES: Final = 4096
"""Channels bounded by this are sent at once, never batched."""
MAX_KEPT_PUBLISHERS: Final = 32
"""Security limit: beyond them only those of our own role and of the roles there are stay; peers make up sources."""


def open_zenoh(
    robot: str,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    role: str = "",
    timeout_s: float = 5.0,
    max_frame_bytes: int = FRAME.max_payload_bytes,
    secure: str = "",
    session: str = "",
) -> ZenohLink:
    """Open a link to `robot`; use it in a `with`.

    Who listens is the router, inside this process, and reaches `connect` in the background; who only connects is a
    client and reconnects by itself. `role` is the default source of what is published towards the robot. `secure` is a
    folder of `sightline keys`: mutual TLS, and only what the certificate's role may say or hear passes. Who has a role
    answers when somebody asks who is there, as `session` if given. Raises ConfigError for a robot id, endpoint or limit
    that is none or for a missing Zenoh; LinkError for a port in use, if nobody answers within `timeout_s`, or for a
    robot whose id another has there.
    """
    rules = LinkRules(robot, role, max_frame_bytes)
    check_zenoh_endpoints(listen, connect)
    opened = open_session(listen, connect, timeout_s, load_role_keys(secure, role))
    with ExitStack() as undo:
        link = undo.enter_context(ZenohLink(opened, rules))
        if role:
            link.announce(PresenceAnnouncer(role, robot, session or secrets.token_hex(4)))
        undo.pop_all()
    return link


def _parts(sample: zenoh.Sample) -> tuple[bytes, bytes]:
    attachment = sample.attachment
    return b"" if attachment is None else attachment.to_bytes(), sample.payload.to_bytes()


class ZenohLink(BaseLink):
    """A `Link` over one Zenoh session. A link does not hear what it publishes itself."""

    def __init__(self, session: zenoh.Session, rules: LinkRules, shared: bool = False) -> None:
        """Use an open `session`; closing the link closes it unless it is `shared` with others."""
        super().__init__(rules)
        self._session = session
        self._outlets: dict[str, _MatchedPublisher] = {}
        self._subscribers: defaultdict[str, list[zenoh.Subscriber[None]]] = defaultdict(list)
        self._ending = ExitStack()
        if not shared:
            self._ending.callback(session.close)  # first in, so last to run
        self._ending.callback(lambda: self._undeclare([one for some in self._subscribers.values() for one in some]))
        self._declaring = threading.Lock()
        self._in_callback = threading.local()
        self._peers = _ConnectedPeers(session, self._ending)

    @property
    def connected(self) -> bool:
        """Whether at least one peer is connected; never blocks. A silent peer counts until its lease is over (2 s)."""
        return not self._closed and bool(self._peers.zids)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """As `Link`."""
        import zenoh

        self._rules.check(channel, header, payload)
        key = self._rules.key(channel, source)
        if not self.connected:
            return False
        try:
            if self._is_kept(key, source):
                self._outlet(key, channel).publisher.put(payload, attachment=header or None)
            else:  # it passes all the same, so that nobody starves another, and leaves nothing behind
                self._session.put(key, payload, attachment=header or None, **_options(channel))
        except zenoh.ZError:  # closed meanwhile
            return False
        return True

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback`, on Zenoh's thread, for every message with the exact key and within bounds."""
        import zenoh

        def receive(sample: zenoh.Sample) -> None:
            self._in_callback.now = True
            try:
                self._receive(channel, sample, callback)
            finally:
                self._in_callback.now = False

        handler = zenoh.handlers.Callback(receive, indirect=False)
        with self._declaring:
            if not self._closed:
                subscriber = self._session.declare_subscriber(pattern_for(self.robot, channel), handler)
                self._subscribers[channel.name].append(subscriber)

    def unsubscribe(self, channel: Channel) -> None:
        """End every subscription to `channel`."""
        with self._declaring:
            ended = self._subscribers.pop(channel.name, [])
        self._undeclare(ended)

    def has_listener(self, channel: Channel) -> bool:
        """Whether a peer subscribes to what this end publishes on `channel`; never blocks on the network."""
        import zenoh

        try:
            return self.connected and self._outlet(self._rules.key(channel), channel).matched
        except zenoh.ZError:
            return False

    def announce(self, here: PresenceAnnouncer) -> None:
        """Answer whoever asks who is there. Raises LinkError for a robot whose id another has."""
        with self._declaring:
            self._ending.callback(here.answer_in(self._session))
        if here.role == ROBOT_ROLE:
            here.claim(self._session)

    def peers(self) -> list[PeerInfo]:
        """Everybody else who can be reached, with round trips; waits up to half a second. For display only."""
        import zenoh

        try:
            return [] if self._closed else query_presence(self._session)
        except zenoh.ZError:  # closed meanwhile
            return []

    def close(self) -> None:
        """Undeclare all and close the session; idempotent, over within two seconds, safe even inside a callback."""
        with self._declaring:
            if self._closed:
                return
            self._closed = True
        ending = threading.Thread(target=self._end, name="zenoh-close", daemon=True)
        ending.start()
        if not getattr(self._in_callback, "now", False):  # Zenoh's close waits for its callbacks, so one cannot wait
            ending.join(CLOSE_S)

    def _receive(self, channel: Channel, sample: zenoh.Sample, callback: Callable[[Message], None]) -> None:
        import zenoh

        if sample.kind != zenoh.SampleKind.PUT:
            self._rules.reject(NOT_A_PUT)
            return
        header, payload = _parts(sample)
        self._rules.deliver(channel, str(sample.key_expr), header, payload, callback)

    def _is_kept(self, key: str, source: str) -> bool:
        """Whether the publisher on `key` stays: a relay is given sources without number by who makes them up."""
        is_ours = source in ("", self._rules.role) or source in KNOWN_SOURCES
        return is_ours or key in self._outlets or len(self._outlets) < MAX_KEPT_PUBLISHERS

    def _outlet(self, key: str, channel: Channel) -> _MatchedPublisher:
        """The publisher on `key`, declared at its first use and kept."""
        outlet = self._outlets.get(key)
        if outlet is not None:
            return outlet
        with self._declaring:
            if key not in self._outlets:
                self._outlets[key] = _MatchedPublisher(self._session, key, channel, self._ending)
            return self._outlets[key]

    @staticmethod
    def _undeclare(subscribers: Sequence[zenoh.Subscriber[None]]) -> None:
        import zenoh

        for one in subscribers:
            with suppress(zenoh.ZError):  # gone with its session
                one.undeclare()  # type: ignore[no-untyped-call]

    def _end(self) -> None:
        import zenoh

        # A session that broke is closed. A publisher that somebody puts with now cannot be undeclared ("Already
        # borrowed", a RuntimeError); the session's close, which runs last in any case, ends it.
        with suppress(zenoh.ZError, RuntimeError):
            self._ending.close()
        self._session = CLOSED_SESSION


def _options(channel: Channel) -> dict[str, Any]:
    """How Zenoh is to carry `channel`."""
    import zenoh

    return {
        "encoding": channel.encoding,
        "congestion_control": zenoh.CongestionControl.DROP,
        "priority": getattr(zenoh.Priority, channel.priority.value),
        "express": channel.max_payload_bytes <= EXPRESS_UP_TO_BYTES,
        "allowed_destination": zenoh.Locality.REMOTE,
    }


class _MatchedPublisher:
    """A publisher and whether anybody matches it, kept up to date by Zenoh's thread."""

    def __init__(self, session: zenoh.Session, key: str, channel: Channel, ending: ExitStack) -> None:
        import zenoh

        self._changed: bool | None = None
        self.publisher = session.declare_publisher(key, **_options(channel))
        ending.callback(self.publisher.undeclare)
        listener = self.publisher.declare_matching_listener(zenoh.handlers.Callback(self._note, indirect=False))
        ending.callback(listener.undeclare)
        status: object = self.publisher.matching_status  # annotated as a bool, but it is a MatchingStatus: always true
        self._at_first = bool(getattr(status, "matching", status))

    @property
    def matched(self) -> bool:
        """Read without asking Zenoh; a change that came during the declaration outweighs what was read then."""
        return self._at_first if self._changed is None else self._changed

    def _note(self, status: zenoh.MatchingStatus) -> None:
        self._changed = status.matching


class _ConnectedPeers:
    """Who is connected, kept up to date by Zenoh's thread."""

    def __init__(self, session: zenoh.Session, ending: ExitStack) -> None:
        import zenoh

        self.zids: set[str] = set()
        handler = zenoh.handlers.Callback(self._note, indirect=False)
        listener = session.info.declare_transport_events_listener(handler, history=True)
        ending.callback(listener.undeclare)

    def _note(self, event: zenoh.TransportEvent) -> None:
        import zenoh

        change = self.zids.add if event.kind == zenoh.SampleKind.PUT else self.zids.discard
        change(str(event.transport.zid))


# Many robots over one Zenoh session: who is there, and a `Link` to each. Shell.
#
# with open_fleet("r*", connect=["tcp/127.0.0.1:7447"], role="vision") as fleet_link:
#     link = fleet_link.link("r1")


MAX_ROBOTS: Final = 256
"""Security limit: no more robots than this, whatever a network claims."""


def open_fleet(
    pattern: str,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    role: str = "",
    timeout_s: float = 5.0,
    max_frame_bytes: int = FRAME.max_payload_bytes,
    secure: str = "",
    about: Callable[[], str] | None = None,
) -> ZenohFleet:
    """Open a session for every robot whose id fits `pattern` (`*` any text, `?` any letter); use it in a `with`.

    `about` gives the line that who asks who is there is told of this end, besides its role.
    Raises ConfigError for an endpoint or pattern that is none or not of Zenoh, LinkError as `open_zenoh` does.
    """
    for endpoint in (*listen, *connect):
        if "://" in endpoint:
            raise ConfigError(f"{endpoint}: several robots (--robot {pattern!r}) need Zenoh; write tcp/<host>:<port>")
    check_zenoh_endpoints(listen, connect)
    here = PresenceAnnouncer(role, pattern, secrets.token_hex(4), about) if role else None
    session = open_session(listen, connect, timeout_s, load_role_keys(secure, role))
    fleet_link = ZenohFleet(session, pattern, role, max_frame_bytes)
    if here is not None:
        fleet_link.announce(here)
    return fleet_link


class ZenohFleet(FleetLink):
    """One session. Robots are noticed by their status; a link to one shares the session."""

    def __init__(self, session: zenoh.Session, pattern: str, role: str, max_frame_bytes: int) -> None:
        """Take over an open `session`."""
        self._session, self._pattern, self._role, self._max_frame_bytes = session, pattern, role, max_frame_bytes
        self._ending = ExitStack()
        self._ending.callback(session.close)
        self._seen: dict[str, None] = {}
        self._on_new_robot: Callable[[], None] = lambda: None
        self._listen()

    def announce(self, here: PresenceAnnouncer) -> None:
        """Answer whoever asks who is there."""
        self._ending.callback(here.answer_in(self._session))

    def robots(self) -> list[str]:
        """As `FleetLink`."""
        return list(self._seen)

    def on_new_robot(self, callback: Callable[[], None]) -> None:
        """As `FleetLink`."""
        self._on_new_robot = callback

    def link(self, robot: str) -> Link:
        """A link to `robot` over the shared session."""
        rules = LinkRules(robot, self._role, self._max_frame_bytes)
        return self._ending.enter_context(ZenohLink(self._session, rules, shared=True))

    def close(self) -> None:
        """Close all links and the session."""
        self._ending.close()
        self._session = CLOSED_SESSION

    def _listen(self) -> None:
        import zenoh

        handler = zenoh.handlers.Callback(self._note, indirect=False)
        subscriber = self._session.declare_subscriber(f"{KEY_PREFIX}/*/{STATUS.name}", handler)
        self._ending.callback(subscriber.undeclare)

    def _note(self, sample: zenoh.Sample) -> None:
        parsed = parse_key(str(sample.key_expr))
        if parsed is None or parsed[0] in self._seen or len(self._seen) >= MAX_ROBOTS:
            return
        if fnmatchcase(parsed[0], self._pattern):
            self._seen[parsed[0]] = None
            self._on_new_robot()
