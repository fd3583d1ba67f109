"""The missions that a vision service accepts, its reports, and the scans for a mission."""

import array
import math
import struct
from dataclasses import replace
from functools import partial

import pytest

from sightline.operator_side.client.missions import mission_lines
from sightline.protocol import log
from sightline.protocol.channels import CAMERA, FRAME, MISSION, REPORT, SCAN, TWIST
from sightline.protocol.codec import decode, encode, encode_ranges
from sightline.protocol.messages import (
    AnswerHeader,
    DetectionsHeader,
    Echo,
    FrameHeader,
    MissionReport,
    MissionRequest,
    RequestHeader,
    RequestId,
    ScanHeader,
    Stamp,
)
from sightline.protocol.proof import session_digest
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.detect.filters import LabelFilter, TrackIds
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.pipeline import Observation
from sightline.vision_side.serving import mission_channel
from sightline.vision_side.serving.dry_run import AckingService
from sightline.vision_side.serving.mission_channel import LEAST_GAP_S, PERIOD_S, Reporter, reported_target
from sightline.vision_side.serving.service import Service
from tests.fixtures.vision.vision import camera, jpeg_of, scene

MODEL = camera()
BALL = jpeg_of(scene(MODEL, 1.0, 0.2, shaded=True))
FRAME_US = 33_333
COLOR = VisionConfig(detector=DetectorConfig(kind="hsv"))
TARGET = Detection(100.0, 40.0, 140.0, 80.0, 0.9, "ball", Circle(120.0, 70.0, 20.0), track_id=7)
LONG = "\N{LARGE YELLOW CIRCLE}" * 200
SESSION, ASKER = "0000abcd", "0000feed"


class Bench:
    """A robot, an operator and the vision service; `reports` are all received reports."""

    def __init__(self, service=Service, config=None):
        self.network = MemoryNetwork(seed=3)
        self.robot, self.person = self.network.link("r1"), self.network.link("r1", role="operator")
        self.twists, self.reports, self.said, self.seq = self.robot.latest(TWIST), [], [], 0
        self.applied, self.image = (0.0, 0.0), BALL
        self.person.subscribe(REPORT, self.reports.append)
        self.service = service(config or COLOR, self.network.link("r1", role="vision"), self.said.append)
        self.robot.publish(CAMERA, encode(Stamp(session=SESSION, seq=1, t_us=0)), encode(MODEL))
        self.turn()

    def turn(self):
        self.network.advance(self.network.now_us + FRAME_US)
        self.service.turn(0.0)
        self.network.advance(self.network.now_us + 1)

    def frames(self, count=1, session=SESSION):
        for _ in range(count):
            self.seq += 1
            header = FrameHeader(session=session, seq=self.seq, t_us=self.seq * FRAME_US, applied=self.applied)
            self.robot.publish(FRAME, encode(header), self.image)
            self.turn()
        return self

    def answer(self) -> AnswerHeader:
        """The newest answer's header, after one more frame."""
        self.frames()
        return decode(AnswerHeader, self.twists.take().header)

    def ask(self, name="band", number=1, source="operator", key_source="", age_us=0, session=SESSION, echo=True,
            **what):
        cited = Echo(channel="status", session=session, seq=4, t_us=self.seq * FRAME_US - age_us) if echo else None
        header = RequestHeader(source=source, session=ASKER, seq=number, echo=cited)
        self.person.publish(MISSION, encode(header), encode(MissionRequest(id=number, name=name, **what)),
                            key_source or source)
        return self

    def report(self) -> MissionReport:
        """The newest, once it had its time."""
        self.service._mission_channel._reporter._reported_s = -1e9
        self.frames()
        return decode(MissionReport, self.reports[-1].payload, REPORT.max_payload_bytes)


def test_requested_mission_is_applied_cited_and_reported():
    bench = Bench().frames(5)
    assert bench.answer().mission is None
    bench.ask("band", 7, options={"linear_mps": 0.2})
    asked = RequestId(digest=session_digest("operator", ASKER), id=7)
    assert bench.frames(6).answer().mission == asked
    report = bench.report()
    assert (report.mission, report.phase, report.refused, report.done) == ("band", "forward", "", False)
    assert (report.asked, report.detector, report.device) == (asked, "hsv", "cpu")
    header = decode(DetectionsHeader, bench.reports[-1].header)
    assert (header.source, header.echo.channel, header.echo.seq) == ("vision", "frame", bench.seq)
    assert any("mission band, requested by operator" in line for line in bench.said)


def test_repeated_request_is_applied_once():
    bench = Bench().frames(5).ask("band", 1).frames(6)
    bench.applied = (0.2, 0.0)  # a robot that drives stands still before a new mission
    for _ in range(4):
        assert bench.ask("band", 1).report().phase == "forward"
    bench.ask("band", 2).frames()
    assert bench.service._pipeline._request == RequestId(digest=session_digest("operator", ASKER), id=2)


@pytest.mark.parametrize(("how", "words"), [
    ({"name": "bnad"}, "no mission called 'bnad'; did you mean 'band'?"),
    ({"name": "goto"}, "option 'waypoints' is missing"),
    ({"options": {"speed": 1.0}}, "unknown option 'speed'"),
    ({"options": {"averaged": "many"}}, "option 'averaged'"),
    ({"source": "guest"}, "UNKNOWN_SOURCE: guest chooses no mission; operator and teleop do"),
    ({"source": "vision"}, "UNKNOWN_SOURCE"),
    ({"source": "operator", "key_source": "teleop"}, "UNKNOWN_SOURCE: key and header disagree"),
    ({"echo": False}, "NOT_ALLOWED: a mission cites the newest status"),
    ({"session": "0000beef"}, "OTHER_SESSION"),
    ({"age_us": 2_100_000}, "STALE: requested 2.1 s ago; repeat the request"),
])
def test_rejected_mission_is_reported_and_changes_nothing(how, words):
    bench = Bench().frames(80).ask(**{"name": "band", **how}).frames(3)
    assert bench.answer().mission is None and bench.service._pipeline.mission.name == "follow"
    report = bench.report()
    assert report.mission == "follow" and words in report.refused and report.asked.id == 1
    bench.ask("band", 2).frames(5)
    assert (bench.report().refused, bench.answer().mission.id) == ("", 2)


@pytest.mark.parametrize("wrap", [lambda inner: inner, TrackIds, lambda inner: LabelFilter(inner, ("ball", "legs"))])
def test_mission_by_a_label_that_the_detector_never_gives_is_rejected(wrap):
    inner = configured_detector(COLOR)
    inner.labels = ("ball", "legs", "light-red")
    bench = Bench(partial(Service, detector=wrap(inner))).frames(5)
    rejection = bench.ask("follow", 1, options={"target.label": "legz"}).frames(3).report().refused
    assert rejection == "mission 'follow': hsv has no label 'legz'; did you mean 'legs'?"
    assert bench.ask("follow", 2, options={"target.label": "legs"}).frames(3).report().refused == ""


def test_a_filter_leaves_only_its_own_labels_to_missions():
    inner = configured_detector(COLOR)
    inner.labels = ("ball", "legs")
    bench = Bench(partial(Service, detector=LabelFilter(inner, ("ball",)))).frames(5)
    assert "no label 'legs'; it gives ball" in bench.ask("legs", 1).frames(3).report().refused


@pytest.mark.parametrize("payload", [b"", b"{", b"[]", b'{"id":1}', b'{"id":1,"name":"os:system"}', b"\xff" * 40])
def test_a_broken_mission_is_counted_and_ends_nothing(payload):
    bench = Bench().frames(5)
    header = RequestHeader(source="operator", session=ASKER, seq=1)
    bench.person.publish(MISSION, encode(header), payload)
    bench.frames()
    assert bench.service.skipped["MALFORMED"] == 1 and bench.twists.take() is not None
    assert "MALFORMED" in bench.report().refused


def test_new_robot_session_ends_the_requested_mission_and_reports_it():
    bench = Bench().frames(5).ask("band", 3).frames(6)
    bench.frames(2, session="0000beef")
    bench.service._mission_channel._reporter._reported_s = -1e9
    bench.frames(1, session="0000beef")
    report = decode(MissionReport, bench.reports[-1].payload)
    assert (report.mission, report.asked.id) == ("follow", 3) and "a new session" in report.refused


def test_robot_has_a_requested_mission_until_its_session_ends():
    """Also after a request that was rejected, and after one that cannot be read."""
    bench = Bench().frames(5)
    assert not bench.service.has_request
    assert bench.ask("band", 1).frames().service.has_request
    assert bench.ask("folow", 2).frames().service.has_request
    header = RequestHeader(source="operator", session=ASKER, seq=3)
    bench.person.publish(MISSION, encode(header), b"{")
    assert bench.frames().service.has_request
    assert bench.service.skipped["MALFORMED"] == 1 and bench.report().mission == "band"
    assert not bench.frames(session="0000beef").service.has_request


def test_only_the_driving_vision_accepts_missions():
    bench = Bench(AckingService).frames(5).ask("band").frames(5)
    assert bench.reports == [] and bench.service._pipeline.mission.name == "follow"


# --- reports ---------------------------------------------------------------------------------------------------------


def test_reports_come_twice_a_second_and_immediately_on_a_change():
    reporter, told = Reporter(DetectorConfig()), []
    for at in range(300):
        now_s = at / 100
        seen = Observation("tracking" if at < 200 or at % 4 < 2 else "coasting", note=f"{at}")
        if reporter.due(now_s, "follow", seen, None, "") is not None:
            told.append(now_s)
    assert [one for one in told if one < 2] == [0.0, PERIOD_S, 2 * PERIOD_S, 3 * PERIOD_S]
    late = [one for one in told if one >= 2]
    assert 8 <= len(late) <= 1 / LEAST_GAP_S + 1


def test_reports_with_a_target_come_ten_times_a_second():
    due = Reporter(DetectorConfig()).due
    seen = Observation("tracking", target=TARGET)
    reports = [report for step in range(31) if (report := due(step / 30, "follow", seen, None, "", camera=MODEL))]
    assert 9 <= len(reports) <= 11 and all(report.target.label == "ball" for report in reports)


@pytest.mark.parametrize(("changes", "center_px", "radius_px"), [
    ({}, (120.0, 70.0), 20.0), ({"circle": None}, (120.0, 60.0), None),
])
def test_report_names_the_target_its_place_and_the_size_of_the_image(changes, center_px, radius_px):
    seen = Observation("tracking", target=replace(TARGET, **changes), bearing_rad=-0.1, distance_m=0.8, track=12)
    target = reported_target(seen, MODEL)
    assert (target.cx_px, target.cy_px) == center_px and target.radius_px == radius_px
    assert (target.label, target.score, target.track) == ("ball", 0.9, 12)
    assert (target.bearing_rad, target.distance_m) == (-0.1, 0.8)
    assert (target.width_px, target.height_px) == (MODEL.width_px, MODEL.height_px)


@pytest.mark.parametrize(("target", "model"), [
    (None, MODEL), (TARGET, None), (replace(TARGET, label=""), MODEL), (replace(TARGET, score=math.nan), MODEL),
])
def test_target_that_is_missing_or_cannot_be_sent_is_absent(target, model):
    assert reported_target(Observation("tracking", target=target), model) is None


@pytest.mark.parametrize(("rejection", "fault", "lost"), [
    ("", "", set()), (LONG, "", {"note"}), (LONG, "x" * 300, {"note", "target"}),
    (LONG, "x" * 1200, {"note", "target", "refused"}), (LONG, "x" * 3000, {"note", "target", "refused", "faults"}),
])
def test_report_that_is_too_long_for_the_wire_loses_first_its_note(monkeypatch, rejection, fault, lost):
    monkeypatch.setattr(mission_channel, "faults", lambda: {fault: 1} if fault else {})
    seen = Observation(LONG, target=replace(TARGET, label=LONG[:64]), note=LONG)
    report = Reporter(DetectorConfig(kind=LONG)).due(0.0, LONG, seen, None, rejection, camera=MODEL)
    assert len(encode(report)) <= REPORT.max_payload_bytes and report.phase == LONG[:32]
    given = {"note": LONG, "target": True, "refused": rejection, "faults": fault}
    assert {name for name, value in given.items() if value and not getattr(report, name)} == lost


def test_vision_service_reports_the_target_in_the_image_of_its_frame():
    bench = Bench()
    bench.frames(3)
    newest = bench.reports[-1]
    header, report = decode(DetectionsHeader, newest.header), decode(MissionReport, newest.payload)
    assert report.target.bearing_rad == pytest.approx(math.atan2(0.2, 1.0), abs=0.02)
    assert report.target.distance_m == pytest.approx(math.hypot(0.2, 1.0), abs=0.1)
    assert header.echo.seq == report.target.track == 1 and report.target.width_px == MODEL.width_px


def test_report_contains_the_mission_text_on_one_bounded_line():
    report = Reporter(DetectorConfig()).due(
        0.0, "m" * 90, Observation("two\nlines" + "x" * 90, note="a\n" * 300), None, ""
    )
    assert "\n" not in report.phase + report.note and decode(MissionReport, encode(report), 2048) == report


class Raising:
    """A detector with a bug, or a mission with one."""

    def detect(self, frames, deadline_us):
        raise RuntimeError("no such layer")

    def step(self, view):
        raise RuntimeError("no such step")


@pytest.mark.parametrize("part", ["detector", "mission"])
def test_an_exception_of_a_plug_in_is_logged_once_counted_and_in_the_report(part, caplog, monkeypatch):
    monkeypatch.setattr(log, "_faults", log.Counter())
    monkeypatch.setattr(log, "_kinds", set())
    bench = Bench().frames()
    pipeline = bench.service._pipeline
    if part == "detector":
        pipeline._detector = Raising()
    else:
        pipeline._mission_switch._mission = Raising()
    report = bench.frames(5).report()
    assert report.faults == {part: 6 if part == "detector" else 1}, "a mission that failed is over"
    (record,) = [one for one in caplog.records if one.levelname == "ERROR"]
    assert record.message.startswith(f"{part} raised RuntimeError: no such") and record.exc_info
    assert f"faults    {part} " in "\n".join(mission_lines(report))


# --- scans -----------------------------------------------------------------------------------------------------------


GOTO = VisionConfig.model_validate({"mission": {"kind": "goto", "options": {"waypoints": [[2.0, 0.0]]}}})


def scan(seq, payload=None, session=SESSION, t_us=None):
    header = ScanHeader(session=session, seq=seq, t_us=seq * FRAME_US if t_us is None else t_us, angle_min_rad=-0.5,
                        angle_increment_rad=0.1, range_min_m=0.02, range_max_m=0.2)
    return encode(header), encode_ranges(array.array("f", [0.1] * 11)) if payload is None else payload


def test_a_mission_that_uses_scans_is_given_the_newest_and_cites_it():
    bench = Bench(config=GOTO)
    assert bench.answer().scan is None
    for seq in (3, 4, 5):
        bench.robot.publish(SCAN, *scan(seq))
    assert [bench.answer().scan for _ in range(2)] == [5, 5]
    bench.robot.publish(SCAN, *scan(9, session="0000beef"))
    assert [bench.answer().scan for _ in range(2)] == [None, None], "possibly another robot's"
    bench.robot.publish(SCAN, *scan(10))
    assert bench.answer().scan == 10
    bench.robot.publish(SCAN, *scan(11, t_us=2**53 - 1))
    assert bench.answer().scan == 10 and bench.service.skipped["FROM_FUTURE"] == 1
    bench.robot.publish(SCAN, *scan(12))
    assert bench.answer().scan == 12


@pytest.fixture(params=[0, 700_000])
def late(request, monkeypatch):
    """A bench, and the time for which each frame waits there for its turn. Both clocks run alike."""
    bench, taken = Bench(), [0]
    take = bench.service._frames.take

    def taken_late(wait_s):
        taken[0] = bench.seq
        return take(wait_s)

    def now_us():
        return bench.seq * FRAME_US + (request.param if taken[0] == bench.seq else 0)

    monkeypatch.setattr("sightline.vision_side.serving.service.monotonic_us", now_us)
    monkeypatch.setattr(bench.service._frames, "take", taken_late)
    return bench, request.param


def test_mission_that_cites_a_status_of_the_future_is_rejected(late):
    bench, waited_us = late
    bench.frames(2).ask(age_us=-600_000 - waited_us)
    newer_s = (600_000 + waited_us - FRAME_US) / 1e6
    assert bench.report().refused == (f"FROM_FUTURE: cites a status {newer_s:.1f} s newer than the newest frame here; "
                                      "repeat the request")
    assert bench.ask(number=2, age_us=-400_000 - waited_us).report().refused == ""


def test_mission_with_a_frame_that_the_network_delayed_is_applied(monkeypatch):
    """An operator cites the newest status. The newest frame here may be older, by as much as the frame was late."""
    bench, late_us = Bench(), 0
    monkeypatch.setattr("sightline.vision_side.serving.service.monotonic_us", lambda: bench.seq * FRAME_US + late_us)
    bench.frames(30)
    late_us = 700_000
    assert bench.ask(age_us=-late_us).report().refused == ""
    assert bench.ask(number=2, age_us=-late_us - 600_000).report().refused.startswith("FROM_FUTURE")


def test_scan_of_the_future_is_rejected(late):
    bench, waited_us = late
    bench.frames(5).ask("goto", waypoints=((1.0, 1.0),)).frames(6)
    for ahead_us, scans in ((600_000, None), (400_000, 4)):
        bench.robot.publish(SCAN, *scan(4, t_us=bench.seq * FRAME_US + ahead_us + waited_us))
        assert bench.answer().scan == scans


def test_scans_are_subscribed_only_for_a_mission_that_uses_them():
    bench = Bench().frames(5)
    assert not bench.robot.has_listener(SCAN)
    bench.ask("goto", waypoints=((1.0, 1.0),)).frames(6)
    assert bench.robot.has_listener(SCAN)
    bench.robot.publish(SCAN, *scan(7))
    assert bench.answer().scan == 7


@pytest.mark.parametrize(("payload", "reason"), [
    (struct.pack("<2f", 1.0, float("nan")), "NOT_FINITE"),
    (struct.pack("<f", -0.5), "NOT_FINITE"),
    (bytes(6), "MALFORMED"),
])
def test_a_scan_that_is_invalid_is_rejected_counted_and_logged_once(payload, reason):
    bench = Bench(config=GOTO).frames(2)
    bench.robot.publish(SCAN, *scan(1))
    bench.frames()
    for seq in range(2, 6):
        bench.robot.publish(SCAN, *scan(seq, payload))
        assert bench.answer().scan == 1
    assert bench.service.skipped == {reason: 4}
    assert sum("rejected scans" in line for line in bench.said) == 1
    bench.robot.publish(SCAN, *scan(7, struct.pack("<f", float("inf"))))
    assert bench.answer().scan == 7
