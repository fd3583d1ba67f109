"""What a robot passes on between its transports: what its peers say to one another. Shell.

Peers of one transport hear one another without it: on Zenoh they meet at the router, and who listens on WebSocket
passes on itself.
"""

from collections.abc import Sequence
from functools import partial

from sightline.protocol.channels import CHANNELS, Channel
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import LinkGroup


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
                    near.ignore(channel)

    def _begin(self, channel: Channel, near: Link) -> None:
        near.subscribe(channel, partial(_republish, self._others(near)))

    def _others(self, near: Link) -> list[Link]:
        return [other for other in self._links if other is not near]


def _republish(links: Sequence[Link], message: Message) -> None:
    for link in links:
        link.publish(message.channel, message.header, message.payload, message.source)
