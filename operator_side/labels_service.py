"""Publishes the simulation's labels as boxes of a robot's frames, as a detector elsewhere would. Shell.

It looks at no picture: the simulation says what is in each, by the time it was captured at.
"""

import secrets
from collections.abc import Callable

from sightline.evaluation.labels import SOURCE, boxes_message
from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.codec import decode
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import FrameHeader
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.protocol.transports.open import open_link
from sightline.sim.label_bus import LabelReader

_WAIT_S = 0.03
"""For a frame; then it takes in what the simulation said meanwhile."""


def run(robot: str, connect: list[str], secure: str, socket_dir: str, say: Callable[[str], None]) -> int:
    """Publish until interrupted. Raises HardwareError when the simulation is gone, LinkError as `open_link` does."""
    labels = LabelReader(socket_dir)
    with open_link(robot, connect=connect, role=SOURCE, secure=secure) as link:
        publisher = LabelPublisher(link, labels)
        say(f"labels: boxes of robot {robot}'s frames go to detections/{SOURCE}")
        try:
            while True:
                publisher.step()
        except KeyboardInterrupt:
            return 0
        finally:
            labels.close()


class LabelPublisher:
    """One robot's frames in, their boxes out: the newest frame only."""

    def __init__(self, link: Link, labels: LabelReader) -> None:
        self._link, self._labels = link, labels
        self._frames: LatestSlot[Message] = link.latest(FRAME)
        self._session = secrets.token_hex(4)
        self._seq = 0

    def step(self) -> None:
        """The next frame's boxes, if one comes soon."""
        frame = self._frames.take(_WAIT_S)
        self._labels.drain()
        if frame is not None:
            self._publish(frame)

    def _publish(self, frame: Message) -> None:
        """By the picture's own size: on a slow link the robot sends smaller ones."""
        try:
            header, size = decode(FrameHeader, frame.header), read_jpeg_size(frame.payload)
        except WireError:
            return
        boxes = self._labels.of(header.t_us, size.width_px)
        if boxes is not None:
            stamp, payload = boxes_message(header, boxes, size, self._session, self._seq)
            self._link.publish(DETECTIONS, stamp, payload)
            self._seq += 1
