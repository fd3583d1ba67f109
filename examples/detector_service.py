"""A detector in a separate process: a robot's frames in, boxes out, for any vision service. Shell.

    python examples/detector_service.py tcp/127.0.0.1:7447 r1
    sightline vision --detector boxes --set boxes.source=detector --set boxes.height_m=0.2

Put your network into `look`; this one finds the largest yellow object by its color. It does not drive: boxes name their
frame, the vision service answers that frame, and the robot validates its age.
"""

import itertools
import secrets
import sys
import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.protocol.channels import DETECTIONS, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import RejectReason, SightlineError, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import DetectedBox, Detections, DetectionsHeader, Echo, FrameHeader
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.open import open_link

SOURCE, SESSION = "detector", secrets.token_hex(4)
YELLOW = (18, 128, 40), (34, 255, 255)
"""Hue (0 to 180), saturation, value (0 to 255) in OpenCV's units: limited on both sides, to exclude green and skin."""
SMALLEST_PX = 6

Pixels = NDArray[Any]


def look(bgr: Pixels) -> tuple[DetectedBox, ...]:
    """Find objects in an image, best first. An empty result means that the image has none."""
    mask = cv2.inRange(cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV), np.array(YELLOW[0]), np.array(YELLOW[1]))
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    x, y, width, height = cv2.boundingRect(max(outlines, key=cv2.contourArea)) if outlines else (0, 0, 0, 0)
    if min(width, height) < SMALLEST_PX:
        return ()
    return (DetectedBox(label="ball", score=0.9, x1_px=x, y1_px=y, x2_px=x + width, y2_px=y + height),)


def boxes_of(jpeg: bytes) -> Detections:
    """Find objects in a JPEG. Raises WireError for other data, before it is decoded."""
    size = read_jpeg_size(jpeg)
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        raise WireError(RejectReason.MALFORMED, "the image does not decode")
    return Detections(width_px=size.width_px, height_px=size.height_px, boxes=look(bgr))


def answer(message: Message, seq: int) -> tuple[bytes, bytes]:
    """Return header and payload of the boxes in a frame. Raises WireError if it is invalid."""
    started_ns = time.perf_counter_ns()
    frame = decode(FrameHeader, message.header)
    found = boxes_of(message.payload)
    compute_us = (time.perf_counter_ns() - started_ns) // 1000
    header = DetectionsHeader(source=SOURCE, session=SESSION, seq=seq, echo=Echo.of(frame), compute_us=compute_us)
    return encode(header), encode(found)


def serve(endpoint: str, robot: str) -> None:
    """Process the newest frame, forever. Newer frames replace each other in one slot meanwhile."""
    with open_link(robot, connect=[endpoint], role=SOURCE) as link:
        print(f"detector: detecting in the images of {robot} at {endpoint}", flush=True)
        frames, seq = link.latest(FRAME), itertools.count(1)
        while True:
            message = frames.take(1.0)
            if message is None:
                continue
            try:
                header, payload = answer(message, next(seq))
            except WireError as error:  # an invalid image ends nothing
                print(f"detector: {error}", flush=True)
                continue
            link.publish(DETECTIONS, header, payload)


if __name__ == "__main__":
    try:
        serve(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "r1")
    except IndexError:
        sys.exit("error: which robot? give its endpoint, e.g. detector_service.py tcp/127.0.0.1:7447 r1")
    except SightlineError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        pass
