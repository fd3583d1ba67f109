"""Publishes `overlay`, `preview` and `detections` while a client subscribes to them. Shell (threads)."""

import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from sightline.protocol.channels import DETECTIONS, OVERLAY, PREVIEW, Channel
from sightline.protocol.clock import RobotClock, monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.log import error_text, report_fault
from sightline.protocol.messages import CameraModel, DetectionsHeader, Echo, FrameHeader
from sightline.protocol.transports.link import Link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.port import detections_payload
from sightline.vision_side.overlay import OverlayData, draw_overlay, draw_preview
from sightline.vision_side.pipeline import SOURCE, PipelineAnswer

_EARLY: Final = 0.25
"""Share of a period by which an image may be early. Without it, 15 Hz would often use every third frame of 30 fps."""


class RateLimiter:
    """Limits the mean rate to `rate_hz`."""

    def __init__(self, rate_hz: float) -> None:
        self._period_us = 1e6 / rate_hz
        self._due_us = float("-inf")

    def is_due(self, now_us: int) -> bool:
        """Return True if an image may pass now, and count it."""
        if now_us < self._due_us - _EARLY * self._period_us:
            return False
        # Counted from the due time, so that early and late images do not change the mean; after a pause, from now.
        was_due_us = self._due_us if now_us - self._due_us < self._period_us else now_us
        self._due_us = was_due_us + self._period_us
        return True


# The channels `overlay` and `preview`: only while a viewer subscribes, newest only.
#
# The twist never waits for them. A frame is passed on after its answer is sent, as the received JPEG. A thread of low
# priority decodes, draws and encodes it. Without a viewer, each frame costs one check of the link.


KEPT: Final = 4
"""Stored frames whose answer comes later, from another service's detector. Older frames are not shown."""
NO_PICTURE: Final = "no image"
"""Phase of an image that the pipeline rejected. It is not decoded here either."""
_NICE: Final = 10  # nice value of the drawing threads: the next frame has priority
_QUALITIES_BELOW: Final = (50, 30)
"""Lower qualities for an image above the size limit of the channel. Without success the image is dropped."""


def _become_nice() -> None:
    with suppress(OSError, AttributeError):  # of this thread only, if the system supports it
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)


_DRAWING: Final = ThreadPoolExecutor(os.cpu_count(), "viewing", _become_nice)
"""Shared by the robots of a process, because OpenCV 5 loads its font once per thread, which takes 30 ms of CPU."""


@dataclass(frozen=True, slots=True)
class _Job:
    """One frame to show, and its channels."""

    shown: OverlayData
    jpeg: bytes
    channels: tuple[Channel, ...]
    started_ns: int


class ViewPublisher:
    """The images that a vision service publishes for one robot."""

    def __init__(self, config: VisionConfig, link: Link, log_change: Callable[[str, str], None]) -> None:
        """Create the publisher. `log_change(subject, line)` prints a changed line."""
        self._config, self._link, self._log_change = config, link, log_change
        self._paces = {OVERLAY: RateLimiter(config.viewing.overlay_hz), PREVIEW: RateLimiter(config.viewing.preview_hz)}
        self._kept: deque[tuple[FrameHeader, bytes]] = deque(maxlen=KEPT)
        self._lock = threading.Lock()
        self._newest: _Job | None = None
        self._is_drawing = False
        """True from the request for a thread to the end of its drawing."""
        self._session = secrets.token_hex(4)
        self._seqs = {OVERLAY: 0, PREVIEW: 0, DETECTIONS: 0}
        self._decoder: Decoder | None = None
        self._clock = RobotClock()

    def keep(self, header: FrameHeader, jpeg: bytes) -> None:
        """Store a frame whose answer comes later."""
        if any(self._link.has_listener(channel) for channel in self._paces):
            self._kept.append((header, jpeg))
        else:
            self._kept.clear()

    def show(
        self, header: FrameHeader, answer: PipelineAnswer, camera: CameraModel | None, *, started_ns: int,
        jpeg: bytes | None = None,
    ) -> None:
        """Publish an answered frame for viewers, if one is due. Without `jpeg` it uses a stored frame."""
        now_us = monotonic_us()
        self._clock.update(header.session, header.t_us, now_us)
        channels = tuple(
            channel for channel, pace in self._paces.items() if self._link.has_listener(channel) and pace.is_due(now_us)
        )
        if not channels:
            return
        jpeg = jpeg if jpeg is not None else self._kept_of(header)
        if jpeg is None or camera is None or answer.seen.phase == NO_PICTURE:
            return
        shown = OverlayData(header, answer.seen, answer.twist, answer.mission, camera, self._config.target.radius_m,
                      self._clock.age_us(header.session, header.t_us, now_us))
        with self._lock:
            self._newest = _Job(shown, jpeg, channels, started_ns)
            self._draw_newest()

    def publish_detections(self, header: FrameHeader, answer: PipelineAnswer, started_ns: int) -> None:
        """Publish the detections of an answered frame, if a client subscribes to them."""
        if answer.result is None or not self._link.has_listener(DETECTIONS):
            return
        try:
            payload = detections_payload(answer.result)
        except ValueError as error:  # from a plug-in
            self._log_change("detections", f"the result cannot be sent: {error_text(error)}")
            return
        self._link.publish(DETECTIONS, self._header(DETECTIONS, header, started_ns), payload, SOURCE)

    def _kept_of(self, header: FrameHeader) -> bytes | None:
        return next((jpeg for kept, jpeg in self._kept if kept == header), None)

    def _draw_newest(self) -> None:
        """Request a thread, unless one is requested or no frame is new. The caller holds the lock."""
        if self._newest is not None and not self._is_drawing:
            self._is_drawing = True
            with suppress(RuntimeError):  # the process ends
                _DRAWING.submit(self._draw)

    # --- on a drawing thread -----------------------------------------------------------------------------------------

    def _draw(self) -> None:
        with self._lock:
            job, self._newest = self._newest, None
        assert job is not None
        try:
            self._publish(job)
        except Exception as error:  # e.g. invalid detections of a plug-in; the robot must continue
            text = report_fault("viewing", error)
            self._log_change("viewing", f"cannot show an image: {type(error).__name__}: {text}")
        with self._lock:
            self._is_drawing = False
            self._draw_newest()

    def _publish(self, job: _Job) -> None:
        picture = self._decoded(job)
        for channel, drawn, quality in self._views(picture, job):
            jpeg = _encoded(drawn, quality, channel.max_payload_bytes)
            if jpeg is not None:
                self._link.publish(channel, self._header(channel, job.shown.header, job.started_ns), jpeg, SOURCE)

    def _views(self, picture: NDArray[np.uint8], job: _Job) -> Iterator[tuple[Channel, NDArray[np.uint8], int]]:
        config = self._config.viewing
        if OVERLAY in job.channels:
            yield OVERLAY, draw_overlay(picture, job.shown, config.overlay_width_px), config.overlay_quality_percent
        if PREVIEW in job.channels:
            yield PREVIEW, draw_preview(picture, config.preview_width_px), config.preview_quality_percent

    def _decoded(self, job: _Job) -> NDArray[np.uint8]:
        """Decode the image, no larger than necessary. Raises WireError for an image not of the camera's size."""
        camera, config = job.shown.camera, self._config
        if self._decoder is None or self._decoder.size_px != (camera.width_px, camera.height_px):
            self._decoder = Decoder(camera.width_px, camera.height_px, config.max_pixels)
        self._decoder.check(job.jpeg)
        widest = config.viewing.overlay_width_px if OVERLAY in job.channels else config.viewing.preview_width_px
        wanted = min(widest, camera.width_px)
        pixels: NDArray[np.uint8] = simplejpeg.decode_jpeg(
            job.jpeg, "BGR", fastdct=True, fastupsample=True, min_width=wanted,
            min_height=wanted * camera.height_px // camera.width_px,
        )
        return pixels

    def _header(self, channel: Channel, frame: FrameHeader, started_ns: int) -> bytes:
        self._seqs[channel] += 1
        compute_us = (time.perf_counter_ns() - started_ns) // 1000
        return encode(DetectionsHeader(source=SOURCE, session=self._session, seq=self._seqs[channel],
                                       echo=Echo.of(frame), compute_us=max(0, compute_us)))


def _encoded(picture: NDArray[np.uint8], quality: int, most_bytes: int) -> bytes | None:
    """Encode as JPEG at the best quality within the bound, or return None."""
    for percent in (quality, *(one for one in _QUALITIES_BELOW if one < quality)):
        jpeg: bytes = simplejpeg.encode_jpeg(
            np.ascontiguousarray(picture), quality=percent, colorspace="BGR", colorsubsampling="420", fastdct=True
        )
        if len(jpeg) <= most_bytes:
            return jpeg
    return None
