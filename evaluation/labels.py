"""Publishes the simulation's labels as detections, in place of a detector service. Shell (a link)."""

import secrets
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Any

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import JpegSize, read_jpeg_size
from sightline.protocol.messages import CameraModel, DetectedBox, Detections, DetectionsHeader, Echo, FrameHeader
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.protocol.transports.open import open_link
from sightline.sim.bus import KEPT, LabelReader
from sightline.vision_side.config import BoxesConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.locate import BoxReader

SOURCE = "guest"
"""Source of the boxes: a service that examines frames and does not drive."""


def boxes_message(
    header: FrameHeader, labels: Iterable[dict[str, Any]], size: CameraModel | JpegSize, session: str, seq: int
) -> tuple[bytes, bytes]:
    """Return header and payload for the channel `detections`: labels of the frame of `header`, in pixels of `size`."""
    boxes = tuple(DetectedBox.model_validate(one) for one in labels)
    stamp = DetectionsHeader(source=SOURCE, session=session, seq=seq, echo=Echo.of(header))
    return encode(stamp), encode(Detections(width_px=size.width_px, height_px=size.height_px, boxes=boxes))


class Labels:
    """Labels in lockstep: stores those of each captured frame, and returns its detections when the frame arrives."""

    def __init__(self, config: BoxesConfig, camera: CameraModel) -> None:
        self._reader = BoxReader(config)
        self._camera = camera
        self._kept: OrderedDict[int, tuple[bytes, bytes]] = OrderedDict()

    def label(self, header: FrameHeader, labels: Iterable[Any]) -> None:
        """Store the simulation's labels of a frame that is sent now."""
        tables = [one._asdict() for one in labels]
        self._kept[header.seq] = boxes_message(header, tables, self._camera, "00000003", header.seq)
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)

    def of(self, header: FrameHeader) -> tuple[FrameHeader, tuple[Detection, ...]]:
        """Return the frame and its detections."""
        self._reader.remember(header)
        return self._reader.read(*self._kept[header.seq], self._camera)


# Publishes the simulation's labels as boxes of a robot's frames, in place of a remote detector. Shell.
#
# It examines no image. The simulation publishes the contents of each image by its capture time.


_WAIT_S = 0.03
"""Wait for a frame. Afterwards it reads the labels of the simulation."""


def run(robot: str, connect: list[str], secure: str, socket_dir: str, show: Callable[[str], None]) -> int:
    """Publish until interrupted. Raises HardwareError when the simulation has ended, LinkError as `open_link` does."""
    labels = LabelReader(socket_dir)
    with open_link(robot, connect=connect, role=SOURCE, secure=secure) as link:
        publisher = LabelPublisher(link, labels)
        show(f"labels: boxes of robot {robot}'s frames go to detections/{SOURCE}")
        try:
            while True:
                publisher.step()
        except KeyboardInterrupt:
            return 0
        finally:
            labels.close()


class LabelPublisher:
    """Receives the frames of one robot and publishes their boxes; the newest frame only."""

    def __init__(self, link: Link, labels: LabelReader) -> None:
        self._link, self._labels = link, labels
        self._frames: LatestSlot[Message] = link.latest(FRAME)
        self._session = secrets.token_hex(4)
        self._seq = 0

    def step(self) -> None:
        """Publish the boxes of the next frame, if one arrives in time."""
        frame = self._frames.take(_WAIT_S)
        self._labels.drain()
        if frame is not None:
            self._publish(frame)

    def _publish(self, frame: Message) -> None:
        """Publish the boxes in pixels of the encoded image, because on a slow link the robot sends smaller ones."""
        try:
            header, size = decode(FrameHeader, frame.header), read_jpeg_size(frame.payload)
        except WireError:
            return
        boxes = self._labels.of(header.t_us, size.width_px)
        if boxes is not None:
            stamp, payload = boxes_message(header, boxes, size, self._session, self._seq)
            self._link.publish(DETECTIONS, stamp, payload)
            self._seq += 1
