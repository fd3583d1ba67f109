"""The pipeline: deterministic, never raising, and quiet when there is no picture."""

import ast
import json
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sightline.vision_side
from sightline.protocol.channels import MAX_HEADER_BYTES
from sightline.protocol.codec import decode, encode
from sightline.protocol.messages import STILL, AnswerHeader, FrameHeader, RequestId
from sightline.protocol.text import format_twist
from sightline.vision_side.config import MissionConfig, VisionConfig
from sightline.vision_side.detect.port import DetectFrame, Detection, DetectionResult, Maker, result_of
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.missions.registry import mission_spec
from sightline.vision_side.missions.switch import MissionSwitch
from sightline.vision_side.pipeline import Frame, FrameLoss, Observation, Pipeline, PipelineAnswer, answer_header
from sightline.vision_side.tracking.track import from_odometry
from tests.fixtures.vision.vision import Rig, ball_about_lens, camera, eight, jpeg_of, scene

pytestmark = pytest.mark.computes

MODEL = camera()
BALL = jpeg_of(scene(MODEL, 1.0, 0.2, shaded=True))
EMPTY = jpeg_of(np.full((240, 320, 3), 140, np.uint8))
QUARTER = jpeg_of(np.full((120, 160, 3), 140, np.uint8))
FRAME_US = 33_333


def header(seq: int, session: str = "0000abcd", t_us: int | None = None) -> FrameHeader:
    return FrameHeader(session=session, seq=seq, t_us=seq * FRAME_US if t_us is None else t_us)


def pipeline() -> Pipeline:
    return Pipeline(VisionConfig(), MODEL, configured_detector(VisionConfig()))


def phases(pictures: list[bytes]) -> list[PipelineAnswer]:
    one = pipeline()
    return [one.step(Frame(header(seq), jpeg)) for seq, jpeg in enumerate(pictures, 1)]


def test_seen_coasted_searched_and_found() -> None:
    answers = phases([BALL] * 10 + [EMPTY] * 60 + [BALL] * 3)
    names = [answer.seen.phase for answer in answers]
    assert names[:10] == ["tracking"] * 10
    assert names[10] == "coasting"
    assert names[69] == "searching"
    assert names[70:] == ["tracking"] * 3
    turning = answers[69].twist
    assert turning is not None and 0 < turning.angular_rad_s <= 1.2  # the ball was last seen on the left
    assert answers[9].seen.distance_m is not None and answers[9].seen.target in answers[9].seen.detections


class Noting:
    """A mission that notes each view."""

    Config = MissionConfig  # any model with free options
    scales = True
    views: ClassVar[list[View]] = []

    def __init__(self, config, camera):
        pass

    def step(self, view):
        self.views.append(view)
        return Plan(STILL, "noting")


class BlindNoting(Noting):
    needs_camera = False


class NotedDetector:
    """Notes the expected place of each frame; it finds what `found` has for it."""

    def __init__(self, found: list[tuple[Detection, ...]]) -> None:
        self.expected: list[tuple[float, float] | None] = []
        self.found = found

    def detect(self, frames: list[DetectFrame], deadline_us: int) -> list[DetectionResult | None]:
        (frame,) = frames
        self.expected.append(frame.expected_px)
        return [result_of(frame, self.found[len(self.expected) - 1], Maker("noted", "", ""))]


def test_a_target_is_expected_for_half_a_second_where_it_was_last_seen() -> None:
    ball = Detection(100.0, 100.0, 140.0, 140.0, 0.9, "ball")
    found = [(ball,), (ball,), *[()] * 17]
    noted = NotedDetector(found)
    one = Pipeline(VisionConfig(), MODEL, noted)
    for seq in range(1, len(found) + 1):
        one.step(Frame(header(seq), EMPTY))
    assert noted.expected[0] is None and noted.expected[17:] == [None] * 2  # 15 frames are 0.5 s
    assert all(place == pytest.approx((120.0, 120.0), abs=1.0) for place in noted.expected[1:17])


def test_a_target_without_a_track_is_expected_where_it_was_last_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    ball = Detection(100.0, 100.0, 140.0, 140.0, 0.9, "ball")
    noted = NotedDetector([(ball,), ()])
    one = Pipeline(VisionConfig(), MODEL, noted)
    monkeypatch.setattr(MissionSwitch, "step", lambda *_: Plan(STILL, "there", target=ball))
    for seq in (1, 2):
        one.step(Frame(header(seq).model_copy(update={"pose": (0.0, 0.0, 0.1 * seq)}), EMPTY))
    assert noted.expected == [None, (120.0, 120.0)]


@pytest.mark.parametrize("frame_us", [FRAME_US, 10 * FRAME_US])
@pytest.mark.parametrize("rate_rad_s", [1.5, -1.5])
def test_a_target_is_expected_where_it_is_for_a_robot_that_turns(frame_us: int, rate_rad_s: float) -> None:
    """The ball moves too, at 0.1 m/s. The last two images do not show it."""
    noted, true_px = NotedDetector([]), list[float]()
    one = Pipeline(VisionConfig(), MODEL, noted)
    for seq in range(1, 11):
        # A turn in the last three frames only, so that the ball stays in view.
        t_s, pose = seq * frame_us / 1e6, (0.1, 0.0, rate_rad_s * max(0, seq - 8) * frame_us / 1e6)
        right, _, ahead = ball_about_lens(MODEL, *from_odometry(pose, 2.0, 0.1 * t_s))
        middle, half = MODEL.cx_px + MODEL.fx_px * right / ahead, MODEL.fx_px * 0.1 / ahead
        ball = Detection(middle - half, 120.0 - half, middle + half, 120.0 + half, 0.9, "ball")
        noted.found.append((ball,) if seq < 9 else ())
        true_px.append(middle)
        one.step(Frame(header(seq, t_us=round(t_s * 1e6)).model_copy(update={"pose": pose}), EMPTY))
    assert all(place is not None and abs(place[0] - true) < 1 for place, true in
               zip(noted.expected[5:9], true_px[5:9], strict=True))
    assert noted.expected[9] is None if frame_us > FRAME_US else abs(noted.expected[9][0] - true_px[9]) < 1


def test_a_new_session_and_another_camera_expect_no_target() -> None:
    ball = Detection(100.0, 100.0, 140.0, 140.0, 0.9, "ball")
    noted = NotedDetector([(ball,)] * 5)
    one = Pipeline(VisionConfig(), MODEL, noted)
    one.step(Frame(header(1), EMPTY))
    one.step(Frame(header(2, "1111aaaa"), EMPTY))
    one.set_camera(MODEL.model_copy(update={"fx_px": 300.0}))
    one.step(Frame(header(3, "1111aaaa"), EMPTY))
    one.step(Frame(header(4, "1111aaaa"), EMPTY))
    assert noted.expected == [None, None, None, pytest.approx((120.0, 120.0), abs=1.0)]


@pytest.mark.parametrize(("change", "is_same_lens"), [
    ({}, True),
    ({"fx_px": 95.7, "cx_px": 79.6}, True),  # rounded by the robot
    ({"fy_px": 95.7, "cy_px": 60.4}, True),
    ({"fx_px": 96.0}, False),
    ({"fx_px": 94.7}, False),
    ({"fy_px": 96.0}, False),
    ({"cx_px": 80.6}, False),
    ({"cy_px": 59.4}, False),
    ({"x_m": 0.06}, False),
    ({"pitch_rad": 0.1}, False),
    ({"distortion": (0.1,)}, False),
])
def test_target_is_expected_at_its_share_of_an_image_of_another_size_of_the_same_lens(change, is_same_lens) -> None:
    ball = Detection(100.0, 100.0, 140.0, 160.0, 0.9, "ball")
    noted = NotedDetector([(ball,), ()])
    one = Pipeline(VisionConfig(), MODEL, noted)
    one.step(Frame(header(1), EMPTY))
    one.set_camera(camera(160, 120).model_copy(update=change))
    one.step(Frame(header(2), QUARTER))
    assert noted.expected == [None, pytest.approx((60.0, 65.0), abs=0.5) if is_same_lens else None]


def test_latency_of_the_robot_is_kept_at_another_image_size_only() -> None:
    """The time of the last frame is kept too, so that the next one has a time step."""
    views = []
    other = MODEL.model_copy(update={"fx_px": 300.0})
    for name, model, jpeg in (("", camera(160, 120), QUARTER), ("", other, EMPTY), ("Blind", other, EMPTY)):
        chosen = mission_spec(f"{__name__}:{name}Noting", {"options": {}}, VisionConfig())
        one = Pipeline(VisionConfig(), MODEL, NotedDetector([()] * 41), chosen)
        for seq in range(1, 41):
            one.step(Frame(header(seq).model_copy(update={"latency_us": 200_000}), EMPTY))
        one.set_camera(model)
        one.step(Frame(header(41), jpeg))
        views.append(Noting.views[-2:])
    (before, scaled), *others = views
    assert scaled.latency_s == before.latency_s
    assert round(scaled.dt_s, 4) == 0.0333
    assert all(one.latency_s < before.latency_s and one.dt_s == 0 for _, one in others)
    assert scaled.camera == camera(160, 120)


def test_boxes_are_located_by_the_newest_camera_model() -> None:
    chosen = mission_spec(f"{__name__}:Noting", {"options": {}}, VisionConfig())
    one = Pipeline(VisionConfig(), MODEL, NotedDetector([]), chosen)
    one.set_camera(camera(160, 120))
    assert one.camera == MODEL
    one.follow(header(1), ())
    assert Noting.views[-1].camera == one.camera == camera(160, 120)


def test_robot_does_not_drive_to_where_the_target_was_before_a_gap_of_eight_seconds() -> None:
    one, far = pipeline(), jpeg_of(scene(MODEL, 1.9, 0.0, shaded=True))
    for seq in range(1, 16):
        tracked = one.step(Frame(header(seq), far))
    assert tracked.seen.phase == "tracking" and tracked.twist is not None and tracked.twist.linear_mps > 0.3
    for seq, jpeg in ((255, EMPTY), (256, EMPTY), (257, far)):
        answer = one.step(Frame(header(seq), jpeg))
        assert answer.seen.phase in ("searching", "lost" if jpeg is EMPTY else "tracking")
        assert answer.twist is not None and answer.twist.linear_mps == 0.0


def test_missing_image_is_acknowledged_and_starts_no_search() -> None:
    answers = phases([BALL] * 5 + [b"not a picture"] * 90)
    assert all(answer.twist is None and answer.seen.phase == "no image" for answer in answers[5:])


def test_an_empty_room_from_the_start_waits_then_searches() -> None:
    answers = phases([EMPTY] * 20)
    assert answers[0].twist == STILL
    assert answers[-1].seen.phase == "searching"


def test_old_and_repeated_frames_are_counted_and_not_steered_by() -> None:
    one = pipeline()
    one.step(Frame(header(5), BALL))
    for seq in (5, 4):
        answer = one.step(Frame(header(seq), BALL))
        assert answer.twist is None and answer.skipped == "OUT_OF_ORDER"


def test_a_new_robot_session_starts_from_nothing() -> None:
    one = pipeline()
    for seq in range(1, 20):
        one.step(Frame(header(seq), BALL))
    again = one.step(Frame(header(1, "0000beef"), BALL))
    assert again == pipeline().step(Frame(header(1, "0000beef"), BALL))


@settings(max_examples=40)
@given(pictures=st.lists(st.one_of(st.binary(max_size=300), st.sampled_from([BALL, EMPTY, BALL[:500]])), max_size=12),
       times=st.lists(st.integers(0, 2**53 - 1), min_size=12, max_size=12))
def test_any_bytes_and_any_times_are_answered(pictures: list[bytes], times: list[int]) -> None:
    one = pipeline()
    answers = [one.step(Frame(header(seq, t_us=t_us), jpeg))
               for seq, (jpeg, t_us) in enumerate(zip(pictures, times, strict=False))]
    for answer in answers:
        assert answer.twist is None or format_twist(answer.twist)
    assert all((answer.skipped != "") is (answer.twist is None) for answer in answers)


def test_the_same_frames_give_the_same_twists_byte_for_byte() -> None:
    frames: list[Frame] = []
    twists: list[bytes] = []

    class Recorded(Rig):
        def _set_up(self) -> None:
            super()._set_up()
            step = self.pipeline.step

            def recorded(frame: Frame) -> PipelineAnswer:
                answer = step(frame)
                frames.append(frame)
                twists.append(format_twist(answer.twist) if answer.twist else b"")
                return answer

            self.pipeline.step = recorded

    Recorded(eight(), drawn=True, seed=3).run(1.5)
    replay = pipeline()
    again = [replay.step(Frame(decode(FrameHeader, encode(one.header)), one.jpeg)).twist for one in frames]
    assert len(twists) > 30
    assert [format_twist(twist) if twist else b"" for twist in again] == twists


def test_the_answer_names_the_frame_field_for_field() -> None:
    frame = header(7)
    answer = decode(AnswerHeader, encode(answer_header(frame, "12345678", 3, 412)))
    assert (answer.source, answer.session, answer.seq, answer.compute_us) == ("vision", "12345678", 3, 412)
    assert (answer.echo.channel, answer.echo.session, answer.echo.seq, answer.echo.t_us) == (
        "frame", frame.session, frame.seq, frame.t_us)


ALWAYS_PURE = ("pipeline.py", "decode.py", "port.py", "hsv.py", "plugin_calls.py", "track.py", "steering.py",
               "follow.py")
"""From a frame to its twist: nothing there may become a shell."""


def test_only_shell_files_use_clocks_and_links() -> None:
    forbidden = {"time", "threading", "socket", "asyncio", "logging", "zenoh", "random"}
    for path in Path(sightline.vision_side.__file__).parent.rglob("*.py"):
        tree = ast.parse(path.read_text())
        names = {alias.name.split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.Import)
                 for alias in node.names}
        names |= {(node.module or "").split(".")[0] for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        is_shell = "Shell" in (ast.get_docstring(tree) or "").split("\n\n")[0]
        assert not names & forbidden or (is_shell and path.name not in ALWAYS_PURE), path.name


COUNTS = st.integers(0, 2**53 - 1)
SESSIONS = st.text("0123456789abcdef", min_size=8, max_size=8)


ANSWERS = st.none() | st.builds(
    PipelineAnswer,
    twist=st.none(),
    seen=st.just(Observation("tracking")),
    scan=st.none() | COUNTS,
    request=st.none() | st.builds(RequestId, digest=SESSIONS, id=COUNTS),
)


@given(SESSIONS, SESSIONS, st.tuples(COUNTS, COUNTS, COUNTS, COUNTS), ANSWERS)
def test_encoded_answer_header_fits_and_has_the_fields_of_frame_and_answer(robot, vision, counts, answer) -> None:
    frame = FrameHeader(session=robot, seq=counts[0], t_us=counts[1])
    encoded = encode(answer_header(frame, vision, *counts[2:], answer))
    expected = {
        "v": 1, "source": "vision", "session": vision, "seq": counts[2],
        "echo": {"channel": "frame", "session": robot, "seq": counts[0], "t_us": counts[1]}, "compute_us": counts[3],
    }  # fmt: skip
    if answer and answer.scan is not None:
        expected["scan"] = answer.scan
    if answer and answer.request is not None:
        expected["mission"] = {"digest": answer.request.digest, "id": answer.request.id}
    assert list(json.loads(encoded).items()) == list(expected.items()) and len(encoded) <= MAX_HEADER_BYTES


def loss_of(seqs: list[int], replaced: int = 0) -> FrameLoss:
    """Return the estimate after frames with these numbers, `replaced` of them before the last in all."""
    loss = FrameLoss()
    for seq in seqs[:-1]:
        loss.update(header(seq), 0)
    loss.update(header(seqs[-1]), replaced)
    return loss


@pytest.mark.parametrize(("seqs", "copies"), [
    ([7], 1), ([*range(100)], 1), ([0, 4], 1), ([0, 5], 2), ([0, 1, 1, 0, 1], 1),
    ([number * 10 for number in range(20)], 2),
])  # fmt: skip
def test_each_twist_is_sent_twice_while_more_than_a_twentieth_of_the_frames_is_lost(
    seqs: list[int], copies: int
) -> None:
    assert loss_of(seqs).copies == copies


def test_loss_is_forgotten_after_frames_without_one() -> None:
    loss = loss_of([0, 10])
    later = 0
    while loss.copies == 2:
        later += 1
        loss.update(header(10 + later), 0)
    assert later == 61


def test_frames_that_newer_ones_replaced_are_not_lost() -> None:
    assert loss_of([0, 10], replaced=9).copies == 1
    assert loss_of([0, 10], replaced=4).copies == 2, "five are lost"


def test_another_session_of_the_robot_is_not_a_loss() -> None:
    loss = loss_of([0])
    loss.update(header(1_000, session="0000abce"), 0)
    assert loss.copies == 1


def test_image_fits_by_its_size_alone() -> None:
    one = pipeline()
    assert one.fits(BALL)
    assert not one.fits(jpeg_of(scene(camera(640, 480), 1.0, 0.2)))
    assert not one.fits(b"junk")
    one.set_camera(camera(640, 480))
    assert not one.fits(BALL) and not one.fits(b"junk"), "the newest model is of another size"
    assert one.fits(jpeg_of(scene(camera(640, 480), 1.0, 0.2)))
