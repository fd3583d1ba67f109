"""What is said on one channel, for who prints it: words in order, of pictures the newest. Shell (a queue)."""

import queue
from typing import Final

from sightline.operator_side.client.pictures import Viewer
from sightline.protocol.channels import FRAME, JPEG, Channel
from sightline.protocol.transports.link import LatestSlot, Link, Message

MAX_WAITING: Final = 64
"""Words that wait to be printed; what comes while they do is dropped and counted."""


class ChannelInbox:
    """Hears `channel` from its making on."""

    def __init__(self, link: Link, role: str, channel: Channel, secure: str = "") -> None:
        self._words: queue.Queue[Message] = queue.Queue(MAX_WAITING)
        self._picture: LatestSlot[Message] | None = LatestSlot() if channel.encoding == JPEG else None
        self._viewer = Viewer(link, role, secure) if channel is FRAME else None
        self.robot, self.channel = link.robot, channel
        self._refused = 0
        link.subscribe(channel, self._put)

    @property
    def dropped(self) -> int:
        """What was not printed."""
        return self._refused + (self._picture.dropped if self._picture else 0)

    def take(self, timeout_s: float) -> Message | None:
        """The next message, None if none comes in time."""
        message = self._picture.take(timeout_s) if self._picture else self._next_words(timeout_s)
        if message is not None and self._viewer is not None:
            self._viewer.acknowledge(message)
        return message

    def _next_words(self, timeout_s: float) -> Message | None:
        try:
            return self._words.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def _put(self, message: Message) -> None:
        if self._picture is not None:
            self._picture.put(message)
            return
        try:
            self._words.put_nowait(message)
        except queue.Full:
            self._refused += 1
