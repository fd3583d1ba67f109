"""A robot's images for a viewer: the overlay of its vision service, or acknowledged frames. Shell (waits)."""

import secrets
import threading
import time
from dataclasses import dataclass
from typing import Final

from sightline.operator_side.client.requests import SOURCE as OPERATOR
from sightline.protocol.channels import ACK, FRAME, OVERLAY, SOURCES_OF_ROLE, STATUS, Channel
from sightline.protocol.clock import RobotClock, monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import WireError, home_path
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import AnswerHeader, DetectionsHeader, Echo, FrameHeader, Stamp
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.security import certificate_role


class FrameViewer:
    """The session of one viewer. It acknowledges frames if its keys permit it."""

    def __init__(self, link: Link, role: str, secure: str = "") -> None:
        """Create the session.

        Args:
            link: link to the robot.
            role: role of `link`, the name of the viewer on the wire.
            secure: folder of the keys of `link`, or "". The keys of a viewer permit no messages.
        """
        self._link, self._role = link, role
        self._is_silent = bool(secure) and not SOURCES_OF_ROLE.get(certificate_role(role))
        self._session = secrets.token_hex(4)
        self._seq = 0

    def acknowledge(self, message: Message) -> bool:
        """Acknowledge a frame, if that is permitted. Returns False for an invalid frame."""
        try:
            frame = decode(FrameHeader, message.header)
        except WireError:
            return False
        if self._is_silent:
            return True
        header = AnswerHeader(source=self._role, session=self._session, seq=self._seq, echo=Echo.of(frame))
        self._seq += 1
        self._link.publish(ACK, encode(header), b"")
        return True


# Take the overlay of the vision service, or acknowledged frames:
#
# with open_link("r1", connect=[...], role=viewer_role("")) as link:
#     shot = Pictures(link, "viewer").take(1.0)


VIEWER: Final = "viewer"
PATIENCE_S: Final = 1.5
"""Time without an overlay after which frames are shown, because no vision service draws one."""
SILENT_S: Final = 1.0
"""Silence after which a robot is offline: ten times the period of its status."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One image. `session`, `seq` and `t_us` (capture time on the robot's clock) are those of its frame."""

    channel: Channel
    jpeg: bytes
    session: str
    seq: int
    t_us: int
    width_px: int
    height_px: int


def viewer_role(secure: str) -> str:
    """Return the role of a viewer: operator if `secure` has its keys, because a viewer may not acknowledge."""
    folder = home_path(secure)
    is_operator = secure and any((folder / f"operator.{kind}").is_file() for kind in ("key", "token"))
    return OPERATOR if is_operator else VIEWER


class Pictures:
    """The newest image, for one thread at a time. The first `take` subscribes."""

    def __init__(self, link: Link, role: str, first: Channel = OVERLAY, secure: str = "") -> None:
        """Subscribe to the status, for the clock of the robot.

        Args:
            link: link to the robot.
            role: role of `link`.
            first: OVERLAY, replaced by frames while it is missing, or FRAME.
            secure: folder of the keys of `link`, or "".
        """
        self.robot = link.robot
        self._link, self._first = link, first
        self._viewer = FrameViewer(link, role, secure)
        self._changed = threading.Condition()
        self._newest: Message | None = None
        self._subscribed: set[str] = set()
        self._received_s = 0.0
        self._status_s = float("-inf")
        self.clock = RobotClock()
        self.rejected = 0
        """Number of invalid images."""
        link.subscribe(STATUS, self._on_status)

    def take(self, timeout_s: float) -> Shot | None:
        """Take the next image. A frame is acknowledged.

        Args:
            timeout_s: longest wait, s.

        Returns:
            The image, or None if no image arrived in time.
        """
        ends_s = time.monotonic() + timeout_s
        while True:
            self._choose()
            message = self._wait(min(ends_s, time.monotonic() + PATIENCE_S))
            if message is not None and message.channel is FRAME:
                self._viewer.acknowledge(message)
            shot = self._shot(message) if message is not None else None
            if shot is not None or time.monotonic() >= ends_s:
                return shot

    def pause(self) -> None:
        """Unsubscribe from images until the next `take`."""
        for name in tuple(self._subscribed):
            self._link.unsubscribe(FRAME if name == FRAME.name else self._first)
        self._subscribed.clear()
        with self._changed:
            self._newest = None

    def age_us(self, shot: Shot) -> int | None:
        """Return the lowest possible age of the image by the robot's clock, us, or None before a status."""
        return self.clock.age_us(shot.session, shot.t_us, monotonic_us())

    @property
    def is_online(self) -> bool:
        """Return True if the robot publishes its status."""
        return time.monotonic() - self._status_s < SILENT_S

    def _choose(self) -> None:
        """Subscribe to the wanted channel, and to frames while that channel is silent."""
        if self._first.name not in self._subscribed:
            self._received_s = time.monotonic()
            self._subscribe(self._first)
        if self._first is FRAME:
            return
        if time.monotonic() - self._received_s > PATIENCE_S:
            self._subscribe(FRAME)
        elif FRAME.name in self._subscribed:  # only after the wanted channel was silent
            self._subscribed.discard(FRAME.name)
            self._link.unsubscribe(FRAME)

    def _subscribe(self, channel: Channel) -> None:
        if channel.name not in self._subscribed:
            self._subscribed.add(channel.name)
            self._link.subscribe(channel, self._on_picture)

    def _wait(self, until_s: float) -> Message | None:
        with self._changed:
            self._changed.wait_for(lambda: self._newest, max(0.0, until_s - time.monotonic()))
            message, self._newest = self._newest, None
            return message

    def _shot(self, message: Message) -> Shot | None:
        """Return the image if it is valid and its header names a frame."""
        try:
            size = read_jpeg_size(message.payload)
            if message.channel is FRAME:
                of: FrameHeader | None = decode(FrameHeader, message.header)
                named = (of.session, of.seq, of.t_us) if of else ("", 0, 0)
            else:
                echo = decode(DetectionsHeader, message.header).echo
                named = (echo.session, echo.seq, echo.t_us) if echo else ("", 0, 0)
        except WireError:
            self.rejected += 1
            return None
        return Shot(message.channel, message.payload, *named, size.width_px, size.height_px)

    # --- on a thread of the transport: store and return --------------------------------------------------------------

    def _on_picture(self, message: Message) -> None:
        with self._changed:
            if message.channel is self._first:
                self._received_s = time.monotonic()
            self._newest = message
            self._changed.notify_all()

    def _on_status(self, message: Message) -> None:
        try:
            stamp = decode(Stamp, message.header)
        except WireError:
            return
        self._status_s = time.monotonic()
        self.clock.update(stamp.session, stamp.t_us, monotonic_us())
