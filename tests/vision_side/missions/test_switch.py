"""From one mission to the next: at rest in between, whatever a mission does, and over when it is over."""

import math
from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest

from sightline.protocol.errors import ConfigError
from sightline.protocol.log import faults
from sightline.protocol.messages import STILL, FrameHeader, RequestId, Twist
from sightline.vision_side.config import MissionConfig, VisionConfig
from sightline.vision_side.detect.port import Circle, Detection, NoDetector
from sightline.vision_side.detect.registry import configured_detector
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.missions.registry import mission_spec
from sightline.vision_side.missions.switch import SETTLE_S, MissionSwitch
from sightline.vision_side.pipeline import Frame, Pipeline
from sightline.vision_side.tracking.track import Target
from tests.contracts.missions import CAMERA
from tests.fixtures.vision.vision import jpeg_of, scene

CONFIG = VisionConfig()
FRAME_US = 33_333
ASKED = RequestId(digest="0000feed", id=1)


class Scripted:
    """Reports its options and its frame."""

    Config = MissionConfig  # any model with free options

    def __init__(self, config, camera):
        self.options, self.seen = config.options, []

    def step(self, view):
        self.seen.append(view.dt_s)
        number = len(self.seen)
        if self.options.get("raises_at") == number:
            raise RuntimeError("a bug\nof its own")
        if self.options.get("nonsense_at") == number:
            return None
        speed = 1e9 if self.options.get("wild_at") == number else self.options.get("speed", 0.3)
        over = self.options.get("done_at") == number
        return Plan(Twist(linear_mps=speed, angular_rad_s=0.1), "driving", f"{number} after {view.dt_s:.2f}", over)


class Unbuildable(Scripted):
    def __init__(self, config, camera):
        raise ValueError("cannot begin")


def scripted(name="Scripted", **options):
    return mission_spec(f"{__name__}:{name}", {"options": options}, CONFIG)


def view(seq, moving=(0.0, 0.0), applied=(0.0, 0.0), dt_s=0.033):
    header = FrameHeader(session="0000abcd", seq=seq, t_us=seq * FRAME_US, moving=moving, applied=applied)
    return View(header, dt_s, 0.06, CAMERA, ())


def test_switch_waits_for_resting_wheels_and_starts_fresh():
    duty = MissionSwitch(scripted(), CAMERA)
    assert duty.step(view(1)).twist.linear_mps == 0.3
    duty.switch(scripted(speed=-0.2))
    assert duty.chosen.config.options == {"speed": -0.2}
    for seq in range(2, 8):
        plan = duty.step(view(seq, moving=(0.2, 0.0), applied=(0.1, 0.0)))
        assert (plan.twist, plan.phase) == (STILL, "switching")
    assert duty.step(view(8, moving=(0.0, 0.2))).twist == STILL, "it still turns"
    assert duty.step(view(9, applied=(0.05, 0.0))).twist == STILL, "it has a command to move"
    plan = duty.step(view(10, moving=(0.005, 0.0)))
    assert (plan.twist.linear_mps, plan.note) == (-0.2, "1 after 0.00")
    assert duty.step(view(11)).note == "2 after 0.03"


def test_switch_on_a_resting_robot_waits_one_command_delay():
    """An earlier command may still be in flight, so one image of a robot at rest is not enough."""
    duty = MissionSwitch(scripted(), CAMERA)
    duty.step(view(1))
    duty.switch(scripted(speed=0.1))
    assert [duty.step(view(seq)).twist.linear_mps for seq in range(2, 5)] == [0.0, 0.1, 0.1]


def test_switch_on_a_moving_robot_waits_at_most_a_second():
    duty = MissionSwitch(scripted(), CAMERA)
    duty.switch(scripted(speed=0.1))
    waited = [duty.step(view(seq, moving=(0.3, 0.0), dt_s=0.125)).twist.linear_mps for seq in range(1, 11)]
    frames = round(SETTLE_S / 0.125)
    assert waited == [0.0] * (frames - 1) + [0.1] * (11 - frames)


def test_finished_mission_stays_finished_and_at_rest():
    duty = MissionSwitch(scripted(done_at=2), CAMERA)
    duty.step(view(1))
    for seq in range(2, 6):
        plan = duty.step(view(seq))
        assert (plan.twist, plan.done, plan.note) == (STILL, True, "2 after 0.03")
    duty.switch(scripted())
    assert [duty.step(view(seq)).phase for seq in range(6, 9)] == ["switching", "driving", "driving"]


@pytest.mark.parametrize(("options", "words"), [
    ({"raises_at": 2}, "RuntimeError: a bug of its own"),
    ({"nonsense_at": 2}, "TypeError: step() returned NoneType, not a Plan"),
    ({"wild_at": 2}, "ValueError: returned 1e+09 m/s"),
    ({"speed": float("inf")}, "ValidationError"),
])
def test_failing_mission_ends_and_the_robot_stops(options, words):
    duty = MissionSwitch(scripted(**options), CAMERA)
    plans = [duty.step(view(seq)) for seq in range(1, 5)]
    assert [plan.twist for plan in plans[1:]] == [STILL] * 3
    assert plans[-1].done and plans[-1].phase == "failed"
    assert words in plans[-1].note and "\n" not in plans[-1].note


def test_a_mission_that_cannot_even_begin_is_over():
    duty = MissionSwitch(scripted("Unbuildable"), CAMERA)
    assert duty.step(view(1)).note == "ValueError: cannot begin"
    duty.switch(scripted())
    assert [duty.step(view(seq)).twist.linear_mps for seq in range(2, 5)][-1] == 0.3


# --- in the pipeline -------------------------------------------------------------------------------------------------


BALL = jpeg_of(scene(CAMERA, 1.0, 0.2, shaded=True))
LARGE = jpeg_of(np.full((480, 640, 3), 140, np.uint8))


def frame(seq, session="0000abcd"):
    return Frame(FrameHeader(session=session, seq=seq, t_us=seq * FRAME_US), BALL)


def test_an_answer_names_the_mission_that_was_requested_and_a_new_session_ends_it():
    pipeline = Pipeline(CONFIG, CAMERA, configured_detector(CONFIG))
    first = pipeline.step(frame(1))
    assert (first.mission, first.request) == ("follow", None)
    pipeline.switch(scripted(), ASKED, "0000abcd")
    answers = [pipeline.step(frame(seq)) for seq in range(2, 8)]
    assert {answer.request for answer in answers} == {ASKED}
    assert answers[-1].seen.phase == "driving" and pipeline.mission.plugin is Scripted
    anew = pipeline.step(frame(8, session="0000beef"))
    assert (anew.request, anew.mission, anew.seen.phase) == (None, "follow", "tracking")


def test_a_request_that_comes_twice_is_applied_once():
    pipeline = Pipeline(CONFIG, CAMERA, configured_detector(CONFIG))
    for seq in range(1, 6):
        pipeline.switch(scripted(), ASKED, "0000abcd")
        answer = pipeline.step(frame(seq))
    assert answer.seen.phase == "driving"


def test_requested_mission_continues_with_another_camera():
    pipeline = Pipeline(CONFIG, CAMERA, configured_detector(CONFIG))
    pipeline.step(frame(1))
    pipeline.set_camera(CAMERA.model_copy(update={"width_px": 640, "height_px": 480}))
    assert pipeline.mission.name == "follow"
    pipeline.set_camera(CAMERA)
    pipeline.switch(scripted(), ASKED, "0000abcd")
    for seq in range(2, 6):
        pipeline.step(frame(seq))
    pipeline.set_camera(CAMERA)
    answer = pipeline.step(frame(6))
    begun = (answer.request, answer.seen.note)
    assert begun == (ASKED, "1 after 0.00"), "it begins again: it may have learned the camera by heart"
    chosen, again = scripted(), ASKED.model_copy(update={"id": ASKED.id + 1})
    object.__setattr__(chosen, "plugin", type("Blind", (Scripted,), {"needs_camera": False}))
    pipeline.switch(chosen, again, "0000abcd")
    for seq in range(7, 12):
        before = pipeline.step(frame(seq)).seen.note
    assert int(before.split()[0]) > 2
    pipeline.set_camera(CAMERA)
    assert int(pipeline.step(frame(12)).seen.note.split()[0]) == int(before.split()[0]) + 1


@pytest.mark.parametrize(("options", "phase"), [({"done_at": 2}, "driving"), ({"raises_at": 2}, "failed")])
@pytest.mark.parametrize("requested", [False, True])
def test_mission_that_is_over_does_not_start_again_with_another_camera(options, phase, requested):
    pipeline = Pipeline(CONFIG, CAMERA, configured_detector(CONFIG), None if requested else scripted(**options))
    if requested:
        pipeline.switch(scripted(**options), ASKED, "0000abcd")
    before = [pipeline.step(frame(seq)) for seq in range(1, 7)][-1]
    pipeline.set_camera(CAMERA.model_copy(update={"width_px": 640, "height_px": 480}))
    for answer in (before, pipeline.step(Frame(frame(7).header, LARGE))):
        assert (answer.twist, answer.seen.done, answer.seen.phase) == (STILL, True, phase)


@pytest.mark.parametrize("is_scaled", [False, True])
def test_mission_that_waits_for_rest_waits_on_with_another_camera(is_scaled):
    switch = MissionSwitch(scripted(), CAMERA)
    switch.switch(scripted(speed=-0.2))
    assert not switch.set_camera(CAMERA, is_scaled=is_scaled)
    assert switch.step(view(1, moving=(0.2, 0.0))).phase == "switching"


@pytest.mark.parametrize(("scales", "is_scaled", "continues"), [
    (True, True, True), (True, False, False), (False, True, False), (False, False, False),
])
def test_mission_continues_at_another_image_size_if_it_scales(scales, is_scaled, continues):
    chosen = scripted()
    object.__setattr__(chosen, "plugin", type("Scaling", (Scripted,), {"scales": scales}))
    switch = MissionSwitch(chosen, CAMERA)
    switch.step(view(1))
    assert switch.set_camera(CAMERA, is_scaled=is_scaled) is (not continues)
    assert switch.step(view(2)).note == ("2 after 0.03" if continues else "1 after 0.03")


def test_pipeline_with_an_unknown_mission_is_rejected():
    with pytest.raises(ConfigError, match="did you mean 'goto'"):
        Pipeline(VisionConfig(mission=MissionConfig(kind="gotto")), CAMERA, NoDetector())


# --- the bounds, with numbers ------------------------------------------------------------------------------------


def looked(dt_s=0.0, moving=(0.0, 0.0), applied=(0.0, 0.0), latency_s=0.0):
    header = FrameHeader(session="0000abcd", seq=1, t_us=1, moving=moving, applied=applied)
    return View(header, dt_s, latency_s, CAMERA, ())


def begins(*frames):
    """Return the number of the frame, from 1 on, at which a mission that was switched to begins; None if it waits."""
    switch = MissionSwitch(scripted(), CAMERA)
    switch.step(looked())
    switch.switch(scripted(speed=0.1))
    phases = [switch.step(one).phase for one in frames]
    return phases.index("driving") + 1 if "driving" in phases else None


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("linear_mps", "angular_rad_s", "rests"), [
    (0.00999, 0.02999, True), (0.01, 0.0, False), (0.0, 0.03, False), (0.5, 0.0, False), (0.0, 0.5, False),
])  # fmt: skip
def test_robot_rests_below_a_centimeter_a_second_and_30_mrad_a_second(linear_mps, angular_rad_s, rests, sign):
    speeds = sign * linear_mps, sign * angular_rad_s
    assert begins(looked(moving=speeds)) == (1 if rests else None)
    assert begins(looked(applied=speeds)) == (1 if rests else None)


@pytest.mark.parametrize(("dt_s", "begin"), [(0.0625, 1), (0.0615, None)])
def test_resting_robot_is_waited_for_as_long_as_a_command_takes(dt_s, begin):
    assert begins(looked(dt_s, latency_s=0.0625)) == begin


def test_moving_robot_is_waited_for_a_second():
    assert begins(*[looked(0.25, moving=(0.5, 0.0))] * 4) == 4
    assert begins(*[looked(0.25, moving=(0.5, 0.0))] * 3, looked(0.245, moving=(0.5, 0.0))) is None
    assert SETTLE_S == 1.0


@pytest.mark.parametrize(("linear_mps", "angular_rad_s", "phase"), [
    (1000.0, 1000.0, "driving"), (-1000.0, -1000.0, "driving"), (1000.1, 0.0, "failed"), (-1000.1, 0.0, "failed"),
    (0.0, 1000.1, "failed"), (0.0, -1000.1, "failed"),
])  # fmt: skip
def test_command_beyond_a_thousand_ends_the_mission(linear_mps, angular_rad_s, phase):
    switch = MissionSwitch(scripted(), CAMERA)
    twist = Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)
    switch._mission.step = lambda _view: Plan(twist, "driving")
    plan = switch.step(looked())
    assert (plan.phase, plan.twist) == (phase, twist if phase == "driving" else STILL)
    assert switch.step(looked()).phase == phase


@pytest.mark.parametrize("twist", [{"linear_mps": math.nan}, {"angular_rad_s": math.nan}, {"linear_mps": "1"}])
def test_twist_that_was_not_validated_ends_the_mission(twist):
    switch = MissionSwitch(scripted(), CAMERA)
    twist = Twist.model_construct(**{"linear_mps": 0.0, "angular_rad_s": 0.0, **twist})
    switch._mission.step = lambda _view: Plan(twist, "driving")
    plan = switch.step(looked())
    assert (plan.phase, plan.twist, plan.done) == ("failed", STILL, True)


BOX = Detection(10.0, 20.0, 30.0, 40.0, 0.9, "ball")


@pytest.mark.parametrize(("field", "value"), [
    ("x1_px", "a"), ("x1_px", math.nan), ("x1_px", 31.0), ("y2_px", 1e300), ("score", None), ("score", 7.0),
    ("x1_px", -1e7), ("x2_px", 1_000_001.0), ("score", -0.1), ("score", 1.1), ("label", None),
    ("label", "x" * 65), ("y1_px", 41), ("circle", (1, 2, 3)), ("circle", Circle(1.0, 2.0, -3.0)),
])  # fmt: skip
def test_target_that_the_wire_cannot_carry_ends_the_mission(field, value):
    switch = MissionSwitch(scripted(), CAMERA)
    switch._mission.step = lambda _view: Plan(STILL, "tracking", target=replace(BOX, **{field: value}))
    plan = switch.step(looked())
    assert (plan.phase, plan.target) == ("failed", None)


@pytest.mark.parametrize("changes", [
    {"x1_px": 30.0}, {"y1_px": 40.0}, {"x1_px": -1e6, "y2_px": 1e6}, {"score": 0.0}, {"score": 1.0},
])  # fmt: skip
def test_target_at_a_limit_is_passed_on(changes):
    switch, one = MissionSwitch(scripted(), CAMERA), replace(BOX, **changes)
    switch._mission.step = lambda _view: Plan(STILL, "tracking", target=one)
    assert switch.step(looked()).target is one


@pytest.mark.parametrize("x_m", ["1", math.nan])
def test_track_without_a_place_ends_the_mission(x_m):
    switch = MissionSwitch(scripted(), CAMERA)
    switch._mission.step = lambda _view: Plan(STILL, "tracking", track=Target(x_m, 0.0, 0.0, 0.0, 0, 1))
    assert switch.step(looked()).phase == "failed"


@pytest.mark.parametrize("kind", [Fraction, np.float32])
def test_plan_may_contain_any_text_and_any_real_number(kind):
    plan = Plan(STILL, "ph\ud800ase", "n\udcff\n o\x1b", bearing_rad=kind(0.25), distance_m=kind(0.5),
                target=replace(BOX, x1_px=kind(10), score=kind(0.5)))
    switch = MissionSwitch(scripted(), CAMERA)
    switch._mission.step = lambda _view: plan
    shown = switch.step(looked())
    assert (shown.phase, shown.note) == ("ph?ase", "n? o?")
    assert (shown.bearing_rad, shown.distance_m, shown.target) == (0.25, 0.5, replace(BOX, score=0.5))
    assert shown.target is not None
    assert all(type(one) is float for one in (shown.bearing_rad, shown.distance_m, shown.target.x1_px))


def test_target_among_the_detections_stays_the_same_object():
    switch = MissionSwitch(scripted(), CAMERA)
    switch._mission.step = lambda _view: Plan(STILL, "tracking", target=BOX)
    assert switch.step(looked()).target is BOX


@pytest.mark.parametrize(("field", "value"), [
    ("twist", SimpleNamespace(linear_mps=0.1, angular_rad_s=0.0)), ("phase", None), ("note", None), ("note", b"along"),
    ("target", "ball"), ("target", (1.0, 2.0)), ("done", np.array([True, False])),
    ("bearing_rad", "left"), ("distance_m", "1 m"), ("distance_m", np.zeros(2)),
])  # fmt: skip
def test_plan_with_a_field_of_another_type_ends_the_mission(field, value):
    switch = MissionSwitch(scripted(), CAMERA)
    switch._mission.step = lambda _view: replace(Plan(STILL, "driving"), **{field: value})
    plan = switch.step(looked())
    assert (plan.phase, plan.done) == ("failed", True)
    assert switch.step(looked()) is plan


def test_mission_may_return_values_of_numpy():
    switch = MissionSwitch(scripted(), CAMERA)
    for done in (False, True):
        plan = Plan(STILL, "driving", done=np.bool_(done), bearing_rad=np.float32(0.5), distance_m=np.float64(1.0))
        switch._mission.step = lambda _view, plan=plan: plan
        assert switch.step(looked()) == plan and switch.step(looked()).done is done


def test_note_of_a_failed_mission_has_at_most_200_characters():
    switch = MissionSwitch(scripted(), CAMERA)

    def fail(_view):
        raise RuntimeError("x" * 300)

    switch._mission.step = fail
    assert switch.step(looked()).note == "RuntimeError: " + "x" * 186
    assert faults() == {"mission": 1}
