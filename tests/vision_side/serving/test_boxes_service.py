"""Steering by boxes of another service: the applied ones, their echo, and their absence."""

import math
import threading
from dataclasses import dataclass

import pytest

from sightline.protocol.channels import ACK, CAMERA, DETECTIONS, FRAME, MISSION, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import (
    AnswerHeader,
    DetectedBox,
    Detections,
    DetectionsHeader,
    Echo,
    FrameHeader,
    MissionRequest,
    RequestHeader,
    Stamp,
    Status,
)
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.serving.process import serve
from sightline.vision_side.serving.service import BoxesService
from sightline.vision_side.tracking.locate import REMEMBERED, locate_box
from tests.fixtures.links import START_S, until
from tests.fixtures.robot_process import RobotProcess
from tests.fixtures.vision.vision import Rig, acquired_at, ball_about_lens, camera, circle, errors_after, still

MODEL = camera()
FRAME_US = 33_333
CONFIG = VisionConfig.model_validate({"detector": {"kind": "boxes"}, "boxes": {"label": "ball", "height_m": 0.2}})
PERSON = DetectedBox(label="person", score=0.9, x1_px=0.0, y1_px=0.0, x2_px=40.0, y2_px=200.0)


def ball_at(x_m: float, y_m: float, score: float = 0.8) -> DetectedBox:
    """The box of a ball of 0.2 m, as a flat thing of that size would have it."""
    right, down, ahead = ball_about_lens(MODEL, x_m, y_m)
    cx, cy = MODEL.cx_px + MODEL.fx_px * right / ahead, MODEL.cy_px + MODEL.fy_px * down / ahead
    half = MODEL.fx_px * 0.1 / ahead
    return DetectedBox(label="ball", score=score, x1_px=cx - half, y1_px=cy - half, x2_px=cx + half, y2_px=cy + half)


class Bench:
    """A robot's end of a link in memory, a detector, and the service between them."""

    def __init__(self, config: VisionConfig = CONFIG) -> None:
        self.network = MemoryNetwork(seed=5)
        self.robot, self.guest = self.network.link("r1"), self.network.link("r1", role="guest")
        self.twists: LatestSlot[Message] = self.robot.latest(TWIST)
        self.acks: LatestSlot[Message] = self.robot.latest(ACK)
        self.said: list[str] = []
        self.service = BoxesService(config, self.network.link("r1", role="vision"), self.said.append)
        self.sent = 0
        self.now_us = 0
        self.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=1, t_us=0)), encode(MODEL))
        self.turn()

    def frame(self, seq: int) -> None:
        header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * FRAME_US)
        self.robot.publish(FRAME, encode(header), b"nobody here looks at it")
        self.turn()

    def boxes(self, seq: int | None, *boxes: DetectedBox, source: str = "guest", number: int | None = None,
              t_us: int | None = None, session: str = "9999aaaa") -> None:
        self.sent += 1
        moment = seq * FRAME_US if seq is not None and t_us is None else t_us
        echo = None if seq is None else Echo(channel="frame", session="0000abcd", seq=seq, t_us=moment)
        number = self.sent if number is None else number
        header = DetectionsHeader(source=source, session=session, seq=number, echo=echo)
        found = Detections(width_px=MODEL.width_px, height_px=MODEL.height_px, boxes=boxes)
        self.guest.publish(DETECTIONS, encode(header), encode(found), source)
        self.turn()

    def turn(self) -> None:
        self.now_us += FRAME_US
        self.network.advance(self.now_us)
        self.service.turn(0.0)
        self.network.advance(self.now_us)

    def twist(self):
        """The newest twist and the seq of the frame it cites; None if none came."""
        message = self.twists.take()
        return message and (parse_twist(message.payload), decode(AnswerHeader, message.header).echo.seq)


def test_a_frame_is_acknowledged_and_its_boxes_are_answered_by_a_twist_that_cites_it():
    bench = Bench()
    for seq in range(1, 11):
        bench.frame(seq)
        assert decode(AnswerHeader, bench.acks.take().header).echo.seq == seq and bench.twist() is None
        if seq > 3:
            bench.boxes(seq - 3, PERSON, ball_at(1.6, 0.2))
            twist, cited = bench.twist()
            assert cited == seq - 3 and twist.angular_rad_s > 0 and bench.acks.take() is None
    assert twist.linear_mps > 0 and bench.service.skipped == {}


def test_no_answer_differs_from_an_empty_result():
    bench = Bench()
    for seq in range(1, 40):
        bench.frame(seq)
        assert bench.twist() is None
    assert "searching" not in " ".join(bench.said)
    for seq in range(40, 60):
        bench.frame(seq)
        bench.boxes(seq, PERSON)
    assert bench.twist()[0].angular_rad_s != 0 and any("searching" in line for line in bench.said)


@pytest.mark.parametrize(("small", "count"), [(1.0, 0), (1.99, 0), (2.0, 1), (9.0, 1)])
def test_boxes_from_0_to_1_steer_nothing_and_are_reported(small, count):
    """Before, the robot turned to the upper left corner of the image."""
    bench = Bench()
    bench.frame(1)
    bench.boxes(1, DetectedBox(label="ball", score=0.9, x1_px=0.2, y1_px=0.1, x2_px=small, y2_px=0.7), PERSON)
    assert (bench.twist() is not None) is bool(count)
    is_reported = any("rejecting boxes: all boxes lie within two pixels" in line for line in bench.said)
    assert is_reported is not bool(count) and bench.service.skipped == ({} if count else {"MALFORMED": 1})
    bench.frame(2)
    bench.boxes(2, ball_at(1.6, 0.2))
    assert bench.twist() is not None


@pytest.mark.parametrize(("senders", "lines"), [
    ("a" * 40, 0), ("a" * 20 + "b" * 20, 0), ("abababab" + "b" * 40, 0), ("00112233445566778899aabbccddeeff", 0),
    ("ab" * 20, 1), ("aab" * 10, 1), ("aabb" * 10, 1),
])
def test_several_services_of_one_name_are_reported_once_and_a_new_start_or_a_change_is_not(senders, lines):
    """Before, the robot turned between their targets without a line."""
    bench = Bench()
    for seq, sender in enumerate(senders, 1):
        bench.frame(seq)
        bench.boxes(seq, ball_at(1.6, 0.2), session=sender * 8)
    assert sum("several services send boxes as guest" in line for line in bench.said) == lines


@pytest.mark.parametrize(("ahead_us", "refused"), [(400_000, ""), (600_000, "FROM_FUTURE")])
def test_mission_is_not_of_the_future_because_boxes_of_old_frames_come(ahead_us, refused, monkeypatch):
    bench = Bench()
    monkeypatch.setattr(bench.service, "_now_us", lambda: bench.now_us)
    for seq in range(1, 40):
        bench.frame(seq)
    echo = Echo(channel="status", session="0000abcd", seq=4, t_us=39 * FRAME_US + ahead_us)
    header = RequestHeader(source="operator", session="0000feed", seq=1, echo=echo)
    bench.network.link("r1", role="operator").publish(
        MISSION, encode(header), encode(MissionRequest(id=1, name="band")), "operator")
    bench.boxes(10, PERSON)
    assert bench.service._mission_channel._requests.rejection.partition(":")[0] == refused


def test_another_source_steers_only_if_it_is_the_configured_one():
    others = CONFIG.model_copy(update={"boxes": CONFIG.boxes.model_copy(update={"source": "yolo"})})
    for config, obeyed in ((CONFIG, False), (others, True)):
        bench = Bench(config)
        bench.frame(1)
        bench.boxes(1, ball_at(1.0, 0.3), source="yolo")
        assert (bench.twist() is not None) == obeyed


def test_boxes_of_an_unknown_frame_are_counted_and_move_nothing():
    bench = Bench()
    for seq in range(1, 4):
        bench.frame(seq)
    bench.boxes(None, ball_at(1.0, 0.3))
    bench.boxes(9, ball_at(1.0, 0.3))
    bench.boxes(2, ball_at(1.0, 0.3), t_us=2 * FRAME_US + 1)
    assert bench.twist() is None and bench.service.skipped == {"UNKNOWN_FRAME": 3}
    assert len([line for line in bench.said if "rejecting boxes" in line]) == 1
    bench.boxes(2, ball_at(1.0, 0.3))
    assert bench.twist() is not None


def test_boxes_that_are_rejected_now_and_then_are_not_logged_each_time():
    bench = Bench()
    for seq in range(1, 12):
        bench.frame(seq)
        bench.boxes(seq, ball_at(1.0, 0.3))
        bench.boxes(seq + 99, ball_at(1.0, 0.3))
    assert bench.service.skipped == {"UNKNOWN_FRAME": 11}
    lines = [line.rpartition("(")[2] for line in bench.said if "boxes" in line]
    used = "vision: boxes from guest"
    assert lines == [used, "1 so far)", used, "10 so far)", used]


def test_replaced_boxes_are_not_replaced_frames():
    bench = Bench()
    bench.frame(1)
    for number in (1, 2):
        header = DetectionsHeader(source="guest", session="9999aaaa", seq=number)
        bench.guest.publish(DETECTIONS, encode(header), encode(Detections(width_px=320, height_px=240)))
    bench.turn()
    assert bench.service.counts().overtaken == 0
    for seq in (2, 3):
        bench.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=seq, t_us=seq * FRAME_US)), b"image")
    bench.turn()
    assert bench.service.counts().overtaken == 1
    assert bench.service.counts().received == 3, "boxes are not frames"


def test_frames_that_a_standby_receives_count_as_received():
    bench = Bench()
    bench.frame(1)
    before = bench.service.counts()
    bench.service.rest()
    bench.frame(2)
    assert bench.service.counts().received == before.received == 1
    bench.service.listen()
    bench.frame(3)
    after = bench.service.counts()
    assert (after.received, after.answered, after.overtaken) == (2, before.answered, before.overtaken)


def test_only_frames_have_a_queue_age():
    bench = Bench()
    bench.frame(1)
    bench.boxes(1, ball_at(1.0, 0.3))
    assert len(bench.service._queue_ages_us) == 1 and bench.service.counts().busy_us > 0


def test_lost_frames_count_also_next_to_replaced_ones():
    """The header of each replaced frame is noted, so that it leaves no gap. Three of 25 frames do not arrive."""
    bench = Bench()
    for seq in range(1, 21):
        bench.frame(seq)
    for seq in (24, 25):
        bench.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=seq, t_us=seq * FRAME_US)), b"image")
    bench.turn()
    assert bench.service.counts().overtaken == 1
    share = 1 - (63 / 64) ** 3
    assert bench.service._loss._share == pytest.approx(share * (63 / 64) ** 2)


def test_boxes_of_a_frame_that_is_not_newer_move_nothing():
    bench = Bench()
    for seq in range(1, 5):
        bench.frame(seq)
    bench.boxes(2, ball_at(1.0, 0.3), number=7)
    assert bench.twist() is not None
    for seq in (2, 1):
        bench.boxes(seq, ball_at(1.0, 0.3), number=8)
        assert bench.twist() is None
    assert bench.service.skipped == {"OUT_OF_ORDER": 2}
    bench.boxes(3, ball_at(1.0, 0.3), number=1)
    assert bench.twist() is not None, "a guest without a session of its own that came again counts from 1"


def test_only_the_last_frames_are_remembered():
    bench = Bench()
    for seq in range(1, REMEMBERED + 3):
        bench.frame(seq)
    bench.boxes(2, ball_at(1.0, 0.3))
    assert bench.twist() is None and bench.service.skipped == {"UNKNOWN_FRAME": 1}
    bench.boxes(3, ball_at(1.0, 0.3))
    assert bench.twist() is not None


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b'{"width_px":320,"height_px":240,"boxes":[{}]}',
                                     b'{"width_px":640,"height_px":480,"boxes":[]}', b"\xff" * 40])
def test_broken_boxes_are_counted_and_end_nothing(payload):
    bench = Bench()
    bench.frame(1)
    echo = Echo(channel="frame", session="0000abcd", seq=1, t_us=FRAME_US)
    header = DetectionsHeader(source="guest", session="9999aaaa", seq=1, echo=echo)
    bench.guest.publish(DETECTIONS, encode(header), payload)
    bench.turn()
    assert bench.twist() is None and bench.service.skipped == {"MALFORMED": 1}
    bench.boxes(1, ball_at(1.0, 0.3), number=2)
    assert bench.twist() is not None


def test_the_surest_box_of_the_label_is_followed():
    bench = Bench()
    bench.frame(1)
    bench.boxes(1, ball_at(1.0, -0.3, 0.3), PERSON, ball_at(1.0, 0.3, 0.9), ball_at(0.6, -0.2, 0.2))
    assert bench.twist()[0].angular_rad_s > 0


@pytest.mark.parametrize(("x_m", "y_m"), [(1.0, 0.0), (2.5, 0.8), (0.6, -0.3)])
@pytest.mark.parametrize("pitch_rad", [0.0, 0.2])
def test_box_of_known_size_gives_a_position_and_unknown_size_a_direction(x_m, y_m, pitch_rad):
    model = camera(pitch_rad=pitch_rad)
    right, down, ahead = ball_about_lens(model, x_m, y_m)
    u, v, half = right / ahead, down / ahead, 0.1 / ahead
    edges = [model.cx_px + model.fx_px * (u - half), model.cy_px + model.fy_px * (v - half),
             model.cx_px + model.fx_px * (u + half), model.cy_px + model.fy_px * (v + half)]
    one = Detection(*edges, 0.9, "ball")
    for sizes in ({"height_m": 0.2}, {"width_m": 0.2}):
        place = locate_box(one, model, CONFIG.boxes.model_copy(update={"height_m": None, **sizes}), 0.8)
        assert (place.x_m, place.y_m) == pytest.approx((x_m, y_m), abs=1e-6)
    place = locate_box(one, model, CONFIG.boxes.model_copy(update={"height_m": None}), 0.8)
    assert math.hypot(place.x_m - model.x_m, place.y_m) == pytest.approx(0.8)
    assert math.atan2(place.y_m, place.x_m - model.x_m) == pytest.approx(math.atan2(y_m, x_m - model.x_m))


def test_box_cut_by_the_border_has_no_range_and_an_empty_box_no_position():
    cut = Detection(100.0, 150.0, 140.0, 240.0, 0.9, "person")
    tall = CONFIG.boxes.model_copy(update={"height_m": 1.7})
    place = locate_box(cut, MODEL, tall, 1.5)
    assert math.hypot(place.x_m - MODEL.x_m, place.y_m) == pytest.approx(1.5)
    both = tall.model_copy(update={"width_m": 0.4})
    assert locate_box(cut, MODEL, both, 1.5).x_m - MODEL.x_m == pytest.approx(MODEL.fx_px * 0.4 / 40)
    assert locate_box(Detection(100.0, 100.0, 100.0, 120.0, 0.9, "ball"), MODEL, CONFIG.boxes, 1.0) is None


def test_without_a_size_the_robot_turns_and_does_not_drive():
    config = CONFIG.model_copy(update={"boxes": CONFIG.boxes.model_copy(update={"height_m": None})})
    bench = Bench(config)
    for seq in range(1, 20):
        bench.frame(seq)
        bench.boxes(seq, ball_at(3.0, 0.6))
        twist, _ = bench.twist()
        assert abs(twist.linear_mps) < 0.06 and twist.angular_rad_s > 0.1


@dataclass
class BoxesRig(Rig):
    """The closed loop of `Rig` with a remote detector, whose boxes arrive `detect_s` after the frame."""

    detect_s: float = 0.08

    def _answer(self, t_us: int) -> None:
        while self._up and self._up[0][0] + round(self.detect_s * 1e6) <= t_us:
            _, frame, self._exact.centre = self._up.pop(0)
            seen = [Detection(one.x1_px, one.y1_px, one.x2_px, one.y2_px, one.score, "ball")
                    for one in self._exact.look()]
            answer = self.pipeline.follow(frame.header, tuple(seen))
            self._seen = answer.seen
            if answer.twist is not None and self._rng.random() >= self.loss:
                self._down.append((t_us + round(self.latency_s * 5e5), frame.header.t_us, answer.twist))


@pytest.mark.parametrize("seed", [3, 11])
def test_boxes_80_ms_late_and_lossy_keep_bearing_and_distance(seed):
    config = CONFIG.model_copy(update={"boxes": CONFIG.boxes.model_copy(update={"width_m": 0.2})})
    run = BoxesRig(still(2.5, 0.8), seed=seed, config=config).run(12)
    assert acquired_at(run) < 5
    bearing_deg, distance_m = errors_after(run, 8)
    assert bearing_deg < 0.5 and distance_m < 0.05
    moving = BoxesRig(circle(), seed=seed, config=config).run(20)
    bearing_deg, distance_m = errors_after(moving, 8)
    assert bearing_deg < 0.5 and distance_m < 0.05


class Eyes:
    """A detector on a real link: answers each frame with one box, as found in the frame `late_by` frames before."""

    def __init__(self, link: Link) -> None:
        self.late_by, self.found = 0, 0
        self._recent: list[FrameHeader] = []
        self._link = link
        link.subscribe(FRAME, self._look)

    def _look(self, message: Message) -> None:
        self._recent.append(decode(FrameHeader, message.header))
        del self._recent[:-40]
        frame = self._recent[max(0, len(self._recent) - 1 - self.late_by)]
        self.found += 1
        echo = Echo.of(frame)
        header = DetectionsHeader(source="guest", session="77777777", seq=self.found, echo=echo)
        box = DetectedBox(label="person", score=0.9, x1_px=7.0, y1_px=6.0, x2_px=9.0, y2_px=12.0)
        self._link.publish(DETECTIONS, encode(header), encode(Detections(width_px=16, height_px=16, boxes=(box,))))


def test_over_a_real_link_the_robot_validates_boxes_by_the_frame_they_answer(tmp_path):
    """A real robot process, our service, and a detector that answers fresh frames first and then old ones."""
    config = VisionConfig.model_validate({"detector": {"kind": "boxes"}, "boxes": {"width_m": 1.0}})
    ending, said = threading.Event(), []
    with (RobotProcess(tmp_path) as robot,
          open_zenoh("r1", connect=[robot.endpoint], role="guest", timeout_s=START_S) as far,
          open_zenoh("r1", connect=[robot.endpoint], role="vision", timeout_s=START_S) as link):
        statuses, eyes = far.latest(STATUS), Eyes(far)
        serving = threading.Thread(target=serve, args=(config, link, ending, said.append), daemon=True)
        serving.start()

        def status() -> Status:
            statuses.take()
            return decode(Status, statuses.take(2.0).payload, STATUS.max_payload_bytes)

        try:
            assert until(lambda: robot.speed() > 3, START_S)
            assert status().holder.source == "vision"
            eyes.late_by = 20
            assert until(lambda: status().refused.get("STALE", 0) > 3)
            assert until(lambda: robot.speed() == 0.0, 3)
        finally:
            ending.set()
            serving.join()
    assert any("boxes from guest" in line for line in said)
