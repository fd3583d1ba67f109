"""The reference vision in virtual time: the service's own logic, answering over a network in memory. Pure.

What a picture holds is computed once per picture and process: the pictures of the kit are few, the runs are many.
"""

from dataclasses import dataclass
from functools import cache

from sightline.conformance.benches import TO_ROBOT, VirtualBench
from sightline.conformance.case import Access, Bench
from sightline.protocol.errors import WireError
from sightline.protocol.messages import CameraModel, FrameHeader
from sightline.protocol.transports.memory import MemoryLink, MemoryNetwork
from sightline.vision_side.config import BoxesConfig, VisionConfig
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.color.hsv import HsvDetector
from sightline.vision_side.detect.port import Detection, Maker, result_of
from sightline.vision_side.pipeline import Pipeline, PipelineAnswer
from sightline.vision_side.serving.service import BoxesService, Service

COMPUTE_US = 2_000
"""Compute time that the reference reports for a frame; virtual answers take a step of 5 ms."""
CONFIG = VisionConfig()
KEYS = Access({"vision": "0123456789abcdefABCDEF_-"})
"""A vision service behind keys must prove its twists; a network in memory checks no token."""


@dataclass(frozen=True, slots=True)
class SeenImage(DecodedImage):
    """An image and what is in it."""

    detections: tuple[Detection, ...]


@cache
def _looked_at(width_px, height_px, jpeg):
    """Return the image, or the error that makes it invalid."""
    try:
        picture = Decoder(width_px, height_px, CONFIG.max_pixels).decode(jpeg)
    except WireError as error:
        return error
    return SeenImage(picture.bgr, picture.scale, tuple(HsvDetector(CONFIG.hsv).detect(picture)))


class RememberingDecoder:
    """Decodes each image once in a process."""

    def __init__(self, camera: CameraModel) -> None:
        self.size_px = camera.width_px, camera.height_px

    def decode(self, jpeg):
        found = _looked_at(*self.size_px, jpeg)
        if isinstance(found, WireError):
            raise WireError(found.reason, found.detail)
        return found

    check = decode


class RememberingDetector:
    """Returns what the decoder has seen."""

    def detect(self, frames, deadline_us):
        return [result_of(frame, frame.picture().detections, Maker("hsv", device="cpu")) for frame in frames]


class VirtualVision(Service):
    """The reference. `tick` is its turn; broken ones override a step of it."""

    def __init__(self, network: MemoryNetwork, robot: str = "r1") -> None:
        self.network = network
        self.link: MemoryLink = network.link(robot, role="vision")
        self.now_us = 0
        super().__init__(CONFIG, self.link, lambda line: None, RememberingDetector())

    def tick(self, now_us: int) -> None:
        self.now_us = now_us
        self.turn(0.0)

    def _now_us(self) -> int:
        return self.now_us

    def _use(self, camera: CameraModel) -> None:
        self._camera, self._pipeline = camera, self.pipeline(camera)

    def pipeline(self, camera: CameraModel) -> Pipeline:
        made = Pipeline(CONFIG, camera, RememberingDetector())  # a detector of its own would build its colour table
        made._decoder = RememberingDecoder(camera)
        return made

    def _publish(self, header: FrameHeader, answer: PipelineAnswer, compute_us: int) -> None:
        super()._publish(header, answer, COMPUTE_US)


class VirtualBoxes(BoxesService):
    """The reference without a detector: it steers by the boxes of `detector`."""

    def __init__(self, network: MemoryNetwork, robot: str = "r1") -> None:
        self.network, self.now_us = network, 0
        config = CONFIG.model_copy(update={"boxes": BoxesConfig(source="detector")})
        super().__init__(config, network.link(robot, role="vision"), lambda line: None)

    def tick(self, now_us: int) -> None:
        self.now_us = now_us
        self.turn(0.0)

    def _now_us(self) -> int:
        return self.now_us


BY_BOXES = ("V-STEER-13", "V-STEER-14", "V-STEER-15", "V-STEER-16")
"""Cases for a service that steers by boxes. For a service with a detector they are not applicable."""


def reference(case: str) -> type[Service]:
    """Return the service that conforms in a case."""
    return VirtualBoxes if case in BY_BOXES else VirtualVision


def virtual_bench(vision=VirtualVision) -> Bench:
    """A bench of its own with one vision."""
    network = MemoryNetwork()
    return VirtualBench(network, [vision(network)], TO_ROBOT, access=KEYS)
