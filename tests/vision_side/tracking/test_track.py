"""The track against a Kalman filter in matrices, and its gate and times with numbers."""

import math

import pytest

from sightline.vision_side.config import TrackConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.locate import Sighting
from sightline.vision_side.tracking.track import Target, Track, from_odometry, to_odometry

HERE = (0.0, 0.0, 0.0)
DT_S = 0.1


def at(x_m, y_m=0.0, score=1.0, **exactness):
    return Sighting(x_m, y_m, Detection(0, 0, 1, 1, score, "target"), **exactness)


def started(*positions, **config):
    """Return a track of one sighting after the other, `DT_S` apart."""
    track = Track(TrackConfig(**config))
    for position in positions:
        assert track.step(DT_S, HERE, [at(*position)]) is not None
    return track


# --- the filter --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("x_m", "score", "sigma_m"), [
    (1.0, 1.0, 0.008), (2.0, 1.0, 0.032), (1.0, 0.5, 0.032), (1.0, 0.2, 0.2), (1.0, 0.1, 0.2), (0.2, 1.0, 0.0008),
])  # fmt: skip
def test_noise_of_a_position_grows_with_the_square_of_the_range(x_m, score, sigma_m):
    """One sigma is `range_noise` at 1 m, four times that at 2 m and at half the score, at least 0.1 of it."""
    track, dt_s = Track(TrackConfig(range_noise=0.008, acceleration_mps2=0.35)), sigma_m / 0.3
    track.step(dt_s, HERE, [at(x_m, 0.0, score), at(3.0, 0.0)])
    track.step(dt_s, HERE, [at(x_m, 0.0001, score)])
    predicted = sigma_m**2 + 0.3**2 * dt_s**2 + 0.35**2 * dt_s**3 / 3  # position, velocity of 0.3 m/s, acceleration
    share = predicted / (predicted + sigma_m**2)
    assert track.target.y_m == pytest.approx(0.0001 * share, rel=1e-5)


@pytest.mark.parametrize(("exactness", "score"), [({}, 0.8), ({"exactness": 0.5}, 0.4), ({"exactness": 0.9}, 0.72)])
def test_partly_assumed_range_counts_as_a_lower_score(exactness, score):
    less, lower = (started((1.0,), (1.001, 0.0)) for _ in range(2))
    less.step(DT_S, HERE, [at(1.01, 0.0, 0.8, **exactness)])
    lower.step(DT_S, HERE, [at(1.01, 0.0, score)])
    assert less.target.x_m == pytest.approx(lower.target.x_m, rel=1e-9)


def test_noise_depends_on_the_distance_not_on_the_direction():
    moved = []
    for angle in (0.0, 0.9, 2.0):
        track = Track(TrackConfig())
        cos, sin = math.cos(angle), math.sin(angle)
        for across_m in (0.0, 0.001):
            track.step(DT_S, HERE, [at(1.5 * cos - across_m * sin, 1.5 * sin + across_m * cos)])
        moved.append(math.hypot(track.target.x_m - 1.5 * cos, track.target.y_m - 1.5 * sin))
    assert moved == pytest.approx([moved[0]] * 3, rel=1e-5)


class Matrices:
    """A Kalman filter of position and velocity on one axis, by the textbook: F P F' + Q, then the gain K = P H' / S."""

    def __init__(self, position, noise, acceleration):
        self.state = [position, 0.0]
        self.p = [[noise, 0.0], [0.0, 0.09]]
        self.acceleration = acceleration

    def step(self, dt, position, noise):
        """Predict, and correct if there is a position."""
        (a, b), (c, d) = self.p
        q = self.acceleration**2
        self.state[0] += self.state[1] * dt
        self.p = [
            [a + dt * (b + c) + dt * dt * d + q * dt**3 / 3, b + dt * d + q * dt**2 / 2],
            [c + dt * d + q * dt**2 / 2, d + q * dt],
        ]
        if position is None:
            return
        (a, b), (c, d) = self.p
        k0, k1, off = a / (a + noise), c / (a + noise), position - self.state[0]
        self.state[0] += k0 * off
        self.state[1] += k1 * off
        self.p = [[a - k0 * a, b - k0 * b], [c - k1 * a, d - k1 * b]]


def test_track_of_a_moving_target_equals_the_filter_in_matrices():
    """Over gaps without a sighting, at changing intervals; white acceleration adds q t^3 / 3, q t^2 / 2 and q t."""
    track, noise = Track(TrackConfig(range_noise=0.01, acceleration_mps2=0.5, give_up_s=5.0)), []
    axes = None
    for number in range(25):
        dt_s = (0.03, 0.05, 0.1)[number % 3]
        x_m, y_m = 1.0 + 0.004 * number, 0.3 - 0.003 * number + 0.001 * (number % 4)
        seen = number % 5 != 4
        noise = (0.01 * (x_m**2 + y_m**2)) ** 2
        track.step(dt_s, HERE, [at(x_m, y_m)] if seen else [])
        if axes is None:
            axes = [Matrices(x_m, noise, 0.5), Matrices(y_m, noise, 0.5)]
            continue
        for axis, position in zip(axes, (x_m, y_m), strict=True):
            axis.step(dt_s, position if seen else None, noise)
        target = track.target
        assert (target.x_m, target.vx_mps) == pytest.approx(axes[0].state, rel=1e-9)
        assert (target.y_m, target.vy_mps) == pytest.approx(axes[1].state, rel=1e-9)


def test_new_track_stands_still_where_it_was_seen():
    track = Track(TrackConfig())
    assert track.target is None
    assert track.step(DT_S, HERE, []) is None and track.target is None
    best = at(1.0, 0.2)
    assert track.step(DT_S, HERE, [best, at(2.0, 0.0)]) is best
    assert track.target == Target(1.0, 0.2, 0.0, 0.0, 0, 1)


def test_sightings_are_counted_and_the_time_without_one_is_measured():
    track = started((1.0, 0.0), (1.0, 0.0))
    assert (track.target.sightings, track.target.unseen_us) == (2, 0)
    track.step(0.1, HERE, [])
    track.step(0.05, HERE, [])
    assert (track.target.sightings, track.target.unseen_us) == (2, 150_000)
    track.step(0.1, HERE, [at(1.0)])
    assert (track.target.sightings, track.target.unseen_us) == (3, 0)


@pytest.mark.parametrize(("sigmas", "pushed"), [(2.999, False), (3.001, True)])
def test_sighting_three_sigma_off_means_a_push_and_more_variance(sigmas, pushed):
    """Off by three times the square root of twice the variance of both. Then the position counts almost whole."""
    noise = 0.01**2
    position = noise + 0.3**2 * DT_S**2 + 0.35**2 * DT_S**3 / 3
    both, velocity = 0.3**2 * DT_S + 0.35**2 * DT_S**2 / 2, 0.3**2 + 0.35**2 * DT_S
    off_m = sigmas * math.sqrt(2 * (position + noise))
    angle = 2 * math.asin(off_m / 2)  # as far from the lens, so that the noise is the same
    dx, dy = math.cos(angle) - 1, math.sin(angle)
    track = started((1.0, 0.0), (1 + dx, dy), range_noise=0.01, acceleration_mps2=0.35)
    noted, velocity = (2 * position + noise, velocity + 0.4**2) if pushed else (position, velocity)
    total = noted + noise
    gain, gain_velocity = noted / total, both / total
    assert (track.target.x_m, track.target.y_m) == pytest.approx((1 + gain * dx, gain * dy))
    assert (track.target.vx_mps, track.target.vy_mps) == pytest.approx((gain_velocity * dx, gain_velocity * dy))
    assert track._variance == pytest.approx((noted * noise / total, both * noise / total, velocity - both**2 / total))


# --- the gate ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("off_m", "inside"), [(0.349, True), (0.351, False)])
@pytest.mark.parametrize("direction", [(1, 0), (0, 1), (-0.6, 0.8)])
def test_sighting_beyond_the_gate_is_another_object(off_m, inside, direction):
    """0.35 m, and 1.5 m/s for the 0.1 s since the last sighting."""
    track = started((2.0, 0.0), gate_m=0.2)
    assert (track.step(DT_S, HERE, [at(2.0 + off_m * direction[0], off_m * direction[1])]) is not None) == inside


@pytest.mark.parametrize(("off_m", "inside"), [(0.749, True), (0.751, False)])
def test_gate_widens_with_the_time_without_a_sighting(off_m, inside):
    track = started((2.0, 0.0), gate_m=0.35, gate_growth_mps=1.0)
    for _ in range(3):
        track.step(DT_S, HERE, [])
    assert (track.step(DT_S, HERE, [at(2.0, off_m)]) is not None) == inside


def test_sighting_at_the_very_edge_of_the_gate_is_outside():
    track = started((2.0, 0.0), gate_m=0.25, gate_growth_mps=0.0)
    assert track.step(DT_S, HERE, [at(2.25, 0.0)]) is None


def test_nearest_sighting_in_the_gate_is_the_target():
    track = started((1.0, 0.0))
    near, nearer, far = at(1.0, 0.1), at(1.0, -0.05), at(1.0, 0.2)
    assert track.step(DT_S, HERE, [near, nearer, far]) is nearer


def test_gate_is_about_where_the_target_should_be_by_now():
    track = started(*((1.0 + 0.05 * number, 0.0) for number in range(12)), gate_m=0.1, gate_growth_mps=0.0)
    here = track.target.x_m + track.target.vx_mps * DT_S
    assert track.step(DT_S, HERE, [at(here + 0.099)]) is not None
    track = started(*((1.0 + 0.05 * number, 0.0) for number in range(12)), gate_m=0.1, gate_growth_mps=0.0)
    assert track.step(DT_S, HERE, [at(here - 0.101)]) is None


@pytest.mark.parametrize(("steps", "lost"), [(4, False), (5, True)])
def test_target_is_lost_when_it_was_unseen_for_longer_than_its_time(steps, lost):
    track = started((1.0, 0.0), give_up_s=0.4)
    for _ in range(steps):
        assert track.step(DT_S, HERE, []) is None
    assert (track.target is None) == lost


def test_target_is_lost_within_two_milliseconds_of_its_time():
    track = started((1.0, 0.0), give_up_s=0.4)
    for dt_s in (0.1, 0.1, 0.1, 0.1):
        track.step(dt_s, HERE, [])
    assert track.target is not None
    track.step(0.002, HERE, [])
    assert track.target is None


# --- the odometry frame ------------------------------------------------------------------------------------------


def test_point_about_the_robot_and_its_place_in_the_odometry_frame():
    """The robot at (1, 2) looks 0.6435 rad to the left: cosine 0.8, sine 0.6."""
    pose = (1.0, 2.0, math.atan2(0.6, 0.8))
    assert to_odometry(pose, 2.0, 1.0) == pytest.approx((1.0 + 1.6 - 0.6, 2.0 + 1.2 + 0.8))
    assert from_odometry(pose, 2.0, 4.0) == pytest.approx((2.0, 1.0))


def test_target_that_stands_still_does_not_move_with_the_robot():
    track = Track(TrackConfig(gate_m=0.05, gate_growth_mps=0.0))
    for number in range(10):
        pose = (0.1 * number, -0.05 * number, 0.2 * number)
        assert track.step(DT_S, pose, [at(*from_odometry(pose, 1.5, 0.4))]) is not None
    assert (track.target.x_m, track.target.y_m) == pytest.approx((1.5, 0.4))
    assert (track.target.vx_mps, track.target.vy_mps) == pytest.approx((0.0, 0.0), abs=1e-9)
