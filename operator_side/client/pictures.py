"""A robot's pictures for a viewer: the overlay of its vision, or acknowledged frames. Shell (waits)."""

import secrets
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from sightline.operator_side.client.requests import SOURCE as OPERATOR
from sightline.protocol.channels import ACK, FRAME, OVERLAY, SOURCES_OF_ROLE, STATUS, Channel
from sightline.protocol.clock import RobotClock, monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import AnswerHeader, DetectionsHeader, Echo, FrameHeader, Stamp
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.security import certificate_role


class FrameViewer:
    """One viewer's session; `role` names it on the wire. Keys in `secure` may be of a role that has nothing to say."""

    def __init__(self, link: Link, role: str, secure: str = "") -> None:
        self._link, self._role = link, role
        self._is_silent = bool(secure) and not SOURCES_OF_ROLE.get(certificate_role(role))
        self._session = secrets.token_hex(4)
        self._seq = 0

    def acknowledge(self, message: Message) -> bool:
        """Answer one frame, where that is allowed; False for what is none."""
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


# A robot's pictures as a person sees them: its vision's overlay, or its frames, acknowledged. Shell (waits).
#
# with open_link("r1", connect=[...], role=viewer_role("")) as link:
#     shot = Pictures(link, "viewer").take(1.0)


VIEWER: Final = "viewer"
PATIENCE_S: Final = 1.5
"""Without an overlay for this long there is no vision to draw one, and frames are shown."""
SILENT_S: Final = 1.0
"""Ten times as long as a robot is silent between two words."""


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture; `session`, `seq` and `t_us` (robot clock, capture) are of the frame that it shows."""

    channel: Channel
    jpeg: bytes
    session: str
    seq: int
    t_us: int
    width_px: int
    height_px: int


def viewer_role(secure: str) -> str:
    """Who watches: an operator where `secure` has the keys of one, for a viewer may not even acknowledge."""
    folder = Path(secure).expanduser()
    is_operator = secure and any((folder / f"operator.{kind}").is_file() for kind in ("key", "token"))
    return OPERATOR if is_operator else VIEWER


class Pictures:
    """The newest picture, taken by one thread at a time. Nothing is subscribed to before the first `take`."""

    def __init__(self, link: Link, role: str, first: Channel = OVERLAY, secure: str = "") -> None:
        """`first` is what is wanted: vision's own pictures, with frames in their absence, or FRAME. `role` and the keys
        in `secure` are those of `link`."""
        self.robot = link.robot
        self._link, self._first = link, first
        self._viewer = FrameViewer(link, role, secure)
        self._news = threading.Condition()
        self._newest: Message | None = None
        self._heard: set[str] = set()
        self._heard_s = 0.0
        self._status_s = float("-inf")
        self.clock = RobotClock()
        self.refused = 0
        """Pictures that are none."""
        link.subscribe(STATUS, self._on_status)

    def take(self, timeout_s: float) -> Shot | None:
        """The next picture; None if none came in time. Frames are acknowledged as they are taken."""
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
        """Nobody looks: hear no pictures until the next `take`."""
        for name in tuple(self._heard):
            self._link.unsubscribe(FRAME if name == FRAME.name else self._first)
        self._heard.clear()
        with self._news:
            self._newest = None

    def age_us(self, shot: Shot) -> int | None:
        """How old the picture is at the least, by the robot's clock."""
        return self.clock.age_us(shot.session, shot.t_us, monotonic_us())

    @property
    def is_heard(self) -> bool:
        """Whether the robot says its status."""
        return time.monotonic() - self._status_s < SILENT_S

    def _choose(self) -> None:
        """Hear what is wanted; frames too while it does not come, and no longer than that."""
        if self._first.name not in self._heard:
            self._heard_s = time.monotonic()
            self._hear(self._first)
        if self._first is FRAME:
            return
        if time.monotonic() - self._heard_s > PATIENCE_S:
            self._hear(FRAME)
        elif FRAME.name in self._heard:  # which it is only once what is wanted did not come
            self._heard.discard(FRAME.name)
            self._link.unsubscribe(FRAME)

    def _hear(self, channel: Channel) -> None:
        if channel.name not in self._heard:
            self._heard.add(channel.name)
            self._link.subscribe(channel, self._on_picture)

    def _wait(self, until_s: float) -> Message | None:
        with self._news:
            self._news.wait_for(lambda: self._newest, max(0.0, until_s - time.monotonic()))
            message, self._newest = self._newest, None
            return message

    def _shot(self, message: Message) -> Shot | None:
        """The picture, if it is one, and its header says of which frame."""
        try:
            size = read_jpeg_size(message.payload)
            if message.channel is FRAME:
                of: FrameHeader | None = decode(FrameHeader, message.header)
                named = (of.session, of.seq, of.t_us) if of else ("", 0, 0)
            else:
                echo = decode(DetectionsHeader, message.header).echo
                named = (echo.session, echo.seq, echo.t_us) if echo else ("", 0, 0)
        except WireError:
            self.refused += 1
            return None
        return Shot(message.channel, message.payload, *named, size.width_px, size.height_px)

    # --- on the transport's thread: store and return -----------------------------------------------------------------

    def _on_picture(self, message: Message) -> None:
        with self._news:
            if message.channel is self._first:
                self._heard_s = time.monotonic()
            self._newest = message
            self._news.notify_all()

    def _on_status(self, message: Message) -> None:
        try:
            stamp = decode(Stamp, message.header)
        except WireError:
            return
        self._status_s = time.monotonic()
        self.clock.update(stamp.session, stamp.t_us, monotonic_us())
