"""The mission `follow`, frame by frame: which detection it means, where it is, and what the wheels get."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sightline.protocol.messages import STILL, CameraModel, FrameHeader, Twist
from sightline.vision_side.config import BoxesConfig, LatencyConfig, SearchConfig, TargetConfig, TrackConfig
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions import follow as module
from sightline.vision_side.missions.follow import Follow, aim_at
from sightline.vision_side.missions.legs import Legs
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.tracking.locate import Sighting
from sightline.vision_side.tracking.prediction import PredictedMotion
from sightline.vision_side.tracking.steering import Aim
from sightline.vision_side.tracking.track import Target

CAMERA = CameraModel(
    width_px=320, height_px=240, fx_px=200.0, fy_px=200.0, cx_px=160.0, cy_px=120.0, x_m=0.1, y_m=-0.05
)
DT_S = 0.1
COMMANDED = Twist(linear_mps=0.2, angular_rad_s=0.3)
PICTURE = DecodedImage(np.zeros((240, 320, 3), np.uint8), 1)


class NotedSteer:
    """Stands for the controllers: notes what reaches them."""

    def __init__(self):
        self.unmet_calls, self.steps, self.resets = [], [], 0

    def unmet(self, *arguments):
        self.unmet_calls.append(arguments)

    def step(self, *arguments):
        self.steps.append(arguments)
        return COMMANDED

    def reset(self):
        self.resets += 1


@pytest.fixture(autouse=True)
def located(monkeypatch):
    """Locate each detection where its first corner is, in meters about the robot; note how."""
    notes = []

    def sphere(one, camera, radius_m):
        notes.append(("sphere", camera, radius_m))
        return None if one.label == "nowhere" else Sighting(one.x1_px, one.y1_px, one)

    def box(one, camera, sizes, otherwise_m):
        notes.append(("box", camera, sizes, otherwise_m))
        return Sighting(one.x1_px, one.y1_px, one)

    monkeypatch.setattr(module, "locate_sphere", sphere)
    monkeypatch.setattr(module, "locate_box", box)
    return notes


def follow_of(**sections):
    sections = {"latency": LatencyConfig(first_guess_s=0.1, actuation_s=0.0), **sections}
    made = Follow(Follow.Config(**sections), CAMERA)
    made._steer = NotedSteer()
    return made


def at(x_m, y_m=0.0, label="ball", outline=False):
    return Detection(x_m, y_m, x_m + 1, y_m + 1, 1.0, label, outline_px=np.zeros((8, 2)) if outline else None)


def view(*detections, t_us=1_000_000, dt_s=DT_S, picture=PICTURE, seq=1, **header):
    frame = FrameHeader(session="0000000a", seq=seq, t_us=t_us, **header)
    return View(frame, dt_s, 0.0, CAMERA, detections, picture)


# --- which detection, and where ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("picture", "sizes", "outline", "kind"), [
    (PICTURE, {}, True, "sphere"), (PICTURE, {}, False, "sphere"),
    (PICTURE, {"height_m": 0.3}, True, "sphere"), (PICTURE, {"height_m": 0.3}, False, "box"),
    (PICTURE, {"width_m": 0.3}, True, "sphere"), (PICTURE, {"width_m": 0.3}, False, "box"),
    (None, {}, True, "box"), (None, {}, False, "box"), (None, {"height_m": 0.3}, True, "box"),
])  # fmt: skip
def test_detection_is_a_box_without_pixels_or_without_an_outline_if_a_size_is_known(
    located, picture, sizes, outline, kind
):
    boxes, target = BoxesConfig(**sizes), TargetConfig(radius_m=0.25, stand_off_m=0.9)
    follow_of(boxes=boxes, target=target).step(view(at(1.0, outline=outline), picture=picture))
    assert located == [("box", CAMERA, boxes, 0.9) if kind == "box" else ("sphere", CAMERA, 0.25)]


def test_detection_is_located_by_the_camera_model_of_its_image(located):
    """So the mission continues with images of another size."""
    follow, half = follow_of(), CAMERA.model_copy(update={"width_px": 160})
    follow.step(view(at(1.0)))
    follow.step(replace(view(at(1.0)), camera=half))
    assert Follow.scales and [one[1] for one in located] == [CAMERA, half]


@pytest.mark.parametrize(("label", "sizes", "used"), [
    ("person", {}, {"height_m": 1.7, "width_m": 0.45}),
    ("person", {"height_m": 1.2}, {"height_m": 1.2}), ("person", {"width_m": 0.4}, {"width_m": 0.4}),
    ("ball", {}, None), ("", {}, None),
])  # fmt: skip
def test_person_is_a_box_of_an_adults_size_unless_a_size_is_configured(located, label, sizes, used):
    target = TargetConfig(radius_m=0.25, label=label)
    follow_of(boxes=BoxesConfig(**sizes), target=target).step(view(at(1.0, label=label or "cup"), picture=PICTURE))
    [(kind, _, size, *_)] = located
    assert (kind, size) == ("sphere", 0.25) if used is None else (kind, size) == ("box", BoxesConfig(**used))


@pytest.mark.parametrize(("label", "apart_m", "used_m"), [
    ("", 0.15, 0.15), ("ball", 0.15, 0.15), ("person", 0.15, 0.4), ("person", 0.6, 0.6), ("ball", 0.0, 0.0),
])
def test_two_humans_are_at_least_40_cm_apart(label, apart_m, used_m):
    follow = follow_of(target=TargetConfig(label=label), track=TrackConfig(apart_m=apart_m, gate_m=0.8))
    assert (follow._track._config.apart_m, follow._track._config.gate_m) == (used_m, 0.8)



@pytest.mark.parametrize(("picture", "wanted", "label", "meant"), [
    (PICTURE, "", "ball", True), (PICTURE, "", "legs", False), (PICTURE, "legs", "legs", True),
    (PICTURE, "ball", "legs", False), (PICTURE, "ball", "ball", True),
    (None, "", "legs", True), (None, "ball", "legs", False), (None, "ball", "ball", True),
])  # fmt: skip
def test_detections_of_the_label_are_meant(located, picture, wanted, label, meant):
    """Without one: all that can be followed, and every box of another service, which were selected on arrival."""
    follow_of(target=TargetConfig(label=wanted)).step(view(at(1.0, label=label), picture=picture))
    assert (len(located) == 1) == meant


@pytest.mark.parametrize(("x_m", "y_m", "in_range"), [
    (1.5, 2.0, True), (1.5, 2.001, False), (1.501, 2.0, False), (-2.5, 0.0, True), (0.0, -2.501, False),
])  # fmt: skip
def test_detection_beyond_the_range_is_not_the_target(x_m, y_m, in_range):
    plan = follow_of(target=TargetConfig(max_range_m=2.5)).step(view(at(x_m, y_m)))
    assert (plan.phase == "tracking") == in_range


def test_detection_that_is_nowhere_is_left_out():
    first, plan = at(1.0, label="nowhere"), follow_of().step(view(at(1.0, label="nowhere"), at(1.2)))
    assert plan.target != first and plan.target == at(1.2)


@pytest.mark.parametrize(("sizes", "expected_m"), [
    ({"height_m": 0.3}, 1.5), ({"width_m": 0.3}, 1.5), ({"height_m": 0.3, "width_m": 0.3}, 1.5), ({}, 0.8),
])  # fmt: skip
def test_box_of_a_known_size_is_expected_where_it_was_last_else_at_the_stand_off(located, sizes, expected_m):
    """The target at (1.3, 0.85) of a lens at (0.1, -0.05): 1.2 ahead and 0.9 to the left."""
    mission = follow_of(boxes=BoxesConfig(**sizes))
    pose = (2.0, 1.0, math.pi / 2)
    for _ in range(2):
        mission.step(view(at(1.3, 0.85), picture=None, pose=pose))
    assert [call[3] for call in located] == [0.8, pytest.approx(expected_m)]


# --- its look ----------------------------------------------------------------------------------------------------


def painted(*bgr):
    return DecodedImage(np.full((240, 320, 3), bgr, np.uint8), 1)


YELLOW, BLUE = painted(13, 199, 242), painted(204, 77, 26)


def ball(x_m, y_m=0.0):
    return Detection(x_m, y_m, 40.0, 40.0, 1.0, "ball")


@pytest.mark.parametrize(("mission", "is_other"), [(Follow, True), (Legs, False)])
def test_ball_of_another_color_is_not_the_hidden_target_and_what_stands_behind_legs_does_not_count(
    monkeypatch, mission, is_other
):
    monkeypatch.setattr(Legs, "_places", Follow._places)
    follow = mission(mission.Config(**({"label": "ball"} if mission is Legs else {})), CAMERA)
    assert follow.step(view(ball(1.5), picture=YELLOW)).phase == "tracking"
    for _ in range(4):
        assert follow.step(view(picture=YELLOW)).phase == "coasting"
    assert follow.step(view(ball(1.5, 0.2), picture=BLUE)).phase == ("coasting" if is_other else "tracking")
    assert follow.step(view(ball(1.5, 0.2), picture=YELLOW)).phase == "tracking"


def test_look_is_computed_where_it_matters(monkeypatch):
    looks = []
    monkeypatch.setattr(module, "look_of", lambda _picture, one: looks.append(one) or np.eye(64, dtype=np.float32)[0])
    follow, counts = follow_of(), []
    frames = [((1.5,), 1), ((1.5,), 2), ((1.5, 2.0), 3), ((1.5,), 8), ((1.5,), 9), ((), 10), ((1.5,), 11), ((1.5,), 12),
              ((1.5, 1.55), 13), ((1.5,), 14), ((1.8,), 15)]
    for places, seq in frames:
        follow.step(view(*map(ball, places), seq=seq))
        counts.append(len(looks))
    assert counts[:8] == [1, 1, 3, 4, 4, 4, 5, 5], "at the start, of several, each eighth frame, after a frame without"
    assert counts[8:] == [7, 7, 8], "of two at one place, and further than 0.15 m from the expected place"
    follow.step(view(ball(1.5), ball(2.0), picture=None))
    assert len(looks) == 8, "boxes of another service come without pixels"


# --- the plan ----------------------------------------------------------------------------------------------------


def test_plan_names_the_target_its_bearing_and_its_distance_from_the_lens():
    mission, ball = follow_of(), at(1.3, 0.85)
    plan = mission.step(view(ball, pose=(2.0, 1.0, math.pi / 2), seq=7))
    assert plan == Plan(
        COMMANDED, "tracking", target=ball, bearing_rad=pytest.approx(math.atan2(0.9, 1.2)),
        distance_m=pytest.approx(1.5),
        track=Target(pytest.approx(2.0 - 0.85), pytest.approx(1.0 + 1.3), 0.0, 0.0, 0, 1, number=7),
    )  # fmt: skip
    plan = mission.step(view(pose=(2.0, 1.0, math.pi / 2)))
    assert (plan.twist, plan.phase, plan.target) == (COMMANDED, "coasting", None)
    assert (plan.bearing_rad, plan.distance_m) == pytest.approx((math.atan2(0.9, 1.2), 1.5))


@pytest.mark.parametrize(("y_m", "side"), [(0.5, 1), (-0.5, -1), (0.0, 1), (-0.1, -1)])
def test_lost_target_is_searched_on_the_side_where_it_was(y_m, side):
    """Left of the lens, which is 5 cm right of the middle."""
    mission = follow_of(track=TrackConfig(give_up_s=0.25), search=SearchConfig(after_s=0.15, rate_rad_s=0.7))
    mission.step(view(at(1.0, y_m)))
    plans = [mission.step(view()) for _ in range(5)]
    assert [plan.phase for plan in plans] == ["coasting", "coasting", "lost", "searching", "searching"]
    assert plans[2] == Plan(STILL, "lost")
    assert plans[3] == Plan(Twist(linear_mps=0.0, angular_rad_s=side * 0.7), "searching")
    assert mission._steer.resets == 3


def test_search_counts_the_turn_and_the_time_of_the_robot():
    config = SearchConfig(after_s=0.0, max_turn_rad=0.5, max_turning_s=0.35)
    turning = follow_of(search=config)
    yaws = [turning.step(view(pose=(0.0, 0.0, yaw))).phase for yaw in (0.0, 0.4, 0.6)]
    assert yaws == ["searching", "searching", "lost"]
    waiting = follow_of(search=config)
    assert [waiting.step(view(applied=(0.0, 0.5))).phase for _ in range(4)] == ["searching"] * 3 + ["lost"]


# --- what reaches the controllers --------------------------------------------------------------------------------


def test_controllers_aim_at_the_target_from_where_the_robot_will_be():
    """It moves at 0.5 m/s for the 0.1 s of latency."""
    mission = follow_of()
    mission.step(view(at(1.35, 0.0), moving=(0.5, 0.0), applied=(0.5, 0.0)))
    ((dt_s, aim, latency_s, may_drive),) = mission._steer.steps
    assert (dt_s, latency_s, may_drive) == (DT_S, pytest.approx(0.1), False)
    assert (aim.x_m, aim.y_m) == pytest.approx((1.35 - 0.05 - 0.1, 0.05))


def test_measured_latency_replaces_the_first_guess():
    mission = follow_of()
    mission.step(view(at(1.0), latency_us=300_000, dt_s=0.25))
    assert mission._steer.steps[0][2] == pytest.approx(0.2), "half of the smoothing time has passed"


def test_robot_drives_after_two_sightings_and_for_half_a_second_without_one():
    mission = follow_of(track=TrackConfig(confirm=2, coast_s=0.5, give_up_s=1.0))
    for detections in ((at(1.0),), (at(1.0),), (), (), (), (), (), ()):
        mission.step(view(*detections))
    assert [step[3] for step in mission._steer.steps] == [False, True, True, True, True, True, True, False]


def test_coasting_ends_within_two_milliseconds_of_its_time():
    mission = follow_of(track=TrackConfig(confirm=1, coast_s=0.4, give_up_s=1.0))
    mission.step(view(at(1.0)))
    for dt_s in (0.2, 0.198, 0.002, 0.002):
        mission.step(view(dt_s=dt_s))
    assert [step[3] for step in mission._steer.steps] == [True, True, True, True, False]


@pytest.mark.parametrize(("gap_us", "dt_s", "phase", "may_drive"), [
    (499_000, 0.5, "coasting", True), (501_000, 0.5, "coasting", False), (1_199_000, 0.5, "coasting", False),
    (1_201_000, 0.5, "lost", None), (8_000_000, 0.5, "lost", None), (8_000_000, 0.0, "coasting", True),
])  # fmt: skip
def test_time_without_a_frame_is_time_without_the_target(gap_us, dt_s, phase, may_drive):
    """Without `dt_s`, the time of the last frame was not true."""
    mission = follow_of(search=SearchConfig(enabled=False))
    for t_us in (1_000_000, 1_100_000, 1_200_000):
        mission.step(view(at(1.0), t_us=t_us))
    steps = mission._steer.steps
    steps.clear()
    assert mission.step(view(t_us=1_200_000 + gap_us, dt_s=dt_s)).phase == phase
    assert [step[3] for step in steps] == ([] if may_drive is None else [may_drive])


@pytest.mark.parametrize(("t_us", "applied", "unmet"), [
    (1_100_000, (0.0, 0.0), [(DT_S, -0.2, -0.3)]), (1_099_999, (0.0, 0.0), []), (1_100_000, (0.1, 0.0), []),
    (1_100_000, (0.0, 0.1), []), (1_100_000, (0.01, 0.0), []), (1_100_000, (0.0, -0.01), []),
])  # fmt: skip
def test_integrals_give_way_if_the_wheels_stand_still_when_a_command_should_act(t_us, applied, unmet):
    """0.1 s after the frame that it answers."""
    mission = follow_of()
    mission.step(view(at(1.0)))
    assert mission._steer.unmet_calls == []
    mission.step(view(at(1.0), t_us=t_us, applied=applied))
    assert mission._steer.unmet_calls == unmet


def test_aim_is_where_the_target_will_be_about_the_lens_of_the_robot_then():
    """The robot at (2, 1) looks left; the target at (1.5, 3) moves by (0.2, -0.4) m/s for half a second."""
    target, robot = Target(1.5, 3.0, 0.2, -0.4, 0, 1), PredictedMotion((2.0, 1.0, math.pi / 2), 0.5, 0.0)
    aim = aim_at(target, robot, CAMERA, 0.5)
    expected = Aim(1.8 - 0.1, 0.4 + 0.05, -0.4, -0.2, 0.1)
    for name in ("x_m", "y_m", "vx_mps", "vy_mps", "lens_x_m"):
        assert getattr(aim, name) == pytest.approx(getattr(expected, name))


@pytest.mark.parametrize(("stand_off_m", "sign"), [(0.9, 0), (0.7, 1), (1.1, -1)])
def test_robot_drives_to_its_stand_off(stand_off_m, sign):
    """The target is 0.9 m ahead of the lens."""
    mission = Follow(Follow.Config(target=TargetConfig(stand_off_m=stand_off_m)), CAMERA)
    for _ in range(2):
        twist = mission.step(view(at(1.0, -0.05))).twist
    assert round(twist.linear_mps, 6) * sign > 0 if sign else twist.linear_mps == pytest.approx(0.0)
