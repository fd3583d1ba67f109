"""A viewer's pictures over real sessions: overlays while vision draws them, else acknowledged frames, else nothing."""

import threading
import time
from contextlib import ExitStack

import pytest

from sightline.operator_side.client import pictures as pictures_module
from sightline.operator_side.client.pictures import Pictures, viewer_role
from sightline.operator_side.cockpit import frame_buffer as reel_module
from sightline.operator_side.cockpit.frame_buffer import FrameBuffer, fill
from sightline.protocol.channels import ACK, FRAME, OVERLAY, STATUS
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, DetectionsHeader, Echo, FrameHeader, Stamp
from sightline.protocol.spec.message_cases import jpeg
from sightline.protocol.transports.open import open_link
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint

PATIENCE_S = 0.3


class Site:
    """A robot, a vision service that publishes given images, and a viewer."""

    def __init__(self, ending: ExitStack, end: str) -> None:
        self.robot = ending.enter_context(open_link("r1", listen=[end], role="robot"))
        self.vision = ending.enter_context(open_link("r1", connect=[end], role="vision"))
        self.link = ending.enter_context(open_link("r1", connect=[end], role="viewer"))
        self.acks = self.robot.latest(ACK)
        self.seq = 0

    def frame(self, payload: bytes = jpeg(320, 240)) -> None:
        self.seq += 1
        self.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=self.seq, t_us=self.seq * 1000)), payload)

    def overlay(self, payload: bytes = jpeg(640, 480)) -> None:
        self.seq += 1
        echo = Echo(channel="frame", session="0000abcd", seq=self.seq, t_us=self.seq * 1000)
        about = DetectionsHeader(source="vision", session="0000beef", seq=self.seq, echo=echo)
        self.vision.publish(OVERLAY, encode(about), payload)


@pytest.fixture(params=["tcp", "ws"])
def site(request, monkeypatch):
    monkeypatch.setattr(pictures_module, "PATIENCE_S", PATIENCE_S)
    end = free_endpoint("ws://") if request.param == "ws" else free_endpoint()
    with ExitStack() as ending:
        yield Site(ending, end)


def taken(pictures, publish, seconds=5.0):
    """The first picture that comes while `publish` is called."""
    found = []
    assert until(lambda: publish() or found.append(pictures.take(0.05)) or found[-1], seconds)
    return found[-1]


def test_overlays_are_taken_without_other_subscriptions(site):
    pictures = Pictures(site.link, "viewer")
    shot = taken(pictures, site.overlay)
    assert (shot.channel, shot.session, shot.seq * 1000, shot.width_px) == (OVERLAY, "0000abcd", shot.t_us, 640)
    assert not site.robot.has_listener(FRAME) and site.acks.take(0.1) is None


def test_viewer_acknowledges_frames_while_vision_is_missing(site):
    pictures = Pictures(site.link, "viewer")
    shot = taken(pictures, site.frame)
    assert shot.channel is FRAME and (shot.width_px, shot.height_px) == (320, 240)
    ack = site.acks.take(2.0)
    assert ack is not None and decode(AnswerHeader, ack.header).echo.session == "0000abcd"
    assert taken(pictures, site.overlay).channel is OVERLAY
    assert until(lambda: taken(pictures, site.overlay) and not site.robot.has_listener(FRAME))
    site.vision.close()
    assert until(lambda: taken(pictures, site.frame).channel is FRAME)


def test_viewer_of_frames_receives_frames(site):
    pictures = Pictures(site.link, "viewer", FRAME)
    assert taken(pictures, site.frame).channel is FRAME
    assert not site.vision.has_listener(OVERLAY)


def test_nothing_is_subscribed_without_a_viewer(site):
    pictures = Pictures(site.link, "viewer")
    assert not site.vision.has_listener(OVERLAY)
    taken(pictures, site.frame)
    pictures.pause()
    assert until(lambda: not site.vision.has_listener(OVERLAY) and not site.robot.has_listener(FRAME))
    assert taken(pictures, site.overlay).channel is OVERLAY


def test_invalid_image_is_counted_and_skipped(site):
    pictures = Pictures(site.link, "viewer")
    assert until(lambda: site.overlay(b"junk") or (pictures.take(0.05) is None and pictures.rejected), 5.0)
    assert taken(pictures, site.overlay).width_px == 640


def test_silent_robot_is_not_online(site, monkeypatch):
    monkeypatch.setattr(pictures_module, "SILENT_S", 0.3)
    pictures = Pictures(site.link, "viewer")
    assert not pictures.is_online
    said = encode(Stamp(session="0000abcd", seq=1, t_us=5_000_000))
    assert until(lambda: site.robot.publish(STATUS, said, b"{}") and pictures.is_online)
    shot = taken(pictures, site.overlay)
    assert pictures.age_us(shot) > 4_000_000
    assert until(lambda: not pictures.is_online, 2.0)


def test_page_gets_the_next_image_on_request_and_none_is_fetched_without_one(site, monkeypatch):
    monkeypatch.setattr(reel_module, "IDLE_S", 0.4)
    pictures, buffer, ending = Pictures(site.link, "viewer"), FrameBuffer(2), threading.Event()
    filling = threading.Thread(target=fill, args=(buffer, pictures, ending), daemon=True)
    filling.start()
    try:
        assert buffer.next(0, 0.05) is None
        assert until(lambda: site.vision.has_listener(OVERLAY))
        numbers = []
        while len(numbers) < 5:
            site.overlay()
            found = buffer.next(numbers[-1] if numbers else 0, 0.05)
            numbers += [found.number] if found else []
        assert numbers == [1, 2, 3, 4, 5]
        assert [one.number for one in buffer.shots] == [4, 5] and buffer.of(3) is None and buffer.of(5) is not None
        site.overlay()
        time.sleep(0.1)
        assert buffer.next(0, 0.0).number == 5  # without a request for a sixth
        assert until(lambda: not site.vision.has_listener(OVERLAY), 3.0)
        assert buffer.next(99, 0.0).number == 5  # a page of an earlier run
    finally:
        ending.set()
        filling.join(3.0)


def test_frame_buffer_over_http_numbers_its_images(site):
    pictures, buffer = Pictures(site.link, "viewer"), FrameBuffer(2, lambda shot: 7)
    buffer.add(taken(pictures, site.overlay))
    answer = buffer.route({"after": "0"}, b"")
    assert answer.body == jpeg(640, 480)
    assert answer.headers["X-Channel"] == "overlay" and answer.headers["X-Age-Us"] == "7"
    assert buffer.route({"number": "1"}, b"").status == 200 and buffer.route({"number": "2"}, b"").status == 204


def test_viewer_with_operator_keys_has_the_operator_role(tmp_path):
    assert viewer_role("") == "viewer" and viewer_role(str(tmp_path)) == "viewer"
    (tmp_path / "operator.token").write_text("x" * 16)
    assert viewer_role(str(tmp_path)) == "operator"
