"""A yellow ball among yellow boxes: by its colour a robot goes for a box, a learned detector follows the ball.

The score uses world truth alone: the robot, the axis of its camera, and the ball.
"""

import math
from pathlib import Path

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

from examples import older_range
from sightline.evaluation.lockstep import Conditions, run_lockstep
from sightline.evaluation.scenario_config import robot_of, vision_config
from sightline.evaluation.score.figures import score
from sightline.sim.scenario import load_scenario
from sightline.vision_side.config import DetectorConfig, HsvConfig

pytestmark = pytest.mark.computes

WAITING = load_scenario(str(Path(__file__).parent.parent.parent / "examples" / "ball-boxes.toml"))
SCENARIO = WAITING.model_copy(update={"target": WAITING.target.model_copy(update={"waits_s": 0.0})})
"""In virtual time the ball need not wait for processes."""
ROBOT = robot_of(SCENARIO)
WRITE_UP = (20, 25, 25, 64, 255, 255)
"""Lowest and highest in OpenCV's units: half degrees, and parts of 255."""

PAST_TWO_S = 15.0
"""Until the ball has rolled past two of the boxes."""


def driven(detector, seed, seconds, scenario=SCENARIO):
    """World truth of a run, and its score."""
    own = vision_config(scenario, ROBOT, seed).model_copy(update={"detector": DetectorConfig(kind=detector)})
    run = run_lockstep(scenario, ROBOT, seed, Conditions(latency_ms=50, loss=0.1), seconds, vision=own)
    return run.samples, score(SCENARIO, run)


def off_axis_deg(truth, box):
    """Return the distance of a box's center from the axis of the camera, which points in the robot's direction."""
    lens_x, lens_y = (at + ROBOT.camera.x_m * turn(truth.yaw_rad) for at, turn in ((truth.x_m, math.cos),
                                                                                   (truth.y_m, math.sin)))
    bearing_rad = math.atan2(box.at_m[1] - lens_y, box.at_m[0] - lens_x)
    return abs(math.degrees(math.remainder(bearing_rad - truth.yaw_rad, math.tau)))


def faces_a_box(truth):
    """The axis is on a box, and the ball is well aside of it."""
    return min(off_axis_deg(truth, box) for box in SCENARIO.things) < 4.0 and abs(math.degrees(truth.bearing_rad)) > 8.0


def test_the_scenario_is_what_the_write_up_had():
    (one,) = vision_config(SCENARIO, ROBOT).hsv.ranges
    lowest = (one.hue_low_deg / 2, 255 * one.saturation_low, 255 * one.value_low)
    highest = (one.hue_high_deg / 2, 255 * one.saturation_high, 255 * one.value_high)
    assert (*lowest, *highest) == pytest.approx(WRITE_UP, abs=0.02)
    assert vision_config(SCENARIO, ROBOT).hsv == HsvConfig(ranges=(one,)), "nothing else of ours is changed"
    assert one == older_range.RANGE
    assert {one.color for one in SCENARIO.things} == {SCENARIO.target.color} and len(SCENARIO.things) == 3
    assert all(one.jitter_m == 0 for one in SCENARIO.things), "the score uses their places"
    assert SCENARIO.start.distance_m[1] < SCENARIO.stand_off_m
    assert SCENARIO.start.bearing_deg[0] > SCENARIO.acquired_within_deg


def test_hsv_with_the_write_ups_range_goes_for_a_box():
    samples, result = driven("hsv", 311, 5.0)
    late = samples[len(samples) // 2 :]
    assert all(map(faces_a_box, late))
    assert result.acquired_s is None and samples[-1].distance_m > 1.5


def test_it_is_the_boxes_that_lead_it_astray():
    alone = SCENARIO.model_copy(update={"things": ()})
    samples, result = driven("hsv", 311, 5.0, alone)
    assert result.acquired_s is not None and result.bearing_rms_deg < 1.0 and result.lost_percent == 0
    assert samples[-1].distance_m == pytest.approx(SCENARIO.stand_off_m, abs=0.05)


@pytest.mark.parametrize("seconds", [5.0, pytest.param(PAST_TWO_S, marks=pytest.mark.slow)])
def test_the_learned_detector_follows_the_ball_past_them(seconds):
    samples, result = driven("onnx", 313, seconds)
    assert not any(map(faces_a_box, samples))
    assert result.acquired_s is not None and result.acquired_s < 5.0
    assert result.bearing_rms_deg < 3.0 and result.lost_percent == 0
    assert result.wall_contacts == result.target_contacts == 0
    assert result.travelled_m > 0.6 * (seconds - 2.0) * SCENARIO.target.speed_mps
