"""What every link enforces, whatever carries it: exact keys, bounds, contained callbacks. Shell (a lock).

A bad message or a raising callback is counted and dropped; neither ends anything.
"""

import threading
from collections import Counter
from collections.abc import Callable

from sightline.protocol.channels import FRAME, MAX_HEADER_BYTES, Channel, check_robot_id, key_for, parse_key
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.link import Message

INEXACT_KEY = "INEXACT_KEY"
"""Counted for a key that is not exactly that of the robot and channel: a wildcard, another robot, a bad role."""
OVERSIZE = "OVERSIZE"
"""Counted for a header or payload over the channel's bound."""
NOT_A_PUT = "NOT_A_PUT"
"""Counted for anything that is not a publication, e.g. Zenoh's delete."""


class LinkRules:
    """The rules of one link to `robot`, used by `role`. `refused` and `callback_errors` only grow."""

    def __init__(self, robot: str, role: str = "", max_frame_bytes: int = FRAME.max_payload_bytes) -> None:
        """Security limit: `max_frame_bytes` (1 up to the channel's bound) for the payload of a frame.

        Raises ConfigError for a robot id or a limit that is none.
        """
        if not 1 <= max_frame_bytes <= FRAME.max_payload_bytes:
            raise ConfigError(f"max_frame_bytes {max_frame_bytes} is out of range: 1 to {FRAME.max_payload_bytes}")
        self.robot = check_robot_id(robot)
        self.role = role
        self.refused: Counter[str] = Counter()
        self.callback_errors = 0
        self._max_frame_bytes = max_frame_bytes
        self._counting = threading.Lock()

    def payload_bound(self, channel: Channel) -> int:
        """The largest payload of `channel` that this link carries, in bytes."""
        return min(channel.max_payload_bytes, self._max_frame_bytes) if channel is FRAME else channel.max_payload_bytes

    def key(self, channel: Channel, source: str = "") -> str:
        """The key to publish on; towards the robot `source` defaults to the role. Raises ValueError if it has none."""
        return key_for(self.robot, channel, source or (self.role if channel.has_source else ""))

    def check(self, channel: Channel, header: bytes, payload: bytes) -> None:
        """Raise ValueError for parts that this end must not send."""
        bound = self.payload_bound(channel)
        if len(header) > MAX_HEADER_BYTES or len(payload) > bound:
            raise ValueError(
                f"{channel.name}: header {len(header)} and payload {len(payload)} bytes, "
                f"at most {MAX_HEADER_BYTES} and {bound}"
            )

    def deliver(
        self, channel: Channel, key: str, header: bytes, payload: bytes, callback: Callable[[Message], None]
    ) -> None:
        """Give the message to `callback` if its key is exactly right and it is within bounds; never raises."""
        parsed = parse_key(key)
        if parsed is None or parsed[0] != self.robot or parsed[1] is not channel:
            self.refuse(INEXACT_KEY)
        elif len(header) > MAX_HEADER_BYTES or len(payload) > self.payload_bound(channel):
            self.refuse(OVERSIZE)
        else:
            self._call(callback, Message(channel, parsed[2], header, payload))

    def refuse(self, reason: str) -> None:
        """Count one message turned away."""
        with self._counting:
            self.refused[reason] += 1

    def _call(self, callback: Callable[[Message], None], message: Message) -> None:
        try:
            callback(message)
        except Exception:  # whatever a callback raises must not reach the transport's thread
            with self._counting:
                self.callback_errors += 1
