"""Implement `Link` on Zenoh: `ZenohLink` for one robot, `ZenohFleet` for many robots over one session. Shell.

    with open_zenoh("r1", listen=["tcp/127.0.0.1:7447"]) as link:
        link.publish(STATUS, header, payload)

A session that is not closed prevents the exit of the interpreter. Always use a link in a `with`.
"""

from __future__ import annotations

import logging
import secrets
import threading
import time
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
from sightline.protocol.transports.tokens import (
    ALL_TOKENS,
    AnyToken,
    DetectorToken,
    DriverToken,
    RobotToken,
    Token,
    detectors_of,
    drivers_of,
    parse_token,
)
from sightline.protocol.transports.zenoh.presence import PeerInfo, PresenceAnnouncer, query_presence
from sightline.protocol.transports.zenoh.session import close_without_waiting, open_session

if TYPE_CHECKING:
    import zenoh

_log: Final = logging.getLogger(__name__)

# Time limit of a close. A longer one continues on a daemon thread, so that no process hangs on a dead peer.
CLOSE_S: Final = 1.5
# Channels with a size limit up to this value are sent immediately, never in a batch.
EXPRESS_UP_TO_BYTES: Final = 4096
# Security limit: stored publishers of unknown sources. A peer can invent any number of sources.
MAX_KEPT_PUBLISHERS: Final = 32


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

    A listening end is the router, inside this process, and connects to `connect` in the background. An end that only
    connects is a client and reconnects automatically.

    Args:
        robot: robot id.
        listen: e.g. `tcp/127.0.0.1:7447`.
        connect: endpoints to connect to.
        role: default source of messages toward the robot. A link with a role answers presence queries.
        timeout_s: longest wait for the first answer, if there are only endpoints to connect to.
        max_frame_bytes: security limit for the payload of a frame.
        secure: folder from `sightline keys`, or "". With it, mutual TLS, and access by the role of the certificate.
        session: session id in presence replies, 8 hex digits. The default is random.

    Raises:
        ConfigError: an argument is invalid, or Zenoh is missing.
        LinkError: a port is in use, no peer answers in time, or another robot has this id.
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
    """A `Link` over one Zenoh session. It does not receive its own publications."""

    is_routed = True

    def __init__(self, session: zenoh.Session, rules: LinkRules, shared: bool = False) -> None:
        """Use an open `session`. The end of the link closes it, unless it is `shared` with other links."""
        super().__init__(rules)
        self._session = session
        self._outlets: dict[str, _MatchedPublisher] = {}
        self._subscribers: defaultdict[str, list[zenoh.Subscriber[None]]] = defaultdict(list)
        self._ending = ExitStack()
        if not shared:
            # Registered first, so that it runs last. The declarations below need an open session to end.
            self._ending.callback(session.close)
        self._ending.callback(lambda: self._undeclare([one for some in self._subscribers.values() for one in some]))
        self._declaring = threading.Lock()
        self._in_callback = threading.local()
        self._peers = _ConnectedPeers(session, self._ending, shared)

    @property
    def connected(self) -> bool:
        """Return True if at least one peer is connected. Never blocks. A silent peer counts for its lease of 2 s."""
        return not self._closed and bool(self._peers.zids)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Publish a message, see `Link`."""
        import zenoh

        self._rules.check(channel, header, payload)
        key = self._rules.key(channel, source)
        if not self.connected:
            return False
        try:
            if self._is_kept(key, source):
                self._outlet(key, channel).publisher.put(payload, attachment=header or None)
            # The message is still sent, so that no source blocks another. Only its publisher is not stored.
            else:
                self._session.put(key, payload, attachment=header or None, **_options(channel))
        except zenoh.ZError:  # closed in the meantime
            return False
        return True

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Call `callback` on a thread of Zenoh for every message with the exact key and within bounds."""
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
        """Return True if a peer subscribes to `channel` of this end. Never blocks on the network."""
        import zenoh

        try:
            return self.connected and self._outlet(self._rules.key(channel), channel).matched
        except zenoh.ZError:
            return False

    def announce(self, here: PresenceAnnouncer) -> None:
        """Answer presence queries. Raises LinkError for a robot if another one has its id."""
        with self._declaring:
            self._ending.callback(here.answer_in(self._session))
        if here.role == ROBOT_ROLE:
            here.claim(self._session)
            with self._declaring:
                self._ending.callback(declare_token(self._session, RobotToken(self.robot)))

    def watch_drivers(self, callback: Callable[[str, bool], None]) -> None:
        """Call `callback` on a thread of Zenoh with each driver token, and True if it is present."""
        def note(token: AnyToken, is_present: bool) -> None:
            if isinstance(token, DriverToken) and token.robot == self.robot:
                callback(token.token, is_present)

        with self._declaring:
            if not self._closed:
                self._ending.callback(watch_tokens(self._session, drivers_of(self.robot), note))

    def peers(self) -> list[PeerInfo]:
        """Return all other peers with their round trips, within half a second. For display only."""
        import zenoh

        try:
            return [] if self._closed else query_presence(self._session)
        except zenoh.ZError:  # closed in the meantime
            return []

    def close(self) -> None:
        """Undeclare everything and close the session. Idempotent, returns within two seconds, safe in a callback."""
        with self._declaring:
            if self._closed:
                return
            self._closed = True
        ending = threading.Thread(target=self._end, name="zenoh-close", daemon=True)
        ending.start()
        # Zenoh's close waits for its callbacks, so a callback must not wait for it.
        if not getattr(self._in_callback, "now", False):
            ending.join(CLOSE_S)

    def _receive(self, channel: Channel, sample: zenoh.Sample, callback: Callable[[Message], None]) -> None:
        import zenoh

        if sample.kind != zenoh.SampleKind.PUT:
            self._rules.reject(NOT_A_PUT)
            return
        header, payload = _parts(sample)
        self._rules.deliver(channel, str(sample.key_expr), header, payload, callback)

    def _is_kept(self, key: str, source: str) -> bool:
        """Return True if the publisher on `key` may be stored. A peer can send a relay any number of sources."""
        is_ours = source in ("", self._rules.role) or source in KNOWN_SOURCES
        return is_ours or key in self._outlets or len(self._outlets) < MAX_KEPT_PUBLISHERS

    def _outlet(self, key: str, channel: Channel) -> _MatchedPublisher:
        """Return the publisher on `key`. The first call declares it."""
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
            with suppress(zenoh.ZError):  # the session is closed
                one.undeclare()  # type: ignore[no-untyped-call]

    def _end(self) -> None:
        import zenoh

        # A broken session is already closed. A publisher in use by another thread cannot be undeclared ("Already
        # borrowed", a RuntimeError). The close of the session, which always runs last, ends it.
        with suppress(zenoh.ZError, RuntimeError):
            self._ending.close()


def declare_token(session: zenoh.Session, token: AnyToken) -> Callable[[], None]:
    """Declare a token. It ends with the session, or with a call of the returned function. The caller must store it."""
    import zenoh

    # Zenoh ends a token whose object is no longer referenced. The closure holds a reference.
    declared = session.liveliness().declare_token(token.key)

    def withdraw() -> None:
        with suppress(zenoh.ZError):  # the session is closed
            declared.undeclare()  # type: ignore[no-untyped-call]

    return withdraw


def watch_tokens(
    session: zenoh.Session, pattern: str, callback: Callable[[AnyToken, bool], None]
) -> Callable[[], None]:
    """Call `callback` on a thread of Zenoh with each valid token, also earlier ones, and True if it is present."""
    import zenoh

    def note(sample: zenoh.Sample) -> None:
        token = parse_token(str(sample.key_expr))
        if token is not None:
            callback(token, sample.kind == zenoh.SampleKind.PUT)

    handler = zenoh.handlers.Callback(note, indirect=False)
    watching = session.liveliness().declare_subscriber(pattern, handler, history=True)

    def end() -> None:
        with suppress(zenoh.ZError):  # the session is closed
            watching.undeclare()  # type: ignore[no-untyped-call]

    return end


def _options(channel: Channel) -> dict[str, Any]:
    """Return the options of a publication on `channel`."""
    import zenoh

    return {
        "encoding": channel.encoding,
        "congestion_control": zenoh.CongestionControl.DROP,
        "priority": getattr(zenoh.Priority, channel.priority.value),
        "express": channel.max_payload_bytes <= EXPRESS_UP_TO_BYTES,
        "allowed_destination": zenoh.Locality.REMOTE,
    }


class _MatchedPublisher:
    """A publisher with its matching status, which a thread of Zenoh updates."""

    def __init__(self, session: zenoh.Session, key: str, channel: Channel, ending: ExitStack) -> None:
        import zenoh

        self._changed: bool | None = None
        self.publisher = session.declare_publisher(key, **_options(channel))
        ending.callback(self.publisher.undeclare)
        listener = self.publisher.declare_matching_listener(zenoh.handlers.Callback(self._note, indirect=False))
        ending.callback(listener.undeclare)
        # Its type annotation is bool, but it is a MatchingStatus, which is always true.
        status: object = self.publisher.matching_status
        self._at_first = bool(getattr(status, "matching", status))

    @property
    def matched(self) -> bool:
        """Return True if a subscriber matches, without a call of Zenoh."""
        # A change during the declaration is newer than the first status.
        return self._at_first if self._changed is None else self._changed

    def _note(self, status: zenoh.MatchingStatus) -> None:
        self._changed = status.matching


class _ConnectedPeers:
    """The connected peers, which a thread of Zenoh updates."""

    def __init__(self, session: zenoh.Session, ending: ExitStack, shared: bool = False) -> None:
        import zenoh

        self._shared = shared
        self.zids: set[str] = set()
        self.losses = 0
        handler = zenoh.handlers.Callback(self._note, indirect=False)
        listener = session.info.declare_transport_events_listener(handler, history=True)
        ending.callback(listener.undeclare)

    def _note(self, event: zenoh.TransportEvent) -> None:
        import zenoh

        if event.kind == zenoh.SampleKind.PUT:
            if not self._shared:
                close_without_waiting()
            self.zids.add(str(event.transport.zid))
        else:
            self.zids.discard(str(event.transport.zid))
            self.losses += not self.zids


# Many robots over one Zenoh session: their ids, and a `Link` to each. Shell.
#
# with open_fleet("r*", connect=["tcp/127.0.0.1:7447"], role="vision") as fleet_link:
#     link = fleet_link.link("r1")


# Security limit: present robots of one fleet, as many as the sessions of a router.
MAX_ROBOTS: Final = 1_000
# Silence after which a robot has left. A robot publishes ten statuses a second. Its next status adds it again.
LEFT_AFTER_S: Final = 10.0


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
    by_status: bool = True,
) -> ZenohFleet:
    """Open one session for all robots whose id fits `pattern`. Use it in a `with`.

    Args:
        pattern: robot ids, with `*` for any text and `?` for any letter.
        listen: Zenoh endpoints to listen on.
        connect: Zenoh endpoints to connect to.
        role: default source of messages toward the robots.
        timeout_s: longest wait for the first answer, if there are only endpoints to connect to.
        max_frame_bytes: security limit for the payload of a frame.
        secure: folder from `sightline keys`, or "".
        about: returns one line about this end for presence replies.
        by_status: True to find robots by their status. Otherwise the caller finds them by their tokens.

    Raises:
        ConfigError: an endpoint or the pattern is invalid, or an endpoint is not of Zenoh.
        LinkError: as in `open_zenoh`.
    """
    for endpoint in (*listen, *connect):
        if "://" in endpoint:
            raise ConfigError(f"{endpoint}: several robots (--robot {pattern!r}) need Zenoh; write tcp/<host>:<port>")
    check_zenoh_endpoints(listen, connect)
    here = PresenceAnnouncer(role, pattern, secrets.token_hex(4), about) if role else None
    session = open_session(listen, connect, timeout_s, load_role_keys(secure, role))
    fleet_link = ZenohFleet(session, pattern, role, max_frame_bytes)
    if by_status:
        fleet_link.listen()
    if here is not None:
        fleet_link.announce(here)
    return fleet_link


class ZenohFleet(FleetLink):
    """The links to many robots over one session. It finds robots by their status."""

    def __init__(self, session: zenoh.Session, pattern: str, role: str, max_frame_bytes: int) -> None:
        """Take over an open `session`."""
        self._session, self._pattern, self._role, self._max_frame_bytes = session, pattern, role, max_frame_bytes
        self._links: dict[str, ZenohLink] = {}
        self._ending = ExitStack()
        self._ending.callback(session.close)
        self._received_s: dict[str, float] = {}
        self._is_full_logged = False
        self._on_new_robot: Callable[[], None] = lambda: None
        self._peers = _ConnectedPeers(session, self._ending)

    @property
    def connected(self) -> bool:
        """Return True if at least one peer is connected."""
        return bool(self._peers.zids)

    @property
    def losses(self) -> int:
        """Return how many times the last peer was lost, see `FleetLink`."""
        return self._peers.losses

    def announce(self, here: PresenceAnnouncer) -> None:
        """Answer presence queries."""
        self._ending.callback(here.answer_in(self._session))

    def robots(self) -> list[str]:
        """Return the ids of the robots with a status within `LEFT_AFTER_S`, ordered by their first status."""
        now_s = time.monotonic()
        for robot in [one for one, received_s in self._received_s.copy().items() if now_s - received_s > LEFT_AFTER_S]:
            del self._received_s[robot]
        return list(self._received_s)

    def on_new_robot(self, callback: Callable[[], None]) -> None:
        """Call `callback` on a thread of Zenoh at the first status of each robot, again after it had left."""
        self._on_new_robot = callback

    def link(self, robot: str) -> Link:
        """Return a link to `robot` over the shared session. An earlier link to it is closed."""
        rules = LinkRules(robot, self._role, self._max_frame_bytes)
        if robot in self._links:
            self._links[robot].close()
        self._links = {name: one for name, one in self._links.items() if not one._closed}
        self._links[robot] = ZenohLink(self._session, rules, shared=True)
        return self._links[robot]

    def close(self) -> None:
        """Close all links and the session."""
        for link in self._links.values():
            link.close()
        self._ending.close()

    def declare_token(self, token: AnyToken) -> Callable[[], None]:
        """Declare a token, which ends with the session or process.

        Returns:
            A function that ends the token. The caller must store it.
        """
        return declare_token(self._session, token)

    def watch_tokens(self, callback: Callable[[Token, bool], None]) -> Callable[[], None]:
        """Call `callback` on a thread of Zenoh with each token of robots and vision services, True for present."""
        def note(token: AnyToken, is_present: bool) -> None:
            # Detectors have separate groups. `watch_detectors` reports one group.
            if not isinstance(token, DetectorToken):
                callback(token, is_present)

        end = watch_tokens(self._session, ALL_TOKENS, note)
        self._ending.callback(end)
        return end

    def find_robots(self) -> set[str]:
        """Query the ids of all robots, also without a token or status, within half a second."""
        import zenoh

        with suppress(zenoh.ZError):  # closed in the meantime
            peers = [peer.presence for peer in query_presence(self._session)]
            return {one.robot for one in peers if one.role == ROBOT_ROLE}
        return set()

    def watch_detectors(self, group: str, callback: Callable[[DetectorToken, bool], None]) -> Callable[[], None]:
        """Call `callback` on a thread of Zenoh with each token in `group`, and True if it is present."""
        def note(token: AnyToken, is_present: bool) -> None:
            if isinstance(token, DetectorToken):
                callback(token, is_present)

        # Not all tokens, because a site has many robots, and `watch_tokens` reports their tokens.
        end = watch_tokens(self._session, detectors_of(group), note)
        self._ending.callback(end)
        return end

    def listen(self) -> None:
        """Find robots by their status."""
        import zenoh

        handler = zenoh.handlers.Callback(self._note, indirect=False)
        subscriber = self._session.declare_subscriber(f"{KEY_PREFIX}/*/{STATUS.name}", handler)
        self._ending.callback(subscriber.undeclare)

    def _note(self, sample: zenoh.Sample) -> None:
        parsed = parse_key(str(sample.key_expr))
        if parsed is None or not fnmatchcase(parsed[0], self._pattern):
            return
        is_new = parsed[0] not in self._received_s
        if is_new and len(self._received_s) >= MAX_ROBOTS:
            self._log_full(parsed[0])
            return
        self._received_s[parsed[0]] = time.monotonic()
        if is_new:
            self._on_new_robot()

    def _log_full(self, robot: str) -> None:
        if not self._is_full_logged:
            self._is_full_logged = True
            _log.warning("%s is not served: %d robots are present, the limit of one service; give each service a part "
                         "of the robots with --robot", robot, MAX_ROBOTS)
