"""What is configured of a model that is asked by the Open Inference Protocol, over HTTP and gRPC alike. Pure."""

from typing import Annotated, Literal

from pydantic import Field

from sightline.protocol.config import Config as Settings
from sightline.vision_side.config import Fraction
from sightline.vision_side.detect.labels import Label
from sightline.vision_side.detect.remote.boxes_read import MIN_SCORE
from sightline.vision_side.detect.remote.deadline import MAX_PIXELS, PixelBound
from sightline.vision_side.detect.remote.oip import OutputOptions


class OipSettings(Settings):
    """The detectors `oip+http` and `oip+grpc`."""

    address: str
    labels: Annotated[tuple[Label, ...], Field(max_length=1024)] = ()
    """Names of labels that the model gives as numbers, from 0 on."""
    min_score: Fraction = MIN_SCORE
    order: Literal["bgr", "rgb"] = "bgr"
    """Of the colours, where the model takes pixels."""
    max_pixels: PixelBound = MAX_PIXELS

    def looking(self) -> OutputOptions:
        """How its answers are read."""
        return OutputOptions(self.labels, self.min_score, self.order == "rgb")
