"""What is said on one channel, in order, for who prints it; frames are acknowledged. Shell (a queue)."""

import queue
from typing import Final

from operator_side.acknowledge import Viewer
from protocol.channels import FRAME, Channel
from protocol.transports.link import Link, Message

MAX_WAITING: Final = 64
"""Messages that wait to be printed; what comes while they do is dropped and counted."""


class ChannelInbox:
    """Hears `channel` from its making on."""

    def __init__(self, link: Link, role: str, channel: Channel) -> None:
        self._queue: queue.Queue[Message] = queue.Queue(MAX_WAITING)
        self._viewer = Viewer(link, role) if channel is FRAME else None
        self.robot, self.channel = link.robot, channel
        self.dropped = 0
        link.subscribe(channel, self._put)

    def take(self, timeout_s: float) -> Message | None:
        """The next message, None if none comes in time."""
        try:
            message = self._queue.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if self._viewer is not None:
            self._viewer.acknowledge(message)
        return message

    def _put(self, message: Message) -> None:
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.dropped += 1
