"""The service over a link in memory: every frame answered, bad ones counted, one line per change of state."""

import signal
import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import pytest
from pydantic import BaseModel

from sightline.protocol.channels import ACK, CAMERA, FRAME, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import AnswerHeader, CameraModel, FrameHeader, Stamp, Twist
from sightline.protocol.proof import session_digest
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import LatestSlot, Message
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.vision_side.config import DetectorConfig, MissionConfig, VisionConfig
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.serving import service as service_module
from sightline.vision_side.serving.process import serve
from sightline.vision_side.serving.service import PhaseLimiter, Service, SkipCounter
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.vision import YELLOW_BGR, camera, jpeg_of, scene

MODEL = camera()
BALL = jpeg_of(scene(MODEL, 1.0, 0.2))
EMPTY = jpeg_of(np.full((240, 320, 3), 140, np.uint8))
SHOWN, OTHER = (session_digest("robot", session) for session in ("0000abcd", "0000beef"))
COLOR = VisionConfig(detector=DetectorConfig(kind="hsv"))


class Bench:
    """A robot's end of the link, and the service on the other."""

    def __init__(self, *, is_standby: bool = False, config: VisionConfig = COLOR) -> None:
        self.network = MemoryNetwork(seed=1)
        self.robot = self.network.link("r1")
        self.twists: LatestSlot[Message] = self.robot.latest(TWIST)
        self.acks: LatestSlot[Message] = self.robot.latest(ACK)
        self.said: list[str] = []
        link = self.network.link("r1", role="vision")
        self.service = Service(config, link, self.said.append, is_standby=is_standby)
        self.now_us = 0

    def camera(self, model: CameraModel = MODEL) -> None:
        self.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=1, t_us=self.now_us)), encode(model))
        self.turn()

    def frame(self, jpeg: bytes, seq: int, session: str = "0000abcd") -> None:
        header = FrameHeader(session=session, seq=seq, t_us=seq * 33_333)
        self.raw(encode(header), jpeg)

    def raw(self, header: bytes, jpeg: bytes) -> None:
        self.robot.publish(FRAME, header, jpeg)
        self.turn()

    def turn(self) -> None:
        self.now_us += 33_333
        self.network.advance(self.now_us)
        self.service.turn(0.0)
        self.network.advance(self.now_us)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_frame_is_answered_by_a_twist_that_names_it(bench: Bench) -> None:
    bench.camera()
    for seq in range(1, 6):
        bench.frame(BALL, seq)
        message = bench.twists.take()
        assert message is not None and message.source == "vision"
        header = decode(AnswerHeader, message.header)
        assert (header.echo.session, header.echo.seq, header.echo.t_us) == ("0000abcd", seq, seq * 33_333)
        assert (header.seq, header.compute_us > 0) == (seq, True)
        assert parse_twist(message.payload).angular_rad_s > 0


def test_a_standby_that_listens_answers_nothing_until_it_begins_and_then_the_newest_frame_first() -> None:
    bench = Bench(is_standby=True)
    bench.camera()
    bench.frame(BALL, 1)
    bench.service.listen()
    bench.service.listen()
    for seq in (2, 3):
        bench.frame(BALL, seq)
    assert bench.twists.take() is bench.acks.take() is None
    bench.service.begin()
    answered = []
    for seq in (4, 5):
        bench.turn()
        answered.append(bench.twists.take())
        bench.frame(BALL, seq)
        answered.append(bench.twists.take())
    assert [message and decode(AnswerHeader, message.header).echo.seq for message in answered] == [3, 4, None, 5]
    bench.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=6, t_us=6 * 33_333)), BALL)
    bench.network.advance(bench.now_us + 1)
    bench.service.rest()
    bench.service.rest()
    bench.frame(BALL, 7)
    bench.service.listen()
    bench.frame(BALL, 8)
    bench.service.rest()
    bench.service.begin()
    bench.turn()
    assert bench.twists.take() is None, "frames of before are not answered"
    bench.frame(BALL, 9)
    assert bench.twists.take() is not None


def test_on_a_lossy_link_a_twist_is_sent_twice_with_a_new_number_and_a_new_proof(bench: Bench) -> None:
    bench.camera()
    twists: list[Message] = []
    bench.robot.subscribe(TWIST, twists.append)
    for seq in (1, 2, 12):
        bench.frame(BALL, seq)
    headers = [decode(AnswerHeader, one.header) for one in twists]
    assert [one.echo.seq for one in headers] == [1, 2, 12, 12]
    assert [one.seq for one in headers] == [1, 2, 3, 4]
    assert len({one.proof for one in headers}) == 4
    assert twists[2].payload == twists[3].payload
    assert bench.service.answered == bench.service.steered == 3


def test_on_a_lossy_link_an_acknowledgement_is_sent_once(bench: Bench) -> None:
    bench.camera()
    acks: list[Message] = []
    bench.robot.subscribe(ACK, acks.append)
    for seq in (1, 12):
        bench.frame(b"junk", seq)
    assert [decode(AnswerHeader, one.header).seq for one in acks] == [1, 2]


def test_frames_that_waited_in_vain_are_not_lost_by_the_link(bench: Bench) -> None:
    """A slow detector takes the newest frame only."""
    bench.camera()
    twists: list[Message] = []
    bench.robot.subscribe(TWIST, twists.append)
    bench.frame(BALL, 1)
    for seq in range(2, 12):
        bench.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333)), BALL)
    bench.frame(BALL, 12)
    assert len(twists) == 2


def test_an_image_that_does_not_decode_is_acknowledged_and_counted(bench: Bench) -> None:
    bench.camera()
    bench.frame(b"junk", 1)
    message = bench.acks.take()
    assert message is not None and message.payload == b"" and bench.twists.take() is None
    assert decode(AnswerHeader, message.header).echo.seq == 1
    assert bench.service.skipped == {"MALFORMED": 1}


def test_before_the_camera_model_frames_are_only_acknowledged(bench: Bench) -> None:
    bench.frame(BALL, 1)
    assert bench.twists.take() is None
    assert decode(AnswerHeader, bench.acks.take().header).echo.seq == 1


@pytest.mark.parametrize("header", [b"", b"{", b"{}", b"[1]", b'{"v":1,"session":"x","seq":1,"t_us":1}', b"\xff" * 40])
def test_broken_headers_are_counted_and_end_nothing(bench: Bench, header: bytes) -> None:
    bench.camera()
    bench.raw(header, BALL)
    assert bench.service.skipped["MALFORMED"] == 1
    bench.frame(BALL, 2)
    assert bench.twists.take() is not None


def test_robot_of_another_version_is_logged_once(bench: Bench) -> None:
    bench.camera()
    for _ in range(5):
        bench.raw(b'{"v":2,"session":"0000abcd","seq":1,"t_us":1}', BALL)
    assert len([line for line in bench.said if "version 2" in line]) == 1
    assert bench.service.skipped["UNSUPPORTED_VERSION"] == 5


def test_another_camera_is_taken_over(bench: Bench) -> None:
    bench.camera()
    bench.frame(BALL, 1)
    large = camera(640, 480)
    bench.camera(large)
    bench.frame(jpeg_of(scene(large, 1.0, 0.2)), 2)
    bench.twists.take()
    bench.frame(jpeg_of(scene(large, 1.0, 0.2)), 3)
    assert bench.twists.take() is not None
    assert any("640x480" in line for line in bench.said)


@pytest.mark.parametrize("size_px", [(640, 480), (160, 120)])
def test_first_image_of_another_size_is_answered_by_a_twist(bench: Bench, size_px: tuple[int, int]) -> None:
    """Its camera model was published before it, and both wait in the slots of the vision service."""
    bench.camera()
    bench.frame(BALL, 1)
    bench.twists.take()
    other = camera(*size_px)
    bench.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=2, t_us=bench.now_us)), encode(other))
    bench.frame(jpeg_of(scene(other, 1.0, 0.2)), 2)
    message = bench.twists.take()
    assert message is not None and decode(AnswerHeader, message.header).echo.seq == 2
    assert not bench.service.skipped


def publish_model(bench: Bench, model: CameraModel) -> None:
    bench.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=2, t_us=bench.now_us)), encode(model))


def test_image_of_the_old_size_that_waits_behind_a_computation_is_answered_by_a_twist(bench: Bench) -> None:
    """The model of the new size arrives before it is looked at. Only the first image of that size needs the model."""
    bench.camera()
    bench.frame(BALL, 1)
    bench.twists.take()
    large = camera(640, 480)
    publish_model(bench, large)
    bench.frame(BALL, 2)
    bench.frame(BALL, 3)
    bench.frame(b"junk", 4)
    answered = []
    for seq, jpeg in ((5, BALL), (6, jpeg_of(scene(large, 1.0, 0.2)))):
        bench.frame(jpeg, seq)
        message = bench.twists.take()
        answered.append(message and decode(AnswerHeader, message.header).echo.seq)
    assert answered == [5, 6]
    assert bench.service.skipped == {"MALFORMED": 1}, "the image that does not decode"


def balls(model: CameraModel, *places: tuple[int, int, int]) -> bytes:
    """Draw balls at x, y with a radius, in px of an image 320 px wide."""
    picture, share = np.full((model.height_px, model.width_px, 3), 140, np.uint8), model.width_px / 320
    for x, y, radius in places:
        cv2.circle(picture, (round(x * share), round(y * share)), round(radius * share), YELLOW_BGR, -1, cv2.LINE_AA)
    return jpeg_of(picture)


def twist_of(bench: Bench, jpeg: bytes, seq: int) -> Twist:
    bench.frame(jpeg, seq)
    message = bench.twists.take()
    assert message is not None
    return parse_twist(message.payload)


@pytest.mark.parametrize("size_px", [(640, 480), (160, 120)])
def test_robot_drives_on_at_the_first_image_of_another_size(bench: Bench, size_px: tuple[int, int]) -> None:
    bench.camera()
    far, other = jpeg_of(scene(MODEL, 2.0, 0.3)), camera(*size_px)
    before = [twist_of(bench, far, seq) for seq in range(1, 8)][-1]
    publish_model(bench, other)
    after = [twist_of(bench, jpeg_of(scene(other, 2.0, 0.3)), seq) for seq in range(8, 48)]
    assert {one.linear_mps for one in (before, *after)} == {0.5}
    assert [one.angular_rad_s for one in after] == pytest.approx([before.angular_rad_s] * len(after), abs=0.03)


@pytest.mark.parametrize(("focal_px", "turns_to"), [(95.3, -1), (120.0, 1)])
def test_robot_follows_the_same_ball_at_another_image_size_and_the_nearest_with_another_lens(
    bench: Bench, focal_px: float, turns_to: int
) -> None:
    bench.camera()
    small, large = (230, 130, 10), (60, 130, 26)
    for seq in range(1, 8):
        twist_of(bench, balls(MODEL, small), seq)
    assert twist_of(bench, balls(MODEL, small, large), 8).angular_rad_s < -1
    half = camera(160, 120).model_copy(update={"fx_px": focal_px})
    publish_model(bench, half)
    for seq in range(9, 13):
        turning = twist_of(bench, balls(half, small, large), seq).angular_rad_s
    assert turning * turns_to > 1


def test_lines_are_logged_per_change_and_never_per_frame(bench: Bench) -> None:
    bench.camera()
    for seq in range(1, 50):
        bench.frame(BALL, seq)
    for seq in range(50, 130):
        bench.frame(EMPTY, seq)
    for seq in range(130, 230):
        bench.frame(b"junk", seq)
    assert [line.split(": ", 1)[1].split(" at ")[0] for line in bench.said] == [
        "camera is 320x240, fx 190.7 px, calibrated", f"frames from robot r1, session {SHOWN}", "target seen",
        "target lost", "no target, searching",
        *(f"skipped images: {count}; newest: image: not a JPEG, no SOI marker"
          for count in (1, 10, 100)),
    ]


class Restless:
    """A mission whose phase changes after `each` frames, and whose note changes with each frame."""

    class Config(BaseModel):
        each: int = 1
        phases: tuple[str, ...] = ("red", "green")

    def __init__(self, config: Config, _camera: CameraModel) -> None:
        self._config, self._frames = config, 0

    def step(self, _view: View) -> Plan:
        self._frames += 1
        phase = self._config.phases[self._frames // self._config.each % len(self._config.phases)]
        return Plan(Twist(linear_mps=0, angular_rad_s=0), phase, f"frame {self._frames}")


@pytest.mark.parametrize(("each", "phases", "least", "most"), [
    (1, ("red", "green"), 2, 5), (3, ("red", "green"), 2, 5), (1, tuple(map(str, range(200))), 2, 5),
    (29, ("red", "green"), 3, 5), (45, ("red", "green"), 5, 5), (45, ("lost", "searching"), 5, 5),
])  # fmt: skip
def test_phase_that_changes_with_each_frame_is_limited_and_one_that_lasts_is_logged(each, phases, least, most) -> None:
    mission = MissionConfig(kind=f"{__name__}:Restless", options={"each": each, "phases": phases})
    bench = Bench(config=VisionConfig(detector=DetectorConfig(kind="hsv"), mission=mission))
    bench.service._now_us = lambda: bench.now_us
    small = camera(32, 24)
    bench.camera(small)
    jpeg = jpeg_of(np.full((24, 32, 3), 140, np.uint8))
    for seq in range(1, 200):
        bench.frame(jpeg, seq)
    lines = [line for line in bench.said if not line.startswith(("vision: camera", "vision: frames"))]
    assert least <= len(lines) <= most, lines


@pytest.mark.parametrize("rest", [30, 31, 300])
def test_phase_after_many_quick_changes_is_logged_when_it_has_lasted(rest: int) -> None:
    limiter, now_us = PhaseLimiter(), 0
    for number in range(100_000):
        now_us += 33_333
        limiter.is_due(str(number % 2), now_us)
    logged = [limiter.is_due("last", now_us + at * 33_333) for at in range(rest)]
    assert not any(logged[:29]) and all(logged[29:])
    assert limiter.is_due("next", now_us + rest * 33_333)


def test_phases_that_change_with_each_frame_for_an_hour_are_logged_once_a_minute() -> None:
    limiter = PhaseLimiter()
    logged = [at for at in range(108_000) if limiter.is_due(str(at), at * 33_333)]
    assert logged[0] == 0 and 55 <= len(logged) <= 70


def skip_lines(bench: Bench) -> list[str]:
    return [line.split(": ", 1)[1] for line in bench.said if "skipped images" in line]


def test_outage_after_good_images_is_logged_and_its_end_too(bench: Bench) -> None:
    bench.camera()
    for seq in range(1, 12):
        bench.frame(b"junk", seq)
    bench.raw(b"{", BALL)  # not an image
    for seq in range(12, 62):
        bench.frame(BALL, seq)
    before = skip_lines(bench)
    assert [line.split(";")[0] for line in before] == ["skipped images: 1", "skipped images: 10"]
    for _ in range(3):
        bench.frame(BALL, 61)
    assert skip_lines(bench)[2:] == ["skipped images: 12; newest: frame is not newer than the last"]
    assert "skipped images" in bench.said[-1]
    bench.frame(BALL, 62)
    assert "target seen at" in bench.said[-1]


@pytest.mark.parametrize(("used", "logged"), [(0, [1, 2, 10]), (29, [1, 2, 10]), (30, list(range(1, 13)))])
def test_reason_is_logged_again_after_thirty_frames_that_were_used(used, logged):
    counter, counts = SkipCounter(), []
    for number in range(12):
        is_logged = counter.skip("MALFORMED" if number % 2 else "NO_ANSWER", number * 10_000_000)
        counts += [counter.count] if is_logged else []
        for _ in range(used):
            counter.use()
    assert counts == logged


def test_reason_that_comes_and_goes_every_second_is_logged_ever_less_often():
    counter, logged_s = SkipCounter(), []
    for number in range(1, 2771):  # an hour
        if counter.skip("MALFORMED", number * 1_300_000):
            logged_s.append(number * 1.3)
        for _ in range(30):
            counter.use()
    assert 60 <= len(logged_s) <= 70
    assert any(counter.skip("MALFORMED", 3_601_000_000 + tick * 33_333) for tick in range(1810)), "an outage, in 60 s"


def test_images_that_are_skipped_now_and_then_are_not_logged_each_time(bench):
    bench.camera()
    for seq in range(1, 23):
        bench.frame(EMPTY if seq % 2 else b"junk", seq)
    assert [line.split(";")[0] for line in skip_lines(bench)] == ["skipped images: 1", "skipped images: 10"]


@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_process_ends_within_a_second_of_a_signal(number: signal.Signals) -> None:
    endpoint = free_endpoint()
    code = (
        "from sightline.protocol.log import start_log; from sightline.vision_side.config import VisionConfig; "
        "from sightline.vision_side.serving.process import run; start_log(None, 'vision'); "
        f"raise SystemExit(run(VisionConfig(connect=(), listen=('{endpoint}',))))"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "looking for robot r1" in process.stdout.readline()
        started = time.monotonic()
        process.send_signal(number)
        assert process.wait(5) == 0
        assert time.monotonic() - started < 1.0


def test_serve_ends_on_request(bench: Bench) -> None:
    ending, said = threading.Event(), list[str]()
    link = bench.network.link("r1", role="vision")
    running = threading.Thread(target=serve, args=(VisionConfig(), link, ending, said.append), daemon=True)
    running.start()
    ending.set()
    running.join(1.0)
    assert not running.is_alive()
    assert said[-1].startswith("vision: ended after 0 frames")


def test_frames_after_a_silence_are_reported_again(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.camera()
    bench.frame(BALL, 1)
    monkeypatch.setattr("sightline.vision_side.serving.service._SILENCE_S", -1.0)
    bench.turn()
    bench.frame(BALL, 2)
    bench.frame(BALL, 3)
    assert len([line for line in bench.said if "no frames from robot r1" in line]) == 1
    assert len([line for line in bench.said if f"frames from robot r1, session {SHOWN}" in line]) == 2


def test_silence_is_not_that_of_the_robot_while_this_service_stood_still(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.camera()
    bench.frame(BALL, 1)
    begin_s = time.monotonic()

    def silent_after(after_s: float) -> bool:
        monkeypatch.setattr(time, "monotonic", lambda: begin_s + after_s)
        bench.turn()
        return any("no frames from robot r1" in line for line in bench.said)

    assert not any(silent_after(tenths / 10) for tenths in range(5))
    assert not any(silent_after(6.0 + tenths / 10) for tenths in range(30)), "it hung for 5.6 s"
    assert silent_after(9.1)


def test_sessions_and_cameras_that_change_with_each_message_write_few_lines(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_module, "monotonic_us", lambda: bench.now_us)
    bench.camera()
    for seq in range(1, 301):  # 10 s
        bench.frame(BALL, 10 * seq, session=f"{seq:08x}")
        bench.camera(MODEL.model_copy(update={"fx_px": 200.0 + seq}))
        bench.now_us += 1
    for word in ("frames from robot r1, session", "camera is 320x240"):
        lines = [line for line in bench.said if word in line]
        assert 3 <= len(lines) <= 6 and lines[-1].endswith(" changes)"), lines
        shown = sum(int(line.rpartition("(")[2].split()[0]) if "changes)" in line else 1 for line in lines)
        assert 150 <= shown <= 301, "each change counts"


def test_skipped_frames_are_counted_over_all_cameras(bench: Bench) -> None:
    bench.camera()
    for seq in range(1, 4):
        bench.frame(b"junk", seq)
    large = camera(640, 480)
    bench.camera(large)
    bench.frame(jpeg_of(scene(large, 1.0, 0.2)), 4)
    bench.frame(b"junk", 5)
    bench.frame(BALL, 6)  # the last camera's size
    assert bench.service.skipped == {"MALFORMED": 5}


def test_frames_of_an_ended_session_are_skipped_and_logged_once(bench):
    """A late frame of before a restart, or two robots of one id: it steers for the newer one alone."""
    bench.camera()
    for seq in range(1, 4):
        bench.frame(BALL, seq)
    bench.frame(BALL, 1, session="0000beef")
    answered = bench.service.answered
    for seq in range(4, 8):
        bench.frame(BALL, seq)
    assert bench.service.answered == answered == 4
    assert bench.service.skipped["OTHER_SESSION"] == 4
    refused = f"rejecting frames of session {SHOWN}: robot r1 is steered in session {OTHER}"
    assert sum(refused in line for line in bench.said) == 1
    bench.frame(BALL, 2, session="0000beef")
    assert bench.service.answered == 5


def test_peer_with_a_new_session_for_each_frame_is_logged_once(bench, monkeypatch):
    monkeypatch.setattr("sightline.vision_side.serving.service.monotonic_us", lambda: bench.now_us)
    bench.camera()
    for seq in range(1, 60):
        bench.frame(BALL, seq)
        bench.frame(BALL, 1, session=f"{seq:08x}")
    refused = [line for line in bench.said if "rejecting frames" in line]
    assert len(refused) == 2, refused  # first the robot, for a moment, then the peer
    assert f"is steered in session {SHOWN}" in refused[-1]


@pytest.mark.parametrize("t_us", [600_000, 3_600_000_000, 2**53 - 1])
def test_forged_frame_of_the_future_costs_no_answer(bench, monkeypatch, t_us):
    monkeypatch.setattr("sightline.vision_side.serving.service.monotonic_us", lambda: bench.now_us)
    bench.camera()
    bench.frame(BALL, 1)
    bench.raw(encode(FrameHeader(session="0000abcd", seq=2, t_us=bench.now_us + t_us if t_us < 2**52 else t_us)), BALL)
    assert bench.service.skipped["FROM_FUTURE"] == 1
    for seq in range(3, 9):
        bench.twists.take()
        bench.frame(BALL, seq)
        assert bench.twists.take() is not None
    assert sum("whose time disagrees" in line for line in bench.said) == 1


def test_forged_first_frame_of_the_future_costs_less_than_a_second(bench, monkeypatch):
    monkeypatch.setattr("sightline.vision_side.serving.service.monotonic_us", lambda: bench.now_us)
    bench.camera()
    bench.raw(encode(FrameHeader(session="0000abcd", seq=2**53 - 1, t_us=2**53 - 1)), BALL)
    bench.twists.take()
    for seq in range(2, 20):
        bench.frame(BALL, seq)
    assert bench.service.skipped["FROM_FUTURE"] < 15 and bench.twists.take() is not None


def test_second_robot_with_one_id_is_rejected_and_logged(bench, monkeypatch):
    """Only the vision service can detect two robots that cannot reach each other."""
    monkeypatch.setattr("sightline.vision_side.serving.service.monotonic_us", lambda: bench.now_us)
    bench.camera()
    answers = {"0000abcd": 0, "0000beef": 0}
    for seq in range(1, 10):
        bench.frame(BALL, seq)
    for seq in range(10, 100):
        for session in answers:
            before = bench.service.answered
            bench.frame(BALL, seq, session=session)
            answers[session] += bench.service.answered - before
    assert answers["0000abcd"] > 75 and answers["0000beef"] < 12
    refused = [line for line in bench.said if "rejecting frames" in line]
    assert len(refused) == 2, refused  # first the old one, for a moment, then the second robot
    assert f"rejecting frames of session {OTHER}: robot r1 is steered in session {SHOWN}" in refused[-1]


def test_wait_of_frames_and_time_of_answers_are_counted(monkeypatch):
    bench, clock, began_ns = Bench(), [1_000_000], time.perf_counter_ns()
    monkeypatch.setattr(service_module, "monotonic_us", lambda: clock[0])
    bench.camera()
    assert bench.service.counts().queue_p95_us is None and bench.service.counts().busy_us == 0
    for seq in range(1, 21):
        bench.robot.publish(FRAME, encode(FrameHeader(session="0000abcd", seq=seq, t_us=seq * 33_333)), BALL)
        bench.now_us += 33_333
        bench.network.advance(bench.now_us)
        clock[0] += 40_000 if seq == 20 else 5_000
        bench.service.turn(0.0)
        clock[0] += 28_333
    counts = bench.service.counts()
    assert counts.queue_p95_us == 40_000
    assert 0 < counts.busy_us <= (time.perf_counter_ns() - began_ns) / 1000
    assert counts.thread == threading.get_ident()
    bench.robot.publish(CAMERA, encode(Stamp(session="0000abcd", seq=2, t_us=0)), encode(MODEL))
    bench.turn()
    assert bench.service.counts() == counts, "without a frame"


def test_service_of_one_robot_that_connects_is_open_with_a_session():
    for connect, is_open in ((("tcp/127.0.0.1:1",), [True, False]), ((), [True, True])):
        network, states, ending = MemoryNetwork(seed=1), [], threading.Event()
        link = network.link("r1", role="vision")
        ending.set()
        serve(COLOR.model_copy(update={"connect": connect}), link, ending, lambda _line: None, states.append)
        network.link("r1")
        found = [states[0].is_open()]
        link.close()
        assert [*found, states[0].is_open()] == is_open


_LOCKED = "mutex = (ctypes.c_char * 64)(); [ctypes.CDLL(None).pthread_mutex_lock(mutex) for _ in range(2)]"
"""Native code that never returns, and lets no handler of a signal run."""


@pytest.mark.parametrize(("work", "hangs"), [("time.sleep(30)", True), (_LOCKED, True), ("ending.wait(30)", False)])
def test_service_whose_detector_or_mission_hangs_is_ended_after_its_time(work, hangs):
    code = (
        "import ctypes, sys, threading, time\n"
        "from sightline.protocol.log import start_log\n"
        "from sightline.vision_side.serving import process\n"
        "start_log(None, 'vision')\n"
        "process.ENDS_WITHIN_S, ending = 0.2, threading.Event()\n"
        "with process.ends_on_signal(ending):\n"
        "    print('on', flush=True)\n"
        f"    {work}\n"
        "time.sleep(0.4)\n"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert started.stdout.readline() == "on\n"
    for number in [signal.SIGTERM, *[signal.SIGINT] * hangs]:  # Ctrl-C in a terminal and the end of `demo` send two
        started.send_signal(number)
        time.sleep(0.05)
    _, told = started.communicate(timeout=20)
    assert "Exception ignored" not in told
    assert (started.returncode, "does not return; ended by force" in told) == ((143, True) if hangs else (0, False))


@pytest.mark.parametrize(("detector", "line"), [
    ("close = lambda _self: time.sleep(30)", "a detector, a mission or the link does not return"),
    ("thread = threading.Thread(target=time.sleep, args=(30,)).start()", "a thread of a detector or mission"),
    ("thread = threading.Thread(target=time.sleep, args=(1,), daemon=True).start()", ""),
])  # fmt: skip
def test_service_ends_in_time_whatever_its_detector_leaves_behind(detector, line):
    code = (
        "import sys, threading, time\n"
        "from sightline.protocol.log import start_log\n"
        "from sightline.vision_side.config import VisionConfig\n"
        "from sightline.vision_side.serving import process\n"
        f"class Plain:\n    {detector}\n"
        "start_log(None, 'vision')\n"
        "process.ENDS_WITHIN_S, process._THREADS_END_S = 0.8, 0.1\n"
        "process.configured_detector = lambda _config: Plain()\n"
        f"config = VisionConfig(connect=(), listen=({free_endpoint('ws://')!r},))\n"
        "sys.exit(process.run(config, lambda _state: print('READY\\n', end='', flush=True)))\n"
    )
    started = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    for line_of_log in started.stdout:
        if line_of_log.endswith("READY\n"):  # the log may write at the same moment
            break
    started.send_signal(signal.SIGTERM)
    _, printed = started.communicate(timeout=20)
    assert (started.returncode, line in printed) == (143 if line else 0, True)
    assert ("ended by force" in printed) == bool(line)
