"""Opens a link on a set of endpoints, joins several links into one, and relays between them. Shell.

A robot may listen on several at once; then its link is all of them, and what any peer says is heard alike.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from typing import Any

from sightline.protocol.channels import CHANNELS, FRAME, Channel
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports import endpoints
from sightline.protocol.transports import endpoints as websocket_endpoints
from sightline.protocol.transports.link import Link, Message


def check_endpoint(endpoint: str) -> None:
    """Raise ConfigError, with the right form, unless `endpoint` is one of some transport."""
    if "://" in endpoint:
        websocket_endpoints.parse_websocket_endpoint(endpoint)
    else:
        endpoints.parse_zenoh_endpoint(endpoint)


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
    """Open `robot`'s link on every endpoint given; use it in a `with`. `secure` is a folder of `sightline keys`,
    `session` what this end calls its start, where it has said so elsewhere.

    Raises ConfigError and LinkError as `open_zenoh` and `open_websocket` do; nothing stays open then.
    """
    options: dict[str, Any] = {"role": role, "timeout_s": timeout_s, "max_frame_bytes": max_frame_bytes}
    web, zenoh = ([_of_kind(ends, is_web) for ends in (listen, connect)] for is_web in (True, False))
    links: list[Link] = []
    with ExitStack() as undo:
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


def _of_kind(ends: Sequence[str], is_web: bool) -> list[str]:
    return [endpoint for endpoint in ends if ("://" in endpoint) == is_web]


class LinkGroup(Link):
    """Several links of one robot as one. They do not hear one another."""

    def __init__(self, links: Sequence[Link]) -> None:
        """Take over `links`, all of one robot. Raises ConfigError for none or for several robots."""
        if len({link.robot for link in links}) != 1:
            raise ConfigError("links of one robot can be joined, and at least one is needed")
        self.robot = links[0].robot
        self.links = tuple(links)

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """As `Link` says, on all of them; True if any took it."""
        taken = [link.publish(channel, header, payload, source) for link in self.links]
        return any(taken)

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """As `Link` says, on all of them."""
        for link in self.links:
            link.subscribe(channel, callback)

    def unsubscribe(self, channel: Channel) -> None:
        """As `Link` says, on all of them."""
        for link in self.links:
            link.unsubscribe(channel)

    def has_listener(self, channel: Channel) -> bool:
        """Whether somebody listens on any of them."""
        return any(link.has_listener(channel) for link in self.links)

    @property
    def dropped(self) -> Counter[str]:
        """As `Link`, of all of them."""
        return sum((link.dropped for link in self.links), Counter())

    @property
    def rejected(self) -> Counter[str]:
        """As `Link`, of all of them."""
        return sum((Counter(dict(link.rejected)) for link in self.links), Counter())

    def close(self) -> None:
        """Close all, the last opened first."""
        for link in reversed(self.links):
            link.close()


# What a robot passes on between its transports: what its peers say to one another. Shell.
#
# Peers of one transport hear one another without it: on Zenoh they meet at the router, and who listens on WebSocket
# passes on itself.


class Relay:
    """Passes on what the table of channels says; what is said only while watched, only while another side watches."""

    def __init__(self, link: Link) -> None:
        """Begin with what is always passed on."""
        self._links: tuple[Link, ...] = link.links if isinstance(link, LinkGroup) else (link,)
        self._watched = [one for one in CHANNELS.values() if one.while_watched]
        self._open: set[tuple[str, int]] = set()
        for channel in CHANNELS.values():
            if channel.passed_on and not channel.while_watched:
                for near in self._links:
                    self._begin(channel, near)

    def look(self) -> None:
        """Begin or end with what is said only while watched; to be called a few times a second, by one thread."""
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
