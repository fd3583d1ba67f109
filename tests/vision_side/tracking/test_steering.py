"""Track, foretelling, steering and search, each alone: what must hold for any input."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.protocol.messages import Pose, Twist
from sightline.vision_side.config import LatencyConfig, SearchConfig, SteerConfig, TrackConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.locate import Sighting
from sightline.vision_side.tracking.prediction import MotionPredictor
from sightline.vision_side.tracking.steering import Aim, Search, Steer
from sightline.vision_side.tracking.track import Track, from_odometry, to_odometry

DT_S = 1 / 30
HERE: Pose = (0.0, 0.0, 0.0)
BOX = Detection(0, 0, 1, 1, 1.0, "target")
LENGTH = st.floats(-5, 5)
ANGLE = st.floats(-math.pi, math.pi)


def at(x_m: float, y_m: float) -> Sighting:
    return Sighting(x_m, y_m, BOX)


# --- track -------------------------------------------------------------------------------------------------------


@given(x=LENGTH, y=LENGTH, yaw=ANGLE, px=LENGTH, py=LENGTH)
def test_odometry_frame_and_back(x: float, y: float, yaw: float, px: float, py: float) -> None:
    assert from_odometry((x, y, yaw), *to_odometry((x, y, yaw), px, py)) == pytest.approx((px, py), abs=1e-9)


def test_turning_about_a_still_target_measures_no_speed() -> None:
    track = Track(TrackConfig())
    for step in range(60):
        pose = (0.0, 0.0, 0.05 * step)
        track.step(DT_S, pose, [at(*from_odometry(pose, 1.0, 0.2))])
    assert track.target is not None
    assert math.hypot(track.target.vx_mps, track.target.vy_mps) < 1e-6


@given(vx=st.floats(-0.5, 0.5), vy=st.floats(-0.5, 0.5))
def test_velocity_is_learned_within_a_second(vx: float, vy: float) -> None:
    track = Track(TrackConfig())
    for step in range(45):
        track.step(DT_S, HERE, [at(1.0 + vx * step * DT_S, vy * step * DT_S)])
    assert track.target is not None
    assert (track.target.vx_mps, track.target.vy_mps) == pytest.approx((vx, vy), abs=0.05)


def test_lost_track_ends_and_a_new_sighting_starts_again() -> None:
    config = TrackConfig()
    track = Track(config)
    for _ in range(10):
        track.step(DT_S, HERE, [at(1.0, 0.0)])
    unseen_s = 0.0
    while track.target is not None:
        track.step(DT_S, HERE, [])
        unseen_s += DT_S
    assert config.give_up_s <= unseen_s < config.give_up_s + 3 * DT_S
    track.step(DT_S, HERE, [at(2.0, 1.0)])
    assert track.target is not None
    assert (track.target.x_m, track.target.y_m, track.target.sightings) == (2.0, 1.0, 1)


def test_distant_object_does_not_replace_the_target() -> None:
    track = Track(TrackConfig())
    for _ in range(10):
        track.step(DT_S, HERE, [at(1.0, 0.0), at(1.5, 0.9)])
    other = at(1.5, 0.9)
    assert track.step(DT_S, HERE, [other]) is None
    assert track.step(DT_S, HERE, [other, at(1.01, 0.01)]) == at(1.01, 0.01)


@pytest.mark.parametrize("push_mps", [0.3, 0.6, 1.0])
def test_a_pushed_target_stays_in_the_gate(push_mps: float) -> None:
    track = Track(TrackConfig())
    for step in range(90):
        pushed_s = max(0, step - 30) * DT_S
        assert track.step(DT_S, HERE, [at(1.0, push_mps * pushed_s)]) is not None
    assert track.target is not None
    assert track.target.vy_mps == pytest.approx(push_mps, abs=0.1)


# --- foretelling -------------------------------------------------------------------------------------------------


def test_unknown_latency_is_estimated_low_and_a_measured_one_approached_and_bounded() -> None:
    config = LatencyConfig(actuation_s=0.0)
    one = MotionPredictor(config)
    one.measure(None, DT_S)
    assert one.latency_s == config.first_guess_s
    for _ in range(300):
        one.measure(120_000, DT_S)
    assert one.latency_s == pytest.approx(0.12, abs=0.001)
    for _ in range(900):
        one.measure(10**12, DT_S)
    assert one.latency_s == pytest.approx(config.max_s, abs=0.001)


def test_prediction_includes_commands_in_flight() -> None:
    config = LatencyConfig(first_guess_s=0.2, actuation_s=0.0, angular_acceleration_rad_s2=200)
    one = MotionPredictor(config)
    for step in range(30):
        one.sent(step * 33_333, Twist(linear_mps=0.0, angular_rad_s=1.0))
    motion = one.motion(30 * 33_333, HERE, (0.0, 1.0), (0.0, 1.0))
    assert motion.pose[2] == pytest.approx(0.2, abs=0.01)


def test_prediction_of_a_held_robot_stays() -> None:
    one = MotionPredictor(LatencyConfig())
    for step in range(30):
        one.sent(step * 33_333, Twist(linear_mps=0.5, angular_rad_s=1.0))
    assert one.motion(1_000_000, (1.0, 2.0, 0.5), (0.0, 0.0), (0.0, 0.0)).pose == (1.0, 2.0, 0.5)


# --- steering ----------------------------------------------------------------------------------------------------


@given(
    where=st.tuples(LENGTH, LENGTH),
    speed=st.tuples(st.floats(-2, 2), st.floats(-2, 2)),
    latency=st.floats(0, 1),
    drive=st.booleans(),
)
def test_twists_keep_the_limits_and_mirror(
    where: tuple[float, float], speed: tuple[float, float], latency: float, drive: bool
) -> None:
    config, (x, y), (vx, vy) = SteerConfig(), where, speed
    left = Steer(config, 0.8).step(DT_S, Aim(x, y, vx, vy), latency, drive)
    right = Steer(config, 0.8).step(DT_S, Aim(x, -y, vx, -vy), latency, drive)
    assert -config.max_reverse_mps <= left.linear_mps <= config.max_linear_mps
    assert abs(left.angular_rad_s) <= config.max_angular_rad_s
    assert drive or left.linear_mps == 0.0
    if abs(y) > 1e-9:  # straight behind, either way round is right
        assert (right.linear_mps, right.angular_rad_s) == pytest.approx((left.linear_mps, -left.angular_rad_s))


def test_gain_falls_with_latency() -> None:
    config = SteerConfig(bearing_ki=0.0)
    for latency_s in (0.05, 0.2, 0.4):
        twist = Steer(config, 0.8).step(DT_S, Aim(0.8 * math.cos(0.05), 0.8 * math.sin(0.05), 0, 0), latency_s, True)
        assert twist.angular_rad_s / 0.05 * latency_s <= config.max_gain_latency + 1e-6
        assert twist.angular_rad_s > 0


def test_feed_forward_meets_a_crossing_target_without_error() -> None:
    twist = Steer(SteerConfig(), 0.8).step(DT_S, Aim(0.8, 0.0, 0.0, 0.25), 0.1, True)
    assert twist.angular_rad_s == pytest.approx(0.25 / 0.8)
    assert twist.linear_mps == pytest.approx(0.0)


def test_integrals_are_bounded_and_reduced_by_unapplied_commands() -> None:
    config = SteerConfig()
    steer, aim = Steer(config, 0.8), Aim(0.79, 0.05, 0, 0)
    first = steer.step(DT_S, aim, 0.05, True).angular_rad_s
    for _ in range(1000):
        wound = steer.step(DT_S, aim, 0.05, True).angular_rad_s
    assert first < wound <= first + config.integral_angular_rad_s + 1e-9
    for _ in range(100):
        steer.unmet(DT_S, 0.0, -wound)
    assert steer.step(DT_S, aim, 0.05, True).angular_rad_s < first


@given(dt=st.floats(0.005, 0.2))
def test_integral_depends_on_time_not_on_frames(dt: float) -> None:
    steer, aim = Steer(SteerConfig(), 0.8), Aim(0.8, 0.008, 0, 0)
    steps = round(1.0 / dt)
    for _ in range(steps):
        twist = steer.step(dt, aim, 0.05, True)
    fresh = Steer(SteerConfig(), 0.8).step(dt, aim, 0.05, True)
    grown = twist.angular_rad_s - fresh.angular_rad_s
    assert grown == pytest.approx(SteerConfig().bearing_ki * 0.01 * (steps - 1) * dt, rel=0.05, abs=1e-3)


# --- search ------------------------------------------------------------------------------------------------------


def turned(config: SearchConfig, side: float, seconds: float, carried_out: float = 1.0) -> float:
    """Return the turn of a robot that applies the search command, fully or in part."""
    search, yaw, applied = Search(config), 0.0, 0.0
    search.reset(side)
    for _ in range(round(seconds / DT_S)):
        twist = search.step(DT_S, (0.0, 0.0, yaw), (0.0, applied))
        applied = twist.angular_rad_s if twist else 0.0
        assert twist is None or twist.linear_mps == 0.0
        yaw += applied * DT_S * carried_out
    return yaw


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_search_turns_to_the_side_last_seen_and_ends(side: float) -> None:
    config = SearchConfig()
    total = turned(config, side, 60)
    assert math.copysign(1, total) == side
    assert config.max_turn_rad <= abs(total) <= config.max_turn_rad + 0.2


def test_a_stuck_robot_stops_trying() -> None:
    assert turned(SearchConfig(max_turning_s=3.0), 1.0, 60, carried_out=0.1) <= 3.1 * 1.2 * 0.1


def test_a_held_robot_keeps_its_search() -> None:
    search = Search(SearchConfig())
    for _ in range(3000):
        twist = search.step(DT_S, HERE, (0.0, 0.0))
    assert twist is not None


def test_one_empty_image_starts_nothing_and_a_disabled_search_never() -> None:
    assert Search(SearchConfig()).step(DT_S, HERE, (0.0, 0.0)) is None
    assert turned(SearchConfig(enabled=False), 1.0, 10) == 0.0
