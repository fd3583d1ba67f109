"""Missions `traffic-light` and `traffic-light-boxes`: lights read right in any look, the line kept, the lane driven."""

import math
import random

import numpy as np
import pytest

from sightline.protocol.messages import FrameHeader
from sightline.sim.scenario import look_named
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.goto import Footprint
from sightline.vision_side.missions.lane import Lane, LaneConfig
from sightline.vision_side.missions.lights import (
    COLOURS,
    UNKNOWN,
    BoxLightReader,
    DetectedLight,
    HousingLightReader,
    LampConfig,
)
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.missions.traffic_light import StopConfig, StopLine, TrafficLight, TrafficLightBoxes
from tests.fixtures.vision.course import Course, Drive, Row
from tests.fixtures.vision.lane import BLOCK_M, LENS, LaneWorld

pytestmark = pytest.mark.computes

LOOKS = ("plain", "dim", "bright", "warm", "cold", "desaturated", "quality30")
RASPBERRY = Footprint(front_m=0.07, rear_m=0.10, half_width_m=0.09)
CYCLE = (("red", 5.0), ("green", 5.0), ("yellow", 2.0))
LINE_M = 2.4  # the light stands at 3.0, its line is 0.6 m before it


# --- reading -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("is_box", [False, True], ids=["lamps", "box"])
def test_every_state_is_read_right_in_every_look(look: str, is_box: bool) -> None:
    reader = (BoxLightReader if is_box else HousingLightReader)(LampConfig())
    draw = random.Random(look)
    read = 0
    for number in range(36):
        state = COLOURS[number % 3]
        world = LaneWorld(is_box=is_box, look=look_named(look), seed=number, state=lambda t_s, state=state: state)
        pose = (draw.uniform(0.6, 2.25), draw.uniform(-0.1, 0.1), draw.uniform(-0.12, 0.12))
        blocks, picture = world.sight(pose, 0.0)
        lights = reader.read(picture, blocks)
        assert len(lights) <= 1
        assert all(one.colour in (state, UNKNOWN) for one in lights)
        read += sum(one.colour == state for one in lights)
    assert read >= 34


def test_image_without_a_light_gives_no_light() -> None:
    world = LaneWorld(light=(-5.0, 0.0))
    for number in range(12):
        blocks, picture = world.sight((0.25 * number, 0.0, 0.05 * math.sin(number)), 0.0)
        assert HousingLightReader(LampConfig()).read(picture) == []
        assert BoxLightReader(LampConfig()).read(picture, blocks) == []


def test_noise_gives_no_light_and_raises_nothing() -> None:
    draw = np.random.default_rng(3)
    for reader in (HousingLightReader(LampConfig()), BoxLightReader(LampConfig())):
        for picture in (draw.integers(0, 256, (120, 160, 3)), np.zeros((120, 160, 3)), np.full((120, 160, 3), 255)):
            assert reader.read(DecodedImage(picture.astype(np.uint8), 1)) == []


# --- the line ----------------------------------------------------------------------------------------------------


def test_red_stops_before_the_line_from_any_speed_it_was_seen_in_time_at() -> None:
    for cruise in (0.1, 0.3, 0.5):
        stop, left_m, speed = StopLine(StopConfig()), 1.0, cruise
        for _ in range(1000):
            stop.see("red", 0.02)
            wanted = stop.speed(left_m, speed, cruise)
            speed += max(-0.02, min(0.02, wanted - speed))
            left_m -= speed * 0.02
        assert 0.05 < left_m < 0.11


@pytest.mark.parametrize(("left_m", "clears"), [(0.001, True), (0.03, True), (0.05, False), (0.5, False),
                                                (-0.05, True)])
def test_yellow_stops_where_it_can_and_clears_where_it_cannot(left_m: float, clears: bool) -> None:
    stop = StopLine(StopConfig())  # 0.3 m/s needs 0.0375 m at 1.2 m/s2
    for _ in range(2):
        stop.see("green", 0.03)
    assert stop.speed(left_m, 0.3, 0.3) == 0.3
    for colour in ("yellow", "red"):
        stop.see(colour, 0.03)
        speed_mps = stop.speed(left_m, 0.3, 0.3)
        assert stop.clearing == clears
        assert (speed_mps == 0.3) == (clears or left_m > 0.4)


def test_second_green_frame_starts_and_first_red_frame_stops() -> None:
    stop = StopLine(StopConfig())
    assert stop.speed(0.02, 0.0, 0.3) == 0.0
    stop.see("green", 0.03)
    assert stop.speed(0.02, 0.0, 0.3) == 0.0
    stop.see("green", 0.03)
    assert stop.speed(0.02, 0.0, 0.3) == 0.3
    stop.see("red", 0.03)
    assert stop.speed(0.02, 0.0, 0.3) == 0.0


def test_robot_past_the_line_continues_at_any_light() -> None:
    stop = StopLine(StopConfig())
    stop.see("red", 0.03)
    assert stop.speed(-0.05, 0.0, 0.3) == 0.0
    assert stop.speed(-0.2, 0.0, 0.3) == 0.3


def test_a_light_that_is_hidden_for_long_counts_as_red() -> None:
    stop = StopLine(StopConfig(hidden_s=0.4))
    for _ in range(3):
        stop.see("green", 0.1)
    for _ in range(4):
        stop.see(UNKNOWN, 0.1)
    assert stop.speed(0.3, 0.1, 0.3) == 0.3
    stop.see(UNKNOWN, 0.1)
    assert stop.speed(0.05, 0.1, 0.3) == 0.0


def test_one_green_frame_after_a_light_was_hidden_does_not_start() -> None:
    for greens in (1, 5):
        stop = StopLine(StopConfig(hidden_s=0.4))
        for colour in ["green"] * greens + [UNKNOWN] * 90 + ["green"]:
            stop.see(colour, 0.1)
        assert stop.speed(0.03, 0.0, 0.3) == 0.0
        stop.see("green", 0.1)
        assert stop.speed(0.03, 0.0, 0.3) == 0.3


def test_light_that_cannot_be_read_in_each_second_frame_turns_green() -> None:
    stop = StopLine(StopConfig())
    for colour in ("red", UNKNOWN, "green", UNKNOWN, "green", UNKNOWN):
        stop.see(colour, 1 / 30)
    assert stop.speed(0.03, 0.0, 0.3) == 0.3


@pytest.mark.parametrize(("left_m", "moving_mps"), [(0.03, 0.3), (0.03, 0.0), (0.001, 0.009), (0.001, 0.02)])
def test_robot_that_was_held_while_it_cleared_the_line_stays_before_it(left_m: float, moving_mps: float) -> None:
    stop = StopLine(StopConfig())
    for colour in ("green", "green", "yellow"):
        stop.see(colour, 0.03)
        speed_mps = stop.speed(left_m, 0.3, 0.3)
    assert speed_mps == 0.3 and stop.clearing
    for _ in range(200):
        stop.see("red", 0.03)
        speed_mps = stop.speed(left_m, moving_mps, 0.3)
    assert speed_mps == (0.3 if moving_mps > 0.01 else 0.0)


# --- the lane ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0])
def test_lane_runs_parallel_to_its_blocks(side: int, turn: float) -> None:
    lane, cos, sin = Lane(LaneConfig(pass_m=0.5)), math.cos(turn), math.sin(turn)
    row = [(0.6 * k * cos - side * 0.5 * sin, 0.6 * k * sin + side * 0.5 * cos) for k in range(1, 5)]
    lane.see((0.0, 0.0, turn + 0.1), row)
    assert lane.line is not None
    assert math.remainder(lane.line.heading_rad - turn, math.tau) == pytest.approx(0.0, abs=1e-6)
    assert lane.line.aside_m(0.0, 0.0) == pytest.approx(0.0, abs=1e-6)
    assert lane.left_m((0.0, 0.0, turn)) == pytest.approx(2.4 + 0.8, abs=1e-6)


def test_a_block_straight_ahead_is_passed_at_its_side() -> None:
    lane = Lane(LaneConfig(pass_m=0.5, in_the_way="left"))
    lane.see((0.0, 0.0, 0.0), [(1.0, 0.02)])
    assert lane.line is not None and lane.line.aside_m(1.0, 0.02) == pytest.approx(0.5)


def test_blocks_are_remembered_once_and_without_end_they_are_bounded() -> None:
    lane = Lane(LaneConfig())
    for step in range(3000):
        lane.see((0.3 * step, 0.0, 0.0), [(0.3 * step + 1.0, 0.5), (0.3 * step + 1.01, 0.49)])
    assert len(lane._blocks) <= 64


# --- two lights on one lane ----------------------------------------------------------------------------------------

BLANK = DecodedImage(np.full((LENS.height_px, LENS.width_px, 3), 120, np.uint8), 1)


def box_at(x_m: float, y_m: float, height_m: float, width_m: float) -> Detection:
    """Return the box of something at a place in front of the lens, with its lower edge at half of the image."""
    ahead_m = x_m - LENS.x_m
    x, half = LENS.cx_px - LENS.fx_px * y_m / ahead_m, LENS.fx_px * width_m / ahead_m / 2
    return Detection(x - half, LENS.cy_px - LENS.fy_px * height_m / ahead_m, x + half, LENS.cy_px, 1.0, "target")


def light_at(x_m: float, colour: str) -> DetectedLight:
    lamp = LampConfig()
    return DetectedLight(colour, box_at(x_m, -0.1, lamp.housing_height_m, lamp.housing_width_m))


def plans_at_lights(*frames: list[DetectedLight]) -> list[Plan]:
    """Return the plan for each frame, given the lights in it. The robot does not move."""
    # The images had another size when the mission began.
    before = LENS.model_copy(update={"height_px": 2 * LENS.height_px, "fy_px": 2 * LENS.fy_px, "cy_px": 2 * LENS.cy_px})
    mission, plans = TrafficLight(TrafficLight.Config(block_height_m=BLOCK_M), before), []
    blocks = tuple(box_at(x, 0.5, BLOCK_M, 0.1) for x in (1.5, 2.0, 2.5))
    for seq, lights in enumerate(frames):
        mission._reader.read = lambda *_, lights=lights: lights
        header = FrameHeader(session="0000abcd", seq=seq + 1, t_us=seq * 33_000)
        plans.append(mission.step(View(header, 0.033, 0.05, LENS, blocks, BLANK)))
    return plans


NEAR_M, FAR_M = 0.75, 2.4


@pytest.mark.parametrize("first", [[light_at(NEAR_M, "red")], [light_at(FAR_M, "green"), light_at(NEAR_M, "red")]])
@pytest.mark.parametrize("then", [[], [light_at(NEAR_M, UNKNOWN)]], ids=["hidden", "unreadable"])
def test_green_light_further_on_does_not_replace_a_hidden_red_one(first, then) -> None:
    plans = plans_at_lights(*[first] * 5, *[[light_at(FAR_M, "green"), *then]] * 30)
    assert all(plan.twist.linear_mps < 0.15 for plan in plans)
    assert plans[4].note.startswith("light red") and plans[-1].note.startswith("light unknown")
    assert plans[-1].distance_m == pytest.approx(plans[4].distance_m)


@pytest.mark.parametrize("unreadable", [[], [light_at(NEAR_M, UNKNOWN)]])
def test_nearer_light_replaces_a_known_one_as_soon_as_it_is_readable(unreadable) -> None:
    far = light_at(FAR_M, "green")
    plans = plans_at_lights(*[[far, *unreadable]] * 5, [far, light_at(NEAR_M, "red")])
    assert plans[4].note.startswith("light green") and plans[4].twist.linear_mps == 0.3
    assert plans[5].note.startswith("light red") and plans[5].twist.linear_mps < 0.15
    assert plans[4].distance_m - plans[5].distance_m == pytest.approx(FAR_M - NEAR_M, abs=0.1)


# --- driving -----------------------------------------------------------------------------------------------------


def state_at(begin_s: float):
    def at(t_s: float) -> str:
        left_s = (t_s + begin_s) % 12.0
        return next(name for index, (name, _) in enumerate(CYCLE) if left_s < sum(one[1] for one in CYCLE[: index + 1]))
    return at


def drive(begin_s: float, is_box: bool = False, seed: int = 1, look: str = "plain") -> list[Row]:
    world = LaneWorld(is_box=is_box, light=(3.0, -0.55 if is_box else -0.45), state=state_at(begin_s),
                      look=look_named(look), seed=seed)
    kind = TrafficLightBoxes if is_box else TrafficLight
    mission = kind(kind.Config(block_height_m=BLOCK_M), LENS)
    posts = tuple((x, y, BLOCK_M / 2) for x, y in world.blocks)
    draw = random.Random(seed)
    start = (draw.uniform(-0.06, 0.06), draw.uniform(-0.06, 0.06), draw.uniform(-0.14, 0.14))
    return Drive(mission, Course(posts=(*posts, (*world.light, 0.03))), start=start, body=RASPBERRY, seed=seed,
                 acceleration=(2.0, 10.0), eye=world.sight).run(45)


@pytest.mark.parametrize("is_box", [False, True], ids=["lamps", "box"])
@pytest.mark.parametrize("begin_s", [
    0.0, 3.6, 4.0, 9.0, pytest.param(2.5, marks=pytest.mark.slow), pytest.param(7.0, marks=pytest.mark.slow),
])
def test_the_line_is_never_crossed_on_red_and_the_lane_is_driven_to_its_end(begin_s: float, is_box: bool) -> None:
    run = drive(begin_s, is_box, seed=int(10 * begin_s) + 1)
    state = state_at(begin_s)
    front = [row.pose[0] + 0.07 * math.cos(row.pose[2]) - LINE_M for row in run]
    crossed = next(index for index, one in enumerate(front) if one > 0)
    assert state(run[crossed].t_s) == "green" or (state(run[crossed].t_s) == "yellow" and run[crossed].moving[0] > 0.2)
    assert run[-1].plan.phase == "lane end" and run[-1].plan.done
    assert min(row.clearance_m for row in run) > 0.15
    assert max(abs(row.pose[1]) for row in run if row.t_s > 4) < 0.15
    waited = [row.t_s for row, one in zip(run, front, strict=True) if -0.3 < one < 0 and row.moving[0] == 0.0]
    if waited:  # it goes within 0.7 s of green
        green_s = next(t for t in np.arange(waited[0], 60, 0.01) if state(t) == "green")
        assert waited[-1] < green_s + 0.7


def test_without_an_image_or_a_block_nothing_moves() -> None:
    mission = TrafficLight(TrafficLight.Config(), LENS)
    header = FrameHeader(session="0000abcd", seq=1, t_us=0)
    assert mission.step(View(header, 0.0, 0.05, LENS, (), None)).phase == "no image"
    blank = DecodedImage(np.full((240, 320, 3), 120, np.uint8), 1)
    plan = mission.step(View(header, 0.0, 0.05, LENS, (), blank))
    assert plan.phase == "no lane" and plan.twist.linear_mps == plan.twist.angular_rad_s == 0.0
