"""Moving and lit bodies of a scenario, and a scenario that extends another."""

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import numpy as np
import simplejpeg

from sightline.protocol.errors import ConfigError
from sightline.sim.robot import load_robot
from sightline.sim.scenario import LIT, LegShape, Light, LightPhase, color_of, load_scenario
from sightline.sim.toml_file import laid_over
from sightline.sim.world.bodies import PathMover
from sightline.sim.world.start import goals_seen
from sightline.sim.world.world import World
from tests.fixtures.sim import robot_with

# --- legs --------------------------------------------------------------------------------------------------------


@given(st.floats(0, 50), st.floats(0.2, 1.5))
def test_one_foot_stands_while_the_other_swings_twice_as_fast(way_m, stride_m):
    legs, step_m = LegShape(stride_m=stride_m), 1e-4
    speeds = [1 + (legs.ahead_m(way_m + step_m, left) - legs.ahead_m(way_m, left)) / step_m for left in (True, False)]
    at_a_turn = min((way_m / stride_m * 2) % 1, 1 - (way_m / stride_m * 2) % 1) < 2 * step_m / stride_m + 1e-6
    assert at_a_turn or sorted(round(speed, 3) for speed in speeds) == [0.0, 2.0]
    assert all(abs(legs.ahead_m(way_m, left)) <= stride_m / 4 + 1e-9 for left in (True, False))


def test_a_walking_person_keeps_speed_and_its_legs_stay_apart():
    scenario = load_scenario("legs")
    with World(scenario, robot_with(), 3) as world:
        before = world.truth()
        for _ in range(500):
            world.step()
        after = world.truth()
    gone_m = math.hypot(after.target_x_m - before.target_x_m, after.target_y_m - before.target_y_m)
    assert gone_m == pytest.approx(2 * scenario.target.speed_mps, rel=0.02)
    assert after.target_contacts == 0


def test_the_lidar_sees_two_legs_and_between_them():
    with World(load_scenario("legs"), robot_with(), 3) as world:
        scan, truth = world.scan(), world.truth()
    angles = [scan.angle_min_rad + index * scan.angle_increment_rad for index in range(len(scan.ranges_m))]
    hits = [angle for angle, away_m in zip(angles, scan.ranges_m, strict=True) if away_m < 2.0]
    gaps = sum(later - earlier > 1.5 * scan.angle_increment_rad for earlier, later in pairwise(hits))
    assert gaps == 1, "two runs of echoes"
    assert min(hits) < truth.bearing_rad < max(hits)


# --- a constant force --------------------------------------------------------------------------------------------


def test_a_constant_force_rolls_the_ball_up_to_the_speed_that_its_drag_allows():
    scenario = load_scenario("chaser")
    target = scenario.target
    with World(scenario, load_robot("chaser-small"), 2) as world:
        for _ in range(int(20 / 0.004)):
            world.step()
        before = world.truth()
        for _ in range(250):
            world.step()
        after = world.truth()
    wanted_mps = target.force_n / (1.4 * target.mass_kg * -math.log(1 - target.drag))
    assert after.target_x_m - before.target_x_m == pytest.approx(wanted_mps, rel=0.03)
    assert after.target_y_m == pytest.approx(0.0, abs=0.02)


# --- the traffic light -------------------------------------------------------------------------------------------


@given(st.floats(0, 0.999), st.integers(0, 60_000_000))
def test_the_light_keeps_its_schedule(begin, now_us):
    light = Light(at_m=(0.0, 0.0))
    at_s = (begin * 12 + now_us / 1e6) % 12
    assert light.state_at(begin, now_us) == ("red" if at_s < 5 else "green" if at_s < 10 else "yellow")


def test_a_light_of_one_colour_never_changes():
    light = Light(at_m=(0.0, 0.0), schedule=(LightPhase(state="red", seconds=1),))
    assert {light.state_at(0.3, now_us) for now_us in range(0, 5_000_000, 100_000)} == {"red"}


@pytest.mark.parametrize(("faces_deg", "at", "past_m"), [
    (180.0, (0.0, 0.0), -2.4), (180.0, (2.4, 7.0), 0.0), (180.0, (3.0, 0.0), 0.6), (90.0, (3.0, 0.0), 0.15),
])
def test_the_line_crosses_the_lane_before_the_light(faces_deg, at, past_m):
    light = Light(at_m=(3.0, -0.45), faces_deg=faces_deg)
    assert light.past_line_m(*at) == pytest.approx(past_m)


def test_only_the_lit_lamp_is_bright():
    lamps = [part for part in Light(at_m=(0.0, 0.0)).parts() if part.state]
    for state in ("red", "yellow", "green"):
        shine = {part.state: max(color_of(part, state)) for part in lamps}
        assert max(shine, key=shine.get) == state
        assert sorted(shine.values())[-2] < 0.3 * shine[state]
    assert [part.state for part in sorted(lamps, key=lambda part: part.at_m[2], reverse=True)] == [
        "red", "yellow", "green"]


@pytest.mark.parametrize("name", ["traffic-light", "traffic-light-boxes"])
def test_image_shows_the_lamp_of_the_truth(name):
    scenario = load_scenario(name)
    near = scenario.start.model_copy(update={"at_m": (2.0, -0.4), "heading_deg": (0.0, 0.0), "jitter_m": 0.0})
    with World(scenario.model_copy(update={"start": near}), robot_with(), 5) as world:
        for _ in range(6):
            for _ in range(500):
                world.step()
            rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)
            wanted = np.array(LIT[world.truth().light])
            across = rgb @ wanted / np.maximum(np.linalg.norm(rgb, axis=-1) * np.linalg.norm(wanted), 1.0)
            assert ((across > 0.97) & (rgb.max(axis=-1) - rgb.min(axis=-1) > 80)).sum() > 20, world.truth().light


# --- extending ---------------------------------------------------------------------------------------------------


def test_file_contains_only_differences_from_the_defaults():
    ball, eight = load_scenario("ball"), load_scenario("ball-eight")
    assert (eight.seconds, len(eight.target.path)) == (60.0, 2)
    assert (eight.target.color, eight.vision, eight.start) == (ball.target.color, ball.vision, ball.start)
    assert load_scenario("thymio-box").things == ()


def test_a_table_of_another_kind_keeps_nothing_of_the_old_one():
    under = {"target": {"kind": "forced", "mass_kg": 1}, "look": "dim", "vision": {"a": {"b": 1, "c": 2}}}
    over = {"target": {"kind": "path", "speed_mps": 2}, "vision": {"a": {"b": 3}}}
    assert laid_over(under, over) == {
        "target": {"kind": "path", "speed_mps": 2}, "look": "dim", "vision": {"a": {"b": 3, "c": 2}}}
    assert laid_over(under, {"vision": {"a": {}}})["vision"] == {"a": {}}


@pytest.mark.parametrize(("text", "expected"), [
    ('extends = "bal"', "nothing is called 'bal', did you mean 'ball'?"),
    ('extends = "ball-eight"', "which extends another; extend 'ball' itself"),
    ('extends = "ball"\nlook = "dimm"', "did you mean 'dim'?"),
    ('extends = "ball"\n[target]\nshape = "bal"', "target.path.shape"),
    ('extends = "pushed"\n[target]\nshape = "box"', "only a ball rolls"),
    ('extends = "thymio"\n[start]\nat_m = [0.0, nan]', "start.at_m"),
    ('extends = "traffic-light"\n[light]\nat_m = [3.0, 0.0]\nschedule = []', "light.schedule"),
    ('extends = "thymio"\ngoals_m = [[1.0, 200.0]]', "goals_m"),
])
def test_what_cannot_be_extended_so_is_one_line(tmp_path, text, expected):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_scenario(str(tmp_path / "mine.toml"))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_waypoints_are_numbered_as_the_robot_counts(seed):
    scenario = load_scenario("thymio")
    with World(scenario, load_robot("thymio"), seed) as world:
        truth = world.truth()
    ((x_m, y_m),) = goals_seen(scenario, seed)
    cos, sin = math.cos(truth.yaw_rad), math.sin(truth.yaw_rad)
    assert (truth.x_m + x_m * cos - y_m * sin, truth.y_m + x_m * sin + y_m * cos) == pytest.approx((1.5, 1.5), abs=1e-5)


@pytest.mark.parametrize(("look", "least", "most"), [("plain", 0.8, 1.0), ("desaturated", 0.3, 0.6)])
def test_a_desaturated_picture_is_paler(look, least, most):
    from sightline.sim.scenario import look_named

    with World(load_scenario("ball").model_copy(update={"look": look_named(look)}), robot_with(), 3) as world:
        rgb = simplejpeg.decode_jpeg(world.render(), "RGB").astype(float)
    vivid = np.quantile((rgb.max(axis=-1) - rgb.min(axis=-1)) / np.maximum(rgb.max(axis=-1), 40), 0.995)
    assert least < vivid < most


def test_a_target_that_waits_stands_and_then_moves_as_without():
    here, waiting = load_scenario("circle").target, load_scenario("circle").target.model_copy(update={"waits_s": 6.0})
    at_once, later = PathMover(here, 0.25), PathMover(waiting, 0.25)
    assert later.place(0) == later.place(6_000_000) == at_once.place(0)
    assert later.place(9_000_000) == at_once.place(3_000_000)
