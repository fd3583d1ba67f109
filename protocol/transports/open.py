"""Open a link on a set of endpoints, join several links into one, and relay between them. Shell.

A robot may listen on several transports. Its link then contains one link for each, with the same rules.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any, Final

from sightline.protocol.channels import CHANNELS, FRAME, Channel
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.link import Link, Message

# Time in which a running peer answers. A command without output for several seconds looks as if it hangs.
ANNOUNCED_AFTER_S: Final = 1.0
_log: Final = logging.getLogger(__name__)


def open_link(
    robot: str,
    *,
    listen: Sequence[str] = (),
    connect: Sequence[str] = (),
    role: str = "",
    timeout_s: float = 5.0,
    max_frame_bytes: int = FRAME.max_payload_bytes,
    secure: str = "",
    session: str = "",
) -> Link:
    """Open a robot's link on all endpoints. Use it in a `with`.

    Args:
        robot: robot id.
        listen: endpoints to listen on.
        connect: endpoints to connect to.
        role: default source of messages toward the robot; "robot" on the robot.
        timeout_s: longest wait for the first answer, if there are only endpoints to connect to.
        max_frame_bytes: security limit for the payload of a frame.
        secure: folder from `sightline keys`, or "".
        session: session id of this end, 8 hex digits, if it has published one already.

    Returns:
        The link. With endpoints of several transports it joins all of them.

    Raises:
        ConfigError: an argument is invalid, or an optional package is missing.
        LinkError: an endpoint cannot be opened or reached. No endpoint stays open then.
    """
    options: dict[str, Any] = {"role": role, "timeout_s": timeout_s, "max_frame_bytes": max_frame_bytes}
    web, zenoh = ([_of_kind(ends, is_web) for ends in (listen, connect)] for is_web in (True, False))
    links: list[Link] = []
    # If one endpoint fails, the others must not stay open. Otherwise the robot would answer on one transport only.
    with _announced(connect), ExitStack() as undo:
        # Without any endpoint Zenoh reports the error, because it is the default transport.
        if any(zenoh) or not any(web):
            from sightline.protocol.transports.zenoh.link import open_zenoh

            of_zenoh = open_zenoh(robot, listen=zenoh[0], connect=zenoh[1], secure=secure, session=session, **options)
            links.append(undo.enter_context(of_zenoh))
        if any(web):
            from sightline.protocol.transports.websocket.link import open_websocket

            of_web = open_websocket(robot, listen=web[0], connect=web[1], secure=secure, **options)
            links.append(undo.enter_context(of_web))
        undo.pop_all()
    return links[0] if len(links) == 1 else LinkGroup(links)


def check_link(listen: Sequence[str], connect: Sequence[str], role: str, secure: str) -> None:
    """Raise ConfigError for endpoints, keys or tokens with which `open_link` fails. Opens nothing."""
    from sightline.protocol.transports.endpoints import check_zenoh_endpoints, parse_websocket_endpoint
    from sightline.protocol.transports.security import check_keys, check_listening, load_role_keys, read_tokens
    from sightline.protocol.transports.websocket.tls import client_tls_context, server_tls_context

    web, zenoh = ([_of_kind(ends, is_web) for ends in (listen, connect)] for is_web in (True, False))
    if any(zenoh) or not any(web):
        check_zenoh_endpoints(*zenoh)
        check_keys(load_role_keys(secure, role), [*zenoh[0], *zenoh[1]])
    for endpoint in map(parse_websocket_endpoint, web[0]):
        check_listening(endpoint, {} if endpoint.legacy else read_tokens(secure))
        if endpoint.secure:
            server_tls_context(secure, role)
    if any(parse_websocket_endpoint(text).secure for text in web[1]):
        client_tls_context(secure)


@contextmanager
def _announced(connect: Sequence[str]) -> Iterator[None]:
    """Log the addresses once if they do not answer soon."""
    timer = threading.Timer(ANNOUNCED_AFTER_S, _log.info, ("connecting to %s ...", ", ".join(connect)))
    # A daemon, so that it does not delay the end of a command.
    timer.name, timer.daemon = "connecting", True
    if connect:
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


def _of_kind(ends: Sequence[str], is_web: bool) -> list[str]:
    return [endpoint for endpoint in ends if ("://" in endpoint) == is_web]


class LinkGroup(Link):
    """Joins several links of one robot. They do not receive each other's messages."""

    def __init__(self, links: Sequence[Link]) -> None:
        """Take over links of one robot. Raises ConfigError for an empty list and for several robots."""
        if len({link.robot for link in links}) != 1:
            raise ConfigError("a link group needs at least one link, and all of the same robot")
        self.robot = links[0].robot
        self.links = tuple(links)

    @property
    def connected(self) -> bool:
        """Return True if at least one link has a peer."""
        return any(link.connected for link in self.links)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Publish on all links. Returns True if at least one accepted the message."""
        # A list, because `any` over a generator would stop at the first link that accepts the message.
        taken = [link.publish(channel, header, payload, source) for link in self.links]
        return any(taken)

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """Subscribe on all links."""
        for link in self.links:
            link.subscribe(channel, callback)

    def unsubscribe(self, channel: Channel) -> None:
        """End the subscriptions on all links."""
        for link in self.links:
            link.unsubscribe(channel)

    def has_listener(self, channel: Channel) -> bool:
        """Return True if a peer subscribes on at least one link."""
        return any(link.has_listener(channel) for link in self.links)

    def watch_drivers(self, callback: Callable[[str, bool], None]) -> None:
        """Watch the tokens of all links that have them."""
        for link in self.links:
            link.watch_drivers(callback)

    @property
    def dropped(self) -> Counter[str]:
        """Return the sum of all links, by channel."""
        return sum((link.dropped for link in self.links), Counter())

    @property
    def rejected(self) -> Counter[str]:
        """Return the sum of all links, by reason."""
        return sum((Counter(dict(link.rejected)) for link in self.links), Counter())

    def close(self) -> None:
        """Close all links, the newest first."""
        for link in reversed(self.links):
            link.close()


# The relay of a robot between its transports. Shell.
#
# Peers of one transport do not need it: on Zenoh the router connects them, and a listening WebSocket end forwards.


class Relay:
    """Forwards messages between links, as the channel table defines. Overlays need a viewer on another link."""

    def __init__(self, link: Link) -> None:
        """Start with the channels that are always forwarded."""
        self._links: tuple[Link, ...] = link.links if isinstance(link, LinkGroup) else (link,)
        self._watched = [one for one in CHANNELS.values() if one.while_watched]
        self._open: set[tuple[str, int]] = set()
        for channel in CHANNELS.values():
            if channel.passed_on and not channel.while_watched:
                for near in self._links:
                    # A WebSocket end forwards only subscribed channels. Zenoh forwards without this process, and a
                    # subscription here would make a vision service send the boxes of each frame.
                    if self._others(near) or not near.is_routed:
                        self._begin(channel, near)

    def look(self) -> None:
        """Start or stop the channels that need a viewer. One thread calls it a few times a second."""
        for channel in self._watched:
            for number, near in enumerate(self._links):
                wanted = any(other.has_listener(channel) for other in self._others(near))
                if wanted and (channel.name, number) not in self._open:
                    self._open.add((channel.name, number))
                    self._begin(channel, near)
                elif not wanted and (channel.name, number) in self._open:
                    self._open.remove((channel.name, number))
                    near.unsubscribe(channel)

    def _begin(self, channel: Channel, near: Link) -> None:
        near.subscribe(channel, partial(_republish, self._others(near)))

    def _others(self, near: Link) -> list[Link]:
        return [other for other in self._links if other is not near]


def _republish(links: Sequence[Link], message: Message) -> None:
    for link in links:
        link.publish(message.channel, message.header, message.payload, message.source)
