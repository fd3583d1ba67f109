"""The simulation's labels as the boxes that a detector elsewhere would publish. Pure."""

from collections import OrderedDict
from collections.abc import Iterable
from typing import Any

from sightline.protocol.codec import encode
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import CameraModel, DetectedBox, Detections, DetectionsHeader, Echo, FrameHeader
from sightline.sim.label_bus import KEPT
from sightline.vision_side.config import BoxesConfig
from sightline.vision_side.detect.boxes import BoxReader
from sightline.vision_side.detect.port import Detection

SOURCE = "guest"
"""Whose boxes they are: somebody's who looks at frames and drives nothing."""


def boxes_message(
    header: FrameHeader, labels: Iterable[dict[str, Any]], size: CameraModel | JpegSize, session: str, seq: int
) -> tuple[bytes, bytes]:
    """Header and payload for the channel `detections`: the labels of the frame of `header`, in pixels of its `size`."""
    echo = Echo(channel="frame", session=header.session, seq=header.seq, t_us=header.t_us)
    boxes = tuple(DetectedBox.model_validate(one) for one in labels)
    stamp = DetectionsHeader(source=SOURCE, session=session, seq=seq, echo=echo)
    return encode(stamp), encode(Detections(width_px=size.width_px, height_px=size.height_px, boxes=boxes))


class Labels:
    """In lockstep: labels each frame as it is captured, and reads the boxes as vision does when the frame arrives."""

    def __init__(self, config: BoxesConfig, camera: CameraModel) -> None:
        self._reader = BoxReader(config)
        self._camera = camera
        self._kept: OrderedDict[int, tuple[bytes, bytes]] = OrderedDict()

    def label(self, header: FrameHeader, labels: Iterable[Any]) -> None:
        """One frame that is sent now, and what the simulation labels in it."""
        tables = [one._asdict() for one in labels]
        self._kept[header.seq] = boxes_message(header, tables, self._camera, "00000003", header.seq)
        if len(self._kept) > KEPT:
            self._kept.popitem(last=False)

    def of(self, header: FrameHeader) -> tuple[FrameHeader, tuple[Detection, ...]]:
        """The frame, and what is meant in it."""
        self._reader.remember(header)
        return self._reader.read(*self._kept[header.seq], self._camera)
