"""The detector service and `--detector zenoh`, over real Zenoh sessions: frames to one, boxes to the other."""

import threading
import time
from collections import Counter
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pytest

from sightline.operator_side.client.discovery import as_object, lines
from sightline.protocol.channels import DETECTIONS, FRAME, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.messages import (
    DetectedBox,
    Detections,
    DetectionsHeader,
    Echo,
    FrameHeader,
    Stamp,
    State,
    Status,
)
from sightline.protocol.transports.zenoh.discovery import Discovered, discover
from sightline.protocol.transports.zenoh.link import open_fleet, open_zenoh
from sightline.vision_side.config import DetectorConfig, HsvConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.port import DetectFrame
from sightline.vision_side.detect.remote.zenoh_detector import ZenohDetector
from sightline.vision_side.serving.detector_service import ROLE, DetectorService, ServingOptions
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.remote import BALL_JPEG, GREY_JPEG, frame, within
from tests.fixtures.vision.vision import jpeg_of

CORNERS = ("x1_px", "y1_px", "x2_px", "y2_px")
DEADLINE_S = DetectorConfig().deadline_s
HSV = Hsv(Hsv.Config(hsv=HsvConfig()))


class Robot:
    """A robot that subscribes to boxes, publishes its status, and sends given frames."""

    def __init__(self, name, endpoint, listens=False):
        ends = {"listen": [endpoint]} if listens else {"connect": [endpoint]}
        self.name, self.link, self.seq = name, open_zenoh(name, role="robot", **ends), 0
        self.session = f"{sum(name.encode()):08x}"
        self.said = self.link.latest(DETECTIONS)

    def here(self):
        stamp = Stamp(session=self.session, seq=1, t_us=1)
        self.link.publish(STATUS, encode(stamp), encode(Status(state=State.HOLD, reason="test")))

    def frame(self, jpeg=BALL_JPEG, header=None):
        """Send one frame, and return it as a vision service passes it to a detector."""
        self.seq += 1
        stamp = FrameHeader(session=self.session, seq=self.seq, t_us=self.seq * 33_333)
        self.link.publish(FRAME, encode(stamp) if header is None else header, jpeg)
        return DetectFrame(self.name, stamp, jpeg, Decoder(320, 240, 1920 * 1080))

    def say(self, asked, *boxes, source=ROLE, by="00000009", model="", width_px=320, **changes):
        """Publish boxes as a service does, or as a hostile service does."""
        echo = Echo(channel="frame", session=asked.header.session, seq=asked.header.seq, t_us=asked.header.t_us)
        header = DetectionsHeader(source=ROLE, session=by, seq=1, echo=echo.model_copy(update=changes))
        said = Detections(width_px=width_px, height_px=240, boxes=boxes, model=model)
        self.link.publish(DETECTIONS, encode(header), encode(said), source)


@contextmanager
def _served(service):
    """Its thread, ended whatever happens: one that is left would keep the whole test run from its end."""
    over = threading.Event()
    thread = threading.Thread(target=service.serve, args=(over,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(5)


class Bench:
    """A detector service that is the router, and robots that connect to it."""

    def __init__(self, ending, detector=HSV, **serving):
        self.endpoint, self.words = free_endpoint(), []
        site = ending.enter_context(open_fleet("*", listen=[self.endpoint], role=ROLE, about=self._about))
        options = ServingOptions("hsv", **{"deadline_us": 5_000_000, **serving})
        self.service = DetectorService(site, detector, options, self.words.append)
        ending.enter_context(_served(self.service))
        self._ending = ending

    def _about(self):
        return self.service.about()

    def robot(self, name):
        robot = Robot(name, self.endpoint)
        self._ending.callback(robot.link.close)
        assert until(lambda: (robot.here(), f"detector: receives the frames of {name}" in self.words)[1])
        return robot

    def detector(self, *robots):
        """Return a detector as in a vision service, attached to a link of each robot."""
        one = ZenohDetector(ZenohDetector.Config())
        for name in robots:
            one.attach(self._ending.enter_context(open_zenoh(name, connect=[self.endpoint])))
        return one


@pytest.fixture
def bench():
    with ExitStack() as ending:
        yield Bench(ending)


def _result(robot, detector, jpeg=BALL_JPEG, seconds=0.3):
    return detector.detect([robot.frame(jpeg)], within(seconds))[0]


def test_boxes_name_the_frame_of_the_robot(bench):
    robot = bench.robot("r1")
    detector = bench.detector("r1")
    assert until(lambda: _result(robot, detector))
    result = _result(robot, detector, seconds=5)
    expected = HSV.detect([frame()], 0)[0].detections[0]
    found = result.detections[0]
    assert [getattr(found, name) for name in CORNERS] == [getattr(expected, name) for name in CORNERS]
    assert found.circle.radius_px == pytest.approx(expected.circle.radius_px)
    assert (result.robot, result.session, result.seq) == ("r1", robot.session, robot.seq)
    assert (result.detector, result.device) == ("hsv", "cpu"), "the result names the remote detector and its device"
    assert _result(robot, detector, GREY_JPEG, 5).detections == (), "an image without a target is an answer too"


def test_one_detector_serves_every_robot_of_a_fleet(bench):
    robots = [bench.robot(name) for name in ("r1", "r2", "r3")]
    detector = bench.detector("r1", "r2", "r3")
    assert until(lambda: all(_result(robot, detector) for robot in robots))
    for robot in robots:
        assert (result := _result(robot, detector, seconds=5)).robot == robot.name and result.session == robot.session


def test_missing_link_is_reported():
    alone = ZenohDetector(ZenohDetector.Config())
    assert alone.detect([frame()], within(0.1)) == [None] and alone.rejected == {"UNREACHABLE": 1}
    assert "no link to robot r1" in alone.notices()[0]


def test_a_bad_image_and_a_bad_header_get_no_answer_and_are_counted(bench):
    robot = bench.robot("r1")
    detector = bench.detector("r1")
    assert until(lambda: _result(robot, detector))
    before = bench.service.counters()["r1"].rejected
    for count, (jpeg, header) in enumerate([(b"", None), (BALL_JPEG[:300], None), (b"GIF89a", None), (b"", b"{}")], 1):
        asked = robot.frame(jpeg, header)
        assert detector.detect([asked], within(0.05)) == [None]
        # The service detects in the newest frame alone: one that is sent before may be replaced and never counted.
        assert until(lambda count=count: bench.service.counters()["r1"].rejected == before + count)
    assert _result(robot, detector, seconds=5) is not None


@pytest.mark.parametrize("size", [(1, 1), (15, 400), (8200, 16)])
def test_image_of_another_size_is_rejected_before_detection(bench, size):
    robot, odd = bench.robot("r1"), bench.robot("r2")
    detector = bench.detector("r1")
    odd.frame(jpeg_of(np.full((size[1], size[0], 3), 128, np.uint8)))
    assert until(lambda: "r2" in (of := bench.service.counters()) and of["r2"].rejected == 1)
    assert until(lambda: _result(robot, detector)) and len(bench.words) == 2, bench.words


class Faulty:
    """Does what a plug-in should not, one thing for each frame; then it looks."""

    def __init__(self):
        self.asked = 0

    def detect(self, frames, deadline_us):
        self.asked += 1
        if self.asked == 1:
            raise RuntimeError("out of memory")
        if self.asked == 2:
            return []
        seen = HSV.detect(frames, deadline_us)
        return [replace(one, seq=one.seq + 1) for one in seen] if self.asked == 3 else seen


def test_failing_detector_gives_no_answer_and_the_service_continues():
    with ExitStack() as ending:
        faulty = Faulty()
        bench = Bench(ending, faulty)
        robot = bench.robot("r1")
        for asked in (1, 2, 3):
            robot.frame()
            assert until(lambda asked=asked: getattr(bench.service.counters().get("r1"), "rejected", 0) == asked)
        detector = bench.detector("r1")
        assert until(lambda: _result(robot, detector)), "and then it looks"
        assert [line for line in bench.words if "out of memory" in line], bench.words
        assert len(bench.words) == 4, "each reason once"


def test_presence_shows_model_device_and_health_of_a_service(bench):
    robot = bench.robot("r1")
    detector = bench.detector("r1")
    assert until(lambda: _result(robot, detector))
    peers = discover([bench.endpoint], 1.0).peers
    said = next(line for line in lines(Discovered({}, peers)) if line.startswith("detector"))
    assert "of *" in said and "hsv on cpu: 1 robots" in said and "p95 age" in said
    whole = as_object(Discovered({}, peers))
    assert "hsv on cpu" in next(one["about"] for one in whole["peers"] if one["role"] == "detector")


def test_lost_service_gives_no_answer_by_the_deadline_and_recovers():
    endpoint = free_endpoint()
    with ExitStack() as ending:
        robot = Robot("r1", endpoint, listens=True)
        ending.callback(robot.link.close)
        detector = ZenohDetector(ZenohDetector.Config())
        detector.attach(ending.enter_context(open_zenoh("r1", connect=[endpoint])))
        for _ in range(2):
            assert not _result(robot, detector, seconds=0.05)
            with (
                open_fleet("*", connect=[endpoint], role=ROLE) as site,
                _served(DetectorService(site, HSV, ServingOptions("hsv"), lambda line: None)),
            ):
                assert until(lambda: (robot.here(), _result(robot, detector, seconds=DEADLINE_S))[1], 3.0)
        assert "LATE" in detector.rejected and any("answers again" in line for line in detector.notices())


# --- hostile answers -------------------------------------------------------------------------------------------------

BOX = DetectedBox(label="ball", score=0.9, x1_px=10.0, y1_px=10.0, x2_px=30.0, y2_px=30.0)
OTHER = DetectedBox(label="box", score=0.9, x1_px=50.0, y1_px=10.0, x2_px=90.0, y2_px=30.0)


def _label(waiting, asked, seconds=1.0):
    """Return the label of the first box in a frame, or None without an answer."""
    result = waiting.detect([asked], within(seconds))[0]
    return result and result.detections[0].label


@pytest.fixture
def pair():
    """A robot, and who waits for boxes over a link of its own."""
    endpoint = free_endpoint()
    with ExitStack() as ending:
        robot = Robot("r1", endpoint, listens=True)
        # Otherwise the service takes the robot for the listener that waits.
        robot.link.unsubscribe(DETECTIONS)
        service = open_zenoh("r1", connect=[endpoint], role=ROLE)
        link = open_zenoh("r1", connect=[endpoint])
        for one in (robot.link, service, link):
            ending.callback(one.close)
        waiting = ZenohDetector(ZenohDetector.Config())
        waiting.attach(link)
        robot.link = service
        assert until(lambda: service.has_listener(DETECTIONS))
        yield robot, waiting


@pytest.mark.parametrize(("changes", "reason"), [
    ({"session": "0000ffff"}, "OTHER_FRAME"), ({"t_us": 1}, "OTHER_FRAME"), ({"seq": 0, "t_us": 10**9}, "OTHER_FRAME"),
    ({"seq": 9, "t_us": 1}, "OTHER_FRAME"), ({"channel": "status"}, "OTHER_FRAME"), ({"width_px": 640}, "OTHER_SIZE"),
])  # fmt: skip
def test_boxes_of_another_frame_or_size_are_rejected_and_counted(pair, changes, reason):
    robot, waiting = pair
    asked = frame(3)
    robot.say(asked, BOX, **changes)
    waited = Counter()

    def is_refused():
        """Every wait that ends without an answer is itself LATE."""
        waited["LATE"] += 1
        assert waiting.detect([asked], within(0.05)) == [None]
        return waiting.rejected - waited

    assert until(is_refused) and waiting.rejected - waited == {reason: 1}
    robot.say(asked, BOX)
    assert until(lambda: waiting.detect([asked], within(0.05))[0])


@pytest.mark.parametrize("payload", [
    b"", b"{", b"<html>", b"[" * 9_000, b'{"width_px":320,"height_px":240,"boxes":[{}]}', b"\xff" * 32_768,
    b'{"width_px":320,"height_px":240,"boxes":[NaN]}',
])  # fmt: skip
def test_invalid_detections_message_is_rejected_and_counted(pair, payload):
    robot, waiting = pair
    asked = frame(3)
    echo = Echo(channel="frame", session=asked.header.session, seq=3, t_us=asked.header.t_us)
    robot.link.publish(DETECTIONS, encode(DetectionsHeader(source=ROLE, session="00000009", seq=1, echo=echo)), payload)
    assert until(lambda: waiting.detect([asked], within(0.05)) == [None] and waiting.rejected["MALFORMED"])


def test_boxes_of_an_older_frame_are_dropped_without_a_log_line(pair):
    """The vision service requests only the newest frame's boxes; the detector service looks at all frames."""
    robot, waiting = pair
    for seq in range(4):
        robot.say(frame(seq), BOX)
        time.sleep(0.02)
    assert waiting.detect([frame(9)], within(0.1)) == [None] and waiting.rejected == {"LATE": 1}


def test_first_of_two_services_is_used_until_it_is_silent(pair):
    """Two trackers' identities, or two models' boxes in turns, would steer by neither."""
    robot, waiting = pair
    robot.say(frame(2), BOX, by="00000001")
    labels = {_label(waiting, frame(2))}
    for seq in range(3, 20):
        for box, by in sorted(((BOX, "00000001"), (OTHER, "00000002")), key=lambda pair: pair[1], reverse=seq % 2):
            robot.say(frame(seq), box, by=by, model=8 * by[-1])
        labels.add(_label(waiting, frame(seq)))
    assert labels == {"ball"} and not waiting.rejected
    assert sum("several services look at robot r1" in line for line in waiting.notices()) == 1
    robot.say(frame(20), OTHER, by="00000002", model="22222222")
    assert _label(waiting, frame(20), 0.1) is None, "a model of its own"
    time.sleep(0.6)
    robot.say(frame(21), OTHER, by="00000002", model="22222222")
    assert _label(waiting, frame(21)) == "box", "the first one is gone"


def test_service_with_the_same_model_replaces_a_missing_answer_in_time(pair):
    """It is the next one of several that share the robots: the first one has ended."""
    robot, waiting = pair
    robot.say(frame(2), BOX, by="00000001", model="11111111")
    assert _label(waiting, frame(2)) == "ball"
    robot.say(frame(3), OTHER, by="00000002", model="11111111")
    began_s = time.monotonic()
    assert _label(waiting, frame(3), 2.0) == "box" and 0.5 < time.monotonic() - began_s < 2.0
    began_s = time.monotonic()
    robot.say(frame(4), BOX, by="00000002", model="11111111")
    assert _label(waiting, frame(4), 4.0) == "ball" and time.monotonic() - began_s < 2.0, "it is the preferred one now"
    assert not waiting.rejected and waiting.notices() == ["detector zenoh (detector) answers"]


def test_service_with_the_same_model_is_used_immediately_after_a_missed_answer(pair):
    robot, waiting = pair
    robot.say(frame(2), BOX, by="00000001")
    assert _label(waiting, frame(2)) == "ball" and _label(waiting, frame(3), 0.05) is None
    robot.say(frame(4), OTHER, by="00000002")
    began_s = time.monotonic()
    assert _label(waiting, frame(4), 1.0) == "box" and time.monotonic() - began_s < 0.4


def test_preferred_service_that_is_a_little_later_is_used(pair):
    robot, waiting = pair
    for seq, by in ((2, "00000001"), (3, "00000002"), (3, "00000001")):
        robot.say(frame(seq), BOX if by == "00000001" else OTHER, by=by)
        if seq == 2:
            assert _label(waiting, frame(2)) == "ball"
    assert _label(waiting, frame(3)) == "ball"


def test_newer_boxes_of_the_next_service_are_stored_for_their_frame(pair):
    robot, waiting = pair
    robot.say(frame(2), BOX, by="00000001")
    assert _label(waiting, frame(2)) == "ball"
    robot.say(frame(4), OTHER, by="00000002")
    assert _label(waiting, frame(3), 1.0) is None and waiting.rejected == {"OTHER_FRAME": 1}
    assert _label(waiting, frame(4), 0.0) == "box"


def test_invalid_service_does_not_block_a_valid_service(pair):
    robot, waiting = pair
    for seq in range(3, 6):
        robot.say(frame(seq), BOX, by="00000002", session="0000ffff")
        assert waiting.detect([frame(seq)], within(0.1)) == [None]
        robot.say(frame(seq + 10), BOX, by="00000001")
        assert waiting.detect([frame(seq + 10)], within(1.0))[0]


def test_invalid_boxes_end_the_wait_only_if_they_are_of_the_preferred_service(pair):
    robot, waiting = pair
    robot.say(frame(2), BOX, by="00000001")
    assert _label(waiting, frame(2)) == "ball"
    robot.say(frame(3), BOX, by="00000002", width_px=640)
    time.sleep(0.02)
    robot.say(frame(3), BOX, by="00000001")
    assert _label(waiting, frame(3)) == "ball" and set(waiting.rejected) <= {"OTHER_SIZE"}
    robot.say(frame(4), BOX, by="00000001", width_px=640)
    began_s = time.monotonic()
    assert _label(waiting, frame(4), 1.5) is None and time.monotonic() - began_s < 1.0


def test_boxes_of_another_source_are_ignored(pair):
    robot, waiting = pair
    asked = frame(3)
    robot.say(asked, BOX, source="guest")
    assert waiting.detect([asked], within(0.1)) == [None] and waiting.rejected == {"LATE": 1}


@pytest.mark.parametrize("ahead_us", [10**12, 900_000])
def test_boxes_of_an_unknown_frame_delay_only_briefly(pair, ahead_us):
    robot, waiting = pair
    robot.say(frame(3), BOX, seq=10**9, t_us=frame(3).header.t_us + ahead_us)
    assert until(lambda: waiting.detect([frame(3)], within(0.05)) == [None] and waiting.rejected["OTHER_FRAME"])
    seq = 3 + ahead_us // 33_333 + 1 if ahead_us < 10**6 else 4  # once the frames are past it, at once if it is far off
    robot.say(frame(seq), BOX)
    assert waiting.detect([frame(seq)], within(1.0))[0], "one message must not blind it for good"


def test_slow_reader_gets_the_stored_boxes_of_its_frame(pair):
    robot, waiting = pair
    for said, asked, is_answered in ((5, 4, False), (6, 5, True)):
        robot.say(frame(said), BOX)
        time.sleep(0.05)
        answer = waiting.detect([frame(asked)], within(0.5))[0]
        assert (answer is not None) is is_answered, (asked, waiting.rejected)


def test_boxes_of_a_newer_frame_end_the_waiting_and_are_kept_for_it(pair):
    robot, waiting = pair
    asked, newer = frame(3), frame(4)
    robot.say(newer, BOX)
    began_s = time.monotonic()
    assert waiting.detect([asked], within(2.0)) == [None] and waiting.rejected == {"OTHER_FRAME": 1}
    assert time.monotonic() - began_s < 1.0
    assert waiting.detect([newer], within(0.5))[0].detections[0].x2_px == BOX.x2_px
