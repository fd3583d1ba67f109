"""Overlay and preview over real sessions: only while watched, of the frame they name, after its twist, never queued."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sightline.operator_side.setup import keys
from sightline.protocol.channels import CAMERA, DETECTIONS, FRAME, OVERLAY, PREVIEW, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.log import faults
from sightline.protocol.messages import DetectedBox, Detections, DetectionsHeader, Echo, FrameHeader, Stamp
from sightline.protocol.transports.open import open_link
from sightline.protocol.transports.zenoh.session import open_session
from sightline.vision_side import viewing
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.pipeline import Observation, PipelineAnswer
from sightline.vision_side.serving.service import open_service
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.vision import camera, jpeg_of, scene

MODEL = camera()
BALL = jpeg_of(scene(MODEL, 1.0, 0.2, shaded=True))
BAD = b"\xff\xd8 no picture"


class Site:
    """A robot, its vision and a viewer, each with a link of its own."""

    def __init__(self, ending: ExitStack, end: str, secure: str = "", **config: object) -> None:
        self.robot = ending.enter_context(open_link("r1", listen=[end], role="robot", secure=secure))
        self.link = ending.enter_context(open_link("r1", connect=[end], role="vision", secure=secure))
        self.viewer = ending.enter_context(open_link("r1", connect=[end], role="viewer", secure=secure))
        self.twists = self.robot.latest(TWIST)
        self.said: list[str] = []
        self.service = open_service(VisionConfig.model_validate(config), self.link, self.said.append)
        self.seq = 0
        assert until(lambda: self.robot.has_listener(FRAME) and self.robot.has_listener(CAMERA))
        self.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=1, t_us=0)), encode(MODEL))
        assert until(lambda: self.service.turn(0.01) or self.said)

    def frame(self, jpeg: bytes = BALL) -> FrameHeader:
        """Send a frame and let vision answer it."""
        self.seq += 1
        header = FrameHeader(session="0000abcd", seq=self.seq, t_us=self.seq * 33_333, latency_us=21_000)
        answered = self.service.answered
        self.robot.publish(FRAME, encode(header), jpeg)
        assert until(lambda: self.service.turn(0.05) or self.service.answered > answered)
        return header


@pytest.fixture(params=["tcp", "ws"])
def site(request):
    end = free_endpoint("ws://") if request.param == "ws" else free_endpoint()
    with ExitStack() as ending:
        yield Site(ending, end)


@pytest.fixture
def drawn(monkeypatch):
    """One entry for each image that a thread was requested to draw."""
    requests, submit = [], viewing._DRAWING.submit
    monkeypatch.setattr(viewing._DRAWING, "submit", lambda draw: requests.append(draw) or submit(draw))
    return requests


def pixels(message):
    return cv2.imdecode(np.frombuffer(message.payload, np.uint8), cv2.IMREAD_COLOR)


def test_overlay_without_a_viewer_is_not_drawn(site, drawn):
    for _ in range(5):
        site.frame()
    assert not site.link.has_listener(OVERLAY) and not site.link.has_listener(PREVIEW)
    assert drawn == []


def test_viewer_receives_the_answered_frame_with_its_detections(site):
    overlays = site.viewer.latest(OVERLAY)
    assert until(lambda: site.link.has_listener(OVERLAY))
    header = site.frame()
    message = overlays.take(5.0)
    assert message is not None and message.source == "vision"
    said = decode(DetectionsHeader, message.header)
    assert said.echo == Echo(channel="frame", session=header.session, seq=header.seq, t_us=header.t_us)
    assert said.compute_us > 0 and said.source == "vision"
    shown = pixels(message)
    assert shown.shape == (480, 640, 3)
    plain = cv2.resize(cv2.imdecode(np.frombuffer(BALL, np.uint8), 1), (640, 480))
    differs = np.abs(shown.astype(int) - plain).mean(axis=(1, 2))
    assert differs[60:420].mean() < 8 and differs[:20].mean() > 40  # the picture, and the strip with words
    assert not site.link.has_listener(PREVIEW)


@pytest.mark.parametrize("site", ["tcp"], indirect=True)  # a robot on WebSocket always wants them, to pass them on
def test_subscriber_receives_the_detections_of_each_frame_and_without_one_none_are_encoded(site, monkeypatch):
    encoded = []
    real = viewing.detections_payload
    monkeypatch.setattr(viewing, "detections_payload", lambda result: encoded.append(1) or real(result))
    site.frame()
    assert encoded == []
    found = site.viewer.latest(DETECTIONS)
    assert until(lambda: site.link.has_listener(DETECTIONS))
    header = site.frame()
    message = found.take(5.0)
    assert message.source == "vision" and decode(DetectionsHeader, message.header).echo == Echo.of(header)
    (box,) = decode(Detections, message.payload).boxes
    assert box.x1_px < box.circle.cx_px < box.x2_px and encoded == [1]


def test_viewing_ends_without_viewers(site, drawn):
    overlays, previews = site.viewer.latest(OVERLAY), site.viewer.latest(PREVIEW)
    assert until(lambda: site.link.has_listener(OVERLAY) and site.link.has_listener(PREVIEW))
    site.frame()
    assert overlays.take(5.0) and pixels(previews.take(5.0)).shape == (240, 320, 3)
    site.viewer.unsubscribe(OVERLAY)
    assert until(lambda: not site.link.has_listener(OVERLAY)) and site.link.has_listener(PREVIEW)
    site.viewer.close()
    assert until(lambda: not site.link.has_listener(PREVIEW))
    shown = len(drawn)
    for _ in range(5):
        site.frame()
    assert overlays.take(0.2) is None and len(drawn) == shown >= 1


def test_twist_leaves_before_its_overlay_and_overlays_keep_their_rate(site, monkeypatch):
    arrivals, published, publish = [], [], site.link.publish
    monkeypatch.setattr(site.link, "publish", lambda channel, *of: published.append(channel) or publish(channel, *of))
    site.robot.subscribe(TWIST, lambda message: arrivals.append("twist"))
    site.viewer.subscribe(OVERLAY, lambda message: arrivals.append("overlay"))
    assert until(lambda: site.link.has_listener(OVERLAY))
    started_s = time.monotonic()

    def is_enough():
        return arrivals.count("overlay") >= 10 and arrivals.count("twist") >= 30

    while (lasted_s := time.monotonic() - started_s) < 1.0 or (not is_enough() and lasted_s < 10.0):
        site.frame()  # on a busy machine each thread gets fewer turns
    assert arrivals.count("overlay") >= 10
    lasted_s = time.monotonic() - started_s
    assert published.index(TWIST) < published.index(OVERLAY) and arrivals.count("twist") >= 30
    assert arrivals.count("overlay") <= 15.0 * lasted_s + 2


def test_rejected_image_is_not_shown(site):
    overlays = site.viewer.latest(OVERLAY)
    assert until(lambda: site.link.has_listener(OVERLAY))
    site.frame(BAD)
    assert overlays.take(0.3) is None
    site.frame()
    assert overlays.take(5.0) is not None


def test_image_that_cannot_be_drawn_is_logged_once_and_driving_continues(site, monkeypatch):
    def fail(*_):
        raise RuntimeError("no paint")

    monkeypatch.setattr(viewing, "draw_overlay", fail)
    overlays = site.viewer.latest(OVERLAY)
    assert until(lambda: site.link.has_listener(OVERLAY))
    for _ in range(3):
        site.frame()
        assert site.twists.take(2.0) is not None
        time.sleep(0.08)  # so that it is time for another overlay
    assert until(lambda: site.said.count("vision: cannot show an image: RuntimeError: no paint") == 1)
    assert faults()["viewing"] >= 1
    monkeypatch.undo()
    assert until(lambda: site.frame() and overlays.take(0.1), 5.0)


def test_any_zenoh_tool_sees_the_overlay_as_a_jpeg():
    end = free_endpoint()
    with ExitStack() as ending:
        site = Site(ending, end)
        stranger = open_session((), [end], 5.0)
        ending.callback(stranger.close)
        seen = []
        stranger.declare_subscriber("sightline/r1/overlay/vision", seen.append)
        assert until(lambda: site.link.has_listener(OVERLAY))
        site.frame()
        assert until(lambda: seen)
        assert str(seen[0].encoding) == "image/jpeg"
        assert cv2.imdecode(np.frombuffer(seen[0].payload.to_bytes(), np.uint8), 1).shape == (480, 640, 3)


def test_with_keys_a_viewer_sees_it_and_only_vision_may_publish_it(tmp_path):
    keys.make(tmp_path / "k", ["robot.local"])
    end, folder = free_endpoint("tls/"), str(tmp_path / "k")
    with ExitStack() as ending:
        site = Site(ending, end, folder)
        operator = ending.enter_context(open_link("r1", connect=[end], role="operator", secure=folder))
        overlays = site.viewer.latest(OVERLAY)
        assert until(lambda: site.link.has_listener(OVERLAY))
        header = site.frame()
        assert decode(DetectionsHeader, overlays.take(5.0).header).echo.seq == header.seq
        for source in ("vision", "operator"):
            operator.publish(OVERLAY, b"{}", b"forged", source)
        assert overlays.take(0.5) is None


@pytest.mark.parametrize("transport", ["tcp", "ws"])
def test_remote_boxes_are_drawn_over_their_frame(transport):
    end = free_endpoint("ws://") if transport == "ws" else free_endpoint()
    with ExitStack() as ending:
        site = Site(ending, end, detector={"kind": "boxes"})
        guest = ending.enter_context(open_link("r1", connect=[end], role="guest"))
        site.robot.latest(DETECTIONS)  # as a robot does, to pass them on
        overlays = site.viewer.latest(OVERLAY)
        assert until(lambda: site.link.has_listener(OVERLAY) and guest.has_listener(DETECTIONS))
        header = site.frame()
        echo = Echo.of(header)
        about = DetectionsHeader(source="guest", session="0000beef", seq=1, echo=echo)
        box = DetectedBox(label="ball", score=0.9, x1_px=40.0, y1_px=100.0, x2_px=80.0, y2_px=140.0)
        guest.publish(DETECTIONS, encode(about), encode(Detections(width_px=320, height_px=240, boxes=(box,))), "guest")
        got = []
        assert until(lambda: site.service.turn(0.05) or got.append(overlays.take()) or got[-1])
        assert decode(DetectionsHeader, got[-1].header).echo == echo


def test_robots_draw_in_turn_and_only_their_newest_frame(monkeypatch):
    """One thread, held at its first frame: two more of that robot come, then two of another robot."""
    order, begun, held, real = [], threading.Event(), threading.Event(), viewing.draw_overlay

    def draw(image, shown, width_px):
        begun.set()
        held.wait(5)
        order.append((shown.header.session, shown.header.seq))
        return real(image, shown, width_px)

    monkeypatch.setattr(viewing, "draw_overlay", draw)
    link = SimpleNamespace(has_listener=lambda channel: channel is OVERLAY, publish=lambda *_: None)
    config = VisionConfig.model_validate({"viewing": {"overlay_hz": 60.0}})
    with ThreadPoolExecutor(1) as one:
        monkeypatch.setattr(viewing, "_DRAWING", one)
        views = {session: viewing.ViewPublisher(config, link, lambda *_: None) for session in ("0000aaaa", "0000bbbb")}
        for session, seq in (("0000aaaa", 1), ("0000aaaa", 2), ("0000aaaa", 3), ("0000bbbb", 1), ("0000bbbb", 2)):
            header = FrameHeader(session=session, seq=seq, t_us=seq * 33_333)
            views[session].show(header, PipelineAnswer(None, Observation("lost")), MODEL, started_ns=0, jpeg=BALL)
            time.sleep(0.02)  # the next one is due
            assert begun.wait(5)
        held.set()
        assert until(lambda: len(order) == 3)
    assert order == [("0000aaaa", 1), ("0000bbbb", 2), ("0000aaaa", 3)]


def test_too_large_for_the_channel_is_sent_coarser_or_not_at_all():
    noise = np.random.default_rng(5).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    sizes = [len(viewing._encoded(noise, 80, bound) or b"") for bound in (10**9, 200_000, 120_000, 1_000)]
    assert sizes[0] > 200_000 and 0 < sizes[1] <= 200_000 and sizes[3] == 0 and sizes[0] > sizes[1]
