"""The track against a Kalman filter in matrices; its gate, its times and the other objects with numbers."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from sightline.vision_side.config import TrackConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.appearance import OTHER, difference
from sightline.vision_side.tracking.locate import Sighting
from sightline.vision_side.tracking.track import Target, Track, _are_in_line, from_odometry, to_odometry

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


def test_number_of_the_target_is_that_of_the_frame_in_which_it_was_chosen():
    track, numbers = Track(TrackConfig(give_up_s=0.25)), []
    shown = [[], [(1.0, 0.0)], [(1.0, 0.0), (2.0, 0.9)], [], [], [], [(2.0, 0.9)], [(2.0, 0.9), (1.0, 0.0)]]
    for number, places in enumerate(shown, 5):
        track.step(DT_S, HERE, [at(*one) for one in places], number)
        numbers.append(track.target and track.target.number)
    assert numbers == [None, 6, 6, 6, 6, None, 11, 11]


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
    variance = (noted * noise / total, both * noise / total, velocity - both**2 / total)
    assert track._followed.variance == pytest.approx(variance)


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


@pytest.mark.parametrize("hidden", [0, 3, 9])
@pytest.mark.parametrize(("share", "inside"), [(0.999, True), (1.001, False)])
def test_gate_widens_no_further_than_three_sigma(hidden, share, inside):
    """Sigma is that of place and sighting: 0.3 m/s and 0.35 m/s2 are those of a target that was seen once."""
    track, noise, hidden_s = started((2.0, 0.0), gate_m=0.2, gate_growth_mps=10.0), 0.032**2, DT_S * (hidden + 1)
    for _ in range(hidden):
        track.step(DT_S, HERE, [])
    sigma_m = math.sqrt(2 * noise + 0.3**2 * hidden_s**2 + 0.35**2 * hidden_s**3 / 3)
    place = about(share * (0.2 + 3 * sigma_m))
    assert (track.step(DT_S, HERE, [at(*place)]) is not None) == inside


@pytest.mark.parametrize(("fps", "hidden_s", "off_m"), [(30, 0.4, 0.8), (30, 1.1, 1.4), (60, 0.7, 1.0), (5, 0.6, 1.1)])
def test_twin_that_appears_far_from_the_target_while_that_is_hidden_is_not_the_target(fps, hidden_s, off_m):
    track, dt_s = Track(TrackConfig()), 1 / fps
    for _ in range(3 * fps):
        assert track.step(dt_s, HERE, [at(*TARGET)]) is not None
    for frame in range(round(hidden_s * fps)):
        assert track.step(dt_s, HERE, [at(2.0, off_m)] if frame >= hidden_s * fps / 2 else []) is None
    for _ in range(fps):
        seen = track.step(dt_s, HERE, [at(2.0, off_m), at(*TARGET)])
        assert seen is not None and seen.y_m == 0.0


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


@pytest.mark.parametrize(("give_up_s", "gap_s", "sightings"), [
    (0.4, 0.5, 3), (0.4, 0.503, 1), (1.2, 1.199, 3), (1.2, 1.201, 1), (1.2, 8.0, 1),
])
def test_target_is_lost_in_a_gap_between_frames_that_is_longer_than_its_time(give_up_s, gap_s, sightings):
    """Its gate is wide then. A stream of two frames a second has no gaps."""
    track = started((1.0, 0.0), (1.0, 0.0), give_up_s=give_up_s)
    assert track.step(gap_s, HERE, [at(1.0)]) is not None
    assert track.target.sightings == sightings


def test_gap_before_the_first_target_changes_nothing():
    track = Track(TrackConfig())
    assert track.step(8.0, HERE, []) is None and track.target is None


# --- beside other objects ----------------------------------------------------------------------------------------

TARGET = (2.0, 0.0)


def beside(*others, frames=5, **config):
    """Return a track of a target and other objects that stand still, each seen in so many frames."""
    track = Track(TrackConfig(**config))
    for _ in range(frames):
        assert track.step(DT_S, HERE, [at(*TARGET), *(at(*place) for place in others)]).x_m == 2.0
    return track


def others(track):
    return sorted((one.state.x_m, one.state.y_m) for one in track._others)


def steps_until(track, happens, *places, most=100):
    """Return the number of steps with these sightings until `happens(sighting)`."""
    return next(number for number in range(1, most) if happens(track.step(DT_S, HERE, [at(*one) for one in places])))


@pytest.mark.parametrize(("frames", "is_other"), [(1, False), (2, True), (5, True)])
def test_sighting_of_an_object_that_was_seen_beside_the_target_again_is_not_of_the_target(frames, is_other):
    track = started(*[TARGET] * 3)
    for _ in range(frames):
        track.step(DT_S, HERE, [at(*TARGET), at(2.0, 0.2)])
    seen = track.step(DT_S, HERE, [at(2.0, 0.2)])
    assert (seen is None) == is_other and track.target.unseen_us == is_other * 100_000


@pytest.mark.parametrize(("dt_s", "known", "is_other"), [
    (0.5, 5, True), (0.2, 5, True), (0.1, 5, True), (0.09, 5, True), (0.0899, 5, False), (0.033, 9, False),
    (0.2, 4, False),
])
@pytest.mark.parametrize("aside_m", [-0.3, 0.25])
def test_object_of_a_slow_stream_that_was_seen_once_beside_a_known_target_does_not_take_its_place(
    dt_s, known, is_other, aside_m
):
    """It comes nearer by a third and hides the target. A target of few sightings may be the error of a detector."""
    for more in ([], [at(2.0, 0.9)]):
        track = Track(TrackConfig())
        for _ in range(known - 1):
            track.step(dt_s, HERE, [at(*TARGET), *more])
        assert track.step(dt_s, HERE, [at(*TARGET), at(1.9, aside_m), *more]).x_m == 2.0
        assert (track.step(dt_s, HERE, [at(1.9, aside_m * 2 / 3), *more]) is None) == is_other
        assert (track.target.unseen_us > 0) == is_other


def test_object_that_was_seen_once_while_the_target_was_hidden_is_not_beside_it():
    track = started(*[TARGET] * 6, gate_growth_mps=0.0)
    assert track.step(DT_S, HERE, [at(2.0, 0.5)]) is None
    assert track.step(DT_S, HERE, [at(2.0, 0.34)]) is not None


def test_object_that_was_seen_twice_beside_the_target_and_then_alone_is_not_followed_after_the_loss():
    track = beside((2.0, 0.9), frames=2, give_up_s=0.4)
    assert steps_until(track, lambda _: track.target is None, (2.0, 0.9)) == 5
    assert steps_until(track, lambda seen: seen, (2.0, 0.9)) == 31


def test_object_that_appears_while_the_target_is_hidden_may_be_the_target():
    track = started(*[TARGET] * 6, gate_growth_mps=0.0)
    for _ in range(6):
        assert track.step(DT_S, HERE, [at(2.0, 0.5)]) is None
    assert track.step(DT_S, HERE, [at(2.0, 0.3)]).y_m == 0.3


def test_object_that_appeared_while_the_target_was_hidden_succeeds_it_at_once_with_its_speed():
    track = started(*[TARGET] * 6, gate_growth_mps=0.0, give_up_s=0.75)
    for number in range(8):
        assert track.step(DT_S, HERE, [at(2.0, 0.5 + 0.02 * number)]) is None
    assert track.target is None
    assert track.step(DT_S, HERE, [at(2.0, 0.66)]) is not None
    assert track.target.sightings == 9 and track.target.vy_mps == pytest.approx(0.2, abs=0.05) and not others(track)


def test_object_that_is_hidden_while_the_target_is_seen_was_not_seen_beside_it():
    track = started(*[TARGET] * 6, gate_growth_mps=0.0)
    for _ in range(6):
        track.step(DT_S, HERE, [at(2.0, 0.5)])
    assert track.step(DT_S, HERE, [at(*TARGET)]) is not None
    assert track.step(DT_S, HERE, [at(2.0, 0.34)]) is not None


def test_sighting_of_the_target_far_from_its_place_adds_no_object():
    track = started(*[TARGET] * 20, range_noise=0.05)
    assert track.step(DT_S, HERE, [at(2.0, 0.3)]) is not None
    assert track.target.y_m < 0.15 and not others(track)


def test_object_beside_the_last_target_is_followed_three_seconds_after_its_loss():
    track = beside((2.0, 0.5), give_up_s=0.4)
    assert steps_until(track, lambda _: track.target is None, (2.0, 0.5)) == 5
    assert steps_until(track, lambda seen: seen, (2.0, 0.5)) == 31
    assert track.target.y_m == pytest.approx(0.5)


@pytest.mark.parametrize(("gap_s", "sightings"), [(2.99, None), (3.01, 1)])
def test_object_beside_the_last_target_is_forgotten_in_a_gap_of_three_seconds(gap_s, sightings):
    track = beside((2.0, 0.5))
    track.step(gap_s, HERE, [at(2.0, 0.5)])
    assert (track.target and track.target.sightings) == sightings


def test_object_elsewhere_is_followed_at_once_also_while_the_others_are_hidden():
    track = beside((2.0, 0.5), give_up_s=0.4)
    steps_until(track, lambda _: track.target is None, (2.0, 0.5))
    assert track.step(DT_S, HERE, [at(1.0, -0.9)]).y_m == -0.9


def test_best_sighting_that_is_of_no_such_object_is_followed_first():
    track = beside((2.0, 0.5), give_up_s=0.4)
    steps_until(track, lambda _: track.target is None, (2.0, 0.5))
    assert track.step(DT_S, HERE, [at(2.0, 0.5), at(1.0, -0.9), at(1.0, -0.5)]).y_m == -0.9
    assert others(track) == [(1.0, -0.5), pytest.approx((2.0, 0.5))]


def lost_beside(place, hidden):
    """Return a track that lost its target, and whose other object was not seen for so many frames either."""
    track = beside(place, frames=20, give_up_s=0.4)
    for _ in range(hidden):
        track.step(DT_S, HERE, [])
    assert track.target is None
    return track


@pytest.mark.parametrize(("hidden", "y_m"), [(5, 0.45), (5, -0.5), (8, 0.6), (15, -1.1)])
def test_lost_target_that_is_seen_again_at_its_place_is_followed_though_the_other_is_hidden(y_m, hidden):
    """The other one could be there by now, but not as well."""
    track = lost_beside((2.0, y_m), hidden)
    assert track.step(DT_S, HERE, [at(*TARGET)]) is not None
    assert (track.target.sightings, others(track)) == (1, [pytest.approx((2.0, y_m))])


@pytest.mark.parametrize("hidden", [8, 15])
def test_sighting_between_a_lost_target_and_the_other_is_of_neither_until_the_other_is_seen(hidden):
    track = lost_beside((2.0, 0.5), hidden)
    for _ in range(3):
        assert track.step(DT_S, HERE, [at(2.0, 0.25)]) is None
        assert others(track) == [pytest.approx((2.0, 0.5))]
    assert track.step(DT_S, HERE, [at(2.0, 0.52), at(2.0, 0.22)]).y_m == 0.22


def test_other_object_is_followed_three_seconds_after_the_loss_though_the_target_could_be_there():
    track = lost_beside((2.0, 0.5), 5)
    assert steps_until(track, lambda seen: seen, (2.0, 0.5)) == 31


def look(share):
    """Return a look that differs by so much from that of a target with look(0)."""
    looks = np.zeros(64, np.float32)
    looks[:2] = 1 - share, math.sqrt(1 - (1 - share) ** 2)
    return looks


def lost(of):
    """Return a track that has just lost a target with this look, which was seen alone."""
    track = Track(TrackConfig(give_up_s=0.4))
    for _ in range(6):
        assert track.step(DT_S, HERE, [at(*TARGET, look=of)]) is not None
    assert steps_until(track, lambda _: track.target is None) == 5
    return track


@pytest.mark.parametrize(("of", "shown", "steps"), [
    (look(0.0), look(0.0), 1), (look(0.0), look(OTHER - 0.01), 1), (look(0.0), look(OTHER + 0.01), 31),
    (look(0.0), look(1.0), 31), (None, look(1.0), 1), (look(0.0), None, 1),
])
def test_object_of_another_look_is_followed_three_seconds_after_the_loss(of, shown, steps):
    track = lost(of)
    taken = (number for number in range(1, 99) if track.step(DT_S, HERE, [at(1.0, -0.9, look=shown)]))
    assert next(taken) == steps


def test_object_that_looks_as_the_lost_target_is_followed_and_not_the_best_one():
    track, places = lost(look(0.0)), [at(1.0, -0.9, look=look(0.9)), at(1.0, 0.9, look=look(0.2))]
    assert track.step(DT_S, HERE, places) is places[1]


@pytest.mark.parametrize(("unlike", "hidden", "off_m", "is_target"), [
    (1.0, 0, 0.149, True), (1.0, 0, 0.151, False), (1.0, 2, 0.149, True), (1.0, 2, 0.3, False), (1.0, 3, 0.0, False),
    (OTHER + 0.01, 0, 0.3, False), (OTHER - 0.01, 0, 0.3, True), (OTHER + 0.01, 3, 0.0, False),
    (OTHER - 0.01, 3, 0.3, True), (0.0, 8, 0.3, True),
])  # fmt: skip
def test_object_of_another_look_is_the_target_only_at_its_place_and_within_300_ms(unlike, hidden, off_m, is_target):
    track = Track(TrackConfig())
    track.step(DT_S, HERE, [at(*TARGET, look=look(0.0))])
    for _ in range(hidden):
        assert track.step(DT_S, HERE, []) is None
    assert (track.step(DT_S, HERE, [at(2.0, off_m, look=look(unlike))]) is not None) == is_target


def test_object_that_looks_as_the_target_did_comes_before_one_of_another_look_at_its_place():
    track = Track(TrackConfig())
    for _ in range(6):
        track.step(DT_S, HERE, [at(*TARGET, look=look(0.0))])
    for _ in range(20):
        assert track.step(DT_S, HERE, [at(1.9, 0.0, look=look(0.8))]) is not None
    places = [at(1.9, 0.0, look=look(0.8)), at(1.9, 0.3, look=look(0.3))]
    assert track.step(DT_S, HERE, places) is places[1]


@pytest.mark.parametrize(("steps", "seen"), [(30, "old"), (31, "new")])
@pytest.mark.parametrize("between", [None, look(0.8)])
def test_another_look_at_the_place_of_the_target_is_its_own_after_three_seconds(steps, seen, between):
    """A frame without a look changes nothing."""
    track = Track(TrackConfig())
    track.step(DT_S, HERE, [at(*TARGET, look=look(0.0))])
    for number in range(steps):
        assert track.step(DT_S, HERE, [at(*TARGET, look=between if number < steps - 1 else look(0.8))]) is not None
    places = {"old": at(2.0, 0.2, look=look(0.0)), "new": at(2.0, -0.2, look=look(0.8))}
    assert track.step(DT_S, HERE, list(places.values())) is places[seen]


def test_three_seconds_of_another_look_count_from_the_last_frame_with_the_own_one():
    track = Track(TrackConfig())
    for number in range(60):
        track.step(DT_S, HERE, [at(*TARGET, look=look(0.0 if number in (0, 25) else 0.8))])
        assert difference(track._followed.look, look(0.8)) == pytest.approx(0.8 if number < 56 else 0.0, abs=1e-6)


def test_look_of_the_target_follows_the_light():
    track = Track(TrackConfig(give_up_s=0.4))
    for number in range(40):
        assert track.step(DT_S, HERE, [at(*TARGET, look=look(number / 40))]) is not None
    assert 0.001 < difference(track._followed.look, look(39 / 40)) < OTHER, "more slowly"
    steps_until(track, lambda _: track.target is None)
    assert track.step(DT_S, HERE, [at(*TARGET, look=look(0.0))]) is None
    assert track.step(DT_S, HERE, [at(*TARGET, look=look(1.0))]) is not None


@pytest.mark.parametrize(("y_m", "is_followed"), [(0.625, False), (0.626, True)])
def test_part_of_an_object_beside_the_last_target_is_not_followed_either(y_m, is_followed):
    track = beside((2.0, 0.5), give_up_s=0.4, apart_m=0.125)
    steps_until(track, lambda _: track.target is None, (2.0, 0.5))
    assert (track.step(DT_S, HERE, [at(2.0, 0.5), at(2.0, y_m)]) is not None) == is_followed


def test_time_since_the_loss_counts_from_the_last_loss():
    track = beside((2.0, 0.5), give_up_s=0.4)
    for most in (2, 31):
        steps_until(track, lambda _: track.target is None, (2.0, 0.5))
        for _ in range(most - 1):
            assert track.step(DT_S, HERE, [at(2.0, 0.5)]) is None
        assert track.step(DT_S, HERE, [at(*TARGET), at(2.0, 0.5)]) is not None


def nearer(aside_m):
    """Return a place so far from the ray to the target."""
    return 1.0, aside_m


def further(aside_m):
    """Return a place to which the ray is so far from the target."""
    angle = math.asin(aside_m / 2)
    return 3 * math.cos(angle), 3 * math.sin(angle)


@pytest.mark.parametrize(("aside_m", "frames", "range_noise", "is_inexact"), [
    (0.149, 5, 0.008, True), (0.151, 5, 0.008, False), (0.149, 4, 0.008, False), (0.149, 5, 0.05, False),
])  # fmt: skip
@pytest.mark.parametrize("place", [nearer, further])
@pytest.mark.parametrize("side", [1, -1])
def test_sighting_in_line_with_a_known_object_is_less_exact(place, side, aside_m, frames, range_noise, is_inexact):
    track = beside(place(side * aside_m), frames=frames, range_noise=range_noise, acceleration_mps2=0.35)
    position, both, velocity = track._followed.variance
    predicted = position + DT_S * (2 * both + DT_S * velocity) + 0.35**2 * DT_S**3 / 3
    turned = (0.0, 0.0, 0.5)
    track.step(DT_S, turned, [at(*from_odometry(turned, *one)) for one in ((2.01, 0.0), place(side * aside_m))])
    noise_m2 = 0.15**2 if is_inexact else (range_noise * 2.01**2) ** 2
    assert track.target.x_m == pytest.approx(2.0 + 0.01 * predicted / (predicted + noise_m2), rel=1e-9)


def test_objects_are_in_line_as_seen_from_the_robot():
    track, moved = beside((1.0, 0.0)), beside((1.0, 0.0))
    track.step(DT_S, HERE, [at(2.01, 0.0), at(1.0, 0.0)])
    # From here the target is 1 m ahead and the other object 1 m to the left.
    moved.step(DT_S, (2.0, -1.0, math.pi / 2), [at(1.0, -0.01), at(1.0, 1.0)])
    assert moved.target.x_m - 2.0 > 2 * (track.target.x_m - 2.0) > 0


def test_object_behind_the_robot_is_not_in_line():
    ahead, behind = beside((1.0, 0.0)), beside((-1.0, 0.0))
    ahead.step(DT_S, HERE, [at(2.01, 0.0), at(1.0, 0.0)])
    behind.step(DT_S, HERE, [at(2.01, 0.0)])
    assert behind.target.x_m - 2.0 > 2 * (ahead.target.x_m - 2.0) > 0


@pytest.mark.parametrize(("one", "other", "apart_m", "is_in_line"), [
    ((2.0, 0.0), (0.0, 0.1), 0.15, False), ((0.8, 0.0), (0.5, 0.0), 0.15, True), ((0.8, 0.0), (-0.5, 0.0), 0.15, False),
    ((1.0, 1.0), (2.0, 2.0), 0.15, True), ((1.0, -2.0), (2.0, -4.0), 0.15, True), ((0.1, -0.5), (2.0, 0.2), 0.6, True),
])
def test_only_objects_on_the_same_side_of_the_robot_are_in_line(one, other, apart_m, is_in_line):
    assert _are_in_line(one, other, apart_m) is _are_in_line(other, one, apart_m) is is_in_line


def test_objects_just_as_far_apart_as_objects_can_be_are_not_in_line():
    moved = []
    for apart_m in (0.25, 0.26):
        track = beside((1.0, 0.25), apart_m=apart_m)
        track.step(DT_S, HERE, [at(2.01, 0.0), at(1.0, 0.25)])
        moved.append(track.target.x_m - 2.0)
    assert moved[0] > 2 * moved[1] > 0


@pytest.mark.parametrize("seed", range(12))
def test_target_stays_the_same_while_others_cross_and_hide_it(seed):
    """One crosses between robot and target, one behind the target; what is behind another one is hidden."""
    draw = random.Random(seed)
    side, near_m, far_m = draw.choice((-1, 1)), draw.uniform(0.9, 1.4), draw.uniform(2.4, 3.0)
    speeds = [draw.uniform(-0.2, 0.2), side * draw.uniform(0.3, 0.8), -side * draw.uniform(0.2, 0.5)]
    starts = [(2.0, 0.0), (near_m, -side * 0.9), (far_m, side * 0.9)]
    track = Track(TrackConfig())
    for frame in range(120):
        now = [(x_m, y_m + speed * max(0, frame - 15) / 30) for (x_m, y_m), speed in zip(starts, speeds, strict=True)]
        shown = [one for one in now if not any(
            other[0] < one[0] and abs(other[1] / other[0] - one[1] / one[0]) < 0.1 / other[0] for other in now)]
        sightings = [at(x_m + draw.gauss(0, 0.01), y_m + draw.gauss(0, 0.005)) for x_m, y_m in shown]
        if frame:
            draw.shuffle(sightings)
        seen = track.step(1 / 30, HERE, sightings)
        assert seen is None or abs(seen.x_m - 2.0) < 0.1
        assert (seen is not None) == (now[0] in shown) or frame < 5
    assert (track.target.x_m, track.target.y_m) == pytest.approx(now[0], abs=0.05)


def spread_m2(one, range_noise):
    """Return the variance of a sighting at 2 m in the next step: of the prediction and, in bounds, of the sighting."""
    position, both, velocity = one.variance
    predicted = position + DT_S * (2 * both + DT_S * velocity) + 0.35**2 * DT_S**3 / 3
    return predicted + min(max((range_noise * 4.0) ** 2, 0.05**2), 0.15**2)


def about(chord_m):
    """Return a place as far from the robot as the target is, and so far from the target."""
    angle = 2 * math.asin(chord_m / 4)
    return 2 * math.cos(angle), 2 * math.sin(angle)


def pair(chord_m, *, hidden=0, range_noise=0.05, **config):
    """Return a track of a target and another object that came so near, after some frames without the target."""
    config = {"acceleration_mps2": 0.35, "apart_m": 0.0, "gate_m": 1.0, **config}
    track = beside(about(0.9), frames=20, range_noise=range_noise, **config)
    for _ in range(hidden):
        track.step(DT_S, HERE, [at(*about(0.9))])
    (other,) = track._others
    x_m, y_m = about(chord_m)
    other.state = replace(other.state, x_m=x_m, y_m=y_m)
    return track


@pytest.mark.parametrize(("share", "in_doubt"), [(0.999, True), (1.001, False)])
@pytest.mark.parametrize(("shown", "hidden"), [("both", 0), ("target", 0), ("other", 0), ("other", 2)])
@pytest.mark.parametrize("range_noise", [0.05, 0.025, 0.008])
def test_objects_that_could_be_exchanged_at_odds_of_seven_to_one_are_both_left(
    shown, hidden, range_noise, share, in_doubt
):
    """By the likelihoods of the places: d^2 / s + 2 ln s of the wrong one, `d` apart, and 2 ln s of the right one."""
    apart = pair(0.9, hidden=hidden, range_noise=range_noise)
    of_target, of_other = spread_m2(apart._followed, range_noise), spread_m2(apart._others[0], range_noise)
    places = 2 if shown == "both" else 1
    chord_m = share * math.sqrt(of_target * (4 - 2 * math.log(of_target / of_other)) / places)
    track = pair(chord_m, hidden=hidden, range_noise=range_noise)
    shown_at = {"both": [TARGET, about(chord_m)], "target": [TARGET], "other": [about(chord_m)]}[shown]
    seen = track.step(DT_S, HERE, [at(*one) for one in shown_at])
    (other,) = track._others
    assert (seen is None) == (in_doubt or shown == "other")
    assert track.target.unseen_us == (100_000 * (hidden + 1) if seen is None else 0)
    assert other.state.unseen_us == (100_000 if in_doubt or shown == "target" else 0)


@pytest.mark.parametrize(("unlike", "in_doubt"), [(0.0, True), (0.1665, True), (0.1669, False), (1.0, False)])
def test_objects_of_other_looks_are_not_exchanged_where_they_meet(unlike, in_doubt):
    """Looks that differ by a sixth have the same odds of 7 to 1: 12 / 6 for each of the two sightings."""
    track = pair(0.001)
    (other,) = track._others
    track._followed.look, other.look = look(0.0), look(unlike)
    places = [at(*TARGET, look=look(0.0)), at(*about(0.001), look=look(unlike))]
    assert track.step(DT_S, HERE, places) is (None if in_doubt else places[0])
    assert other.state.unseen_us == in_doubt * 100_000


@pytest.mark.parametrize(("gate_m", "in_doubt"), [(0.21, True), (0.19, False)])
def test_no_object_is_exchanged_with_one_beyond_its_gate(gate_m, in_doubt):
    track = pair(0.2, gate_m=gate_m, gate_growth_mps=0.0)
    assert (track.step(DT_S, HERE, [at(*TARGET), at(*about(0.2))]) is None) == in_doubt


def test_objects_are_exchanged_only_if_each_is_in_the_gate_of_the_other():
    """That of the target has grown while it was hidden."""
    places = [at(*TARGET), at(*about(0.22))]
    assert pair(0.22, hidden=2, gate_m=0.1, gate_growth_mps=1.3).step(DT_S, HERE, places) is None
    assert pair(0.22, hidden=2, gate_m=0.1, gate_growth_mps=1.0).step(DT_S, HERE, places) is not None


def test_object_that_is_not_known_yet_causes_no_doubt():
    track = started(*[TARGET] * 20, range_noise=0.05, gate_m=1.0)
    for _ in range(4):
        assert track.step(DT_S, HERE, [at(*TARGET), at(*about(0.2))]) is not None


def test_target_that_was_in_doubt_for_half_a_second_is_lost_and_neither_is_followed():
    track = pair(0.2, give_up_s=5.0)
    places = [at(*TARGET), at(*about(0.2))]
    for _ in range(2):
        for _ in range(5):
            assert track.step(DT_S, HERE, places) is None
        assert track.target is not None
        track.step(1e-6, HERE, places)
        assert track.target is None and len(others(track)) == 2
        for _ in range(30):
            assert track.step(DT_S, HERE, places) is None
        assert track.step(1e-6, HERE, places) is places[0]
        assert len(others(track)) == 1


def test_target_that_was_lost_in_doubt_goes_on_as_one_of_the_others():
    track = pair(0.2, give_up_s=5.0)
    for dt_s, places in [(DT_S, [at(*TARGET), at(*about(0.2))])] * 6 + [(DT_S, [])] * 4:
        track.step(dt_s, HERE, places)
    assert track.target is None
    assert [one.state.unseen_us for one in track._others] == [1_000_000] * 2


def test_time_in_doubt_counts_from_the_last_frame_without():
    track = pair(0.2, give_up_s=5.0)
    for _ in range(2):
        for _ in range(5):
            assert track.step(DT_S, HERE, [at(*TARGET), at(*about(0.2))]) is None
        track.step(DT_S, HERE, [])
    assert track.target is not None


@pytest.mark.parametrize(("frames", "steps"), [(4, 3), (5, 30)])
def test_object_without_sightings_is_forgotten_after_three_seconds_or_soon_if_hardly_seen(frames, steps):
    track = beside((2.0, 0.5), frames=frames)
    for _ in range(steps):
        track.step(DT_S, HERE, [at(*TARGET)])
    assert others(track)
    track.step(1e-6, HERE, [at(*TARGET)])
    assert not others(track)


def test_object_is_known_again_where_it_was_forgotten():
    track = beside((2.0, 0.5))
    assert steps_until(track, lambda _: not others(track), TARGET) == 31
    track.step(DT_S, HERE, [at(*TARGET), at(2.0, 0.5)])
    assert others(track) == [(2.0, 0.5)]


@pytest.mark.parametrize(("place", "count"), [
    ((2.0, 0.15), 1), ((2.0, 0.151), 2), ((2.0, 0.651), 1), ((2.0, 0.653), 2),
])
def test_sighting_within_15_cm_of_an_object_adds_no_object(place, count):
    track = beside((2.0, 0.5), gate_m=0.1)
    track.step(DT_S, HERE, [at(*TARGET), at(2.0, 0.502), at(*place)])
    assert len(others(track)) == count


def test_part_of_the_target_is_not_the_object_that_was_hidden_beside_it():
    """It is as far as is configured, or further."""
    for place, unseen_us in (((2.0, 0.25), 200_000), ((2.0, 0.251), 0)):
        track = beside((2.0, 0.5), apart_m=0.25)
        track.step(DT_S, HERE, [at(*TARGET)])
        assert track.step(DT_S, HERE, [at(*TARGET), at(*place)]) is not None
        assert [one.state.unseen_us for one in track._others] == [unseen_us]


@pytest.mark.parametrize(("y_m", "is_part"), [(0.199, True), (0.2, False)])
@pytest.mark.parametrize("is_seen", [True, False])
def test_object_that_comes_nearer_to_the_target_than_objects_can_is_a_part_of_it(y_m, is_part, is_seen):
    track = pair(0.5, apart_m=0.2, gate_m=0.1, gate_growth_mps=0.0)
    track._others[0].state = replace(track._others[0].state, x_m=2.0, y_m=y_m)
    assert (track.step(DT_S, HERE, [at(*TARGET)] if is_seen else []) is not None) == is_seen
    assert (not others(track)) == (is_part and is_seen)


def test_at_most_sixteen_objects_are_tracked_beside_the_target():
    track = beside(*((2.0, 0.3 * number) for number in range(1, 20)))
    assert len(others(track)) == 16


def test_others_move_with_their_own_speed_while_they_are_hidden():
    track = started(*[TARGET] * 3)
    for number in range(10):
        track.step(DT_S, HERE, [at(*TARGET), at(3.0, -1.0 + 0.05 * number)])
    for _ in range(10):
        assert track.step(DT_S, HERE, [at(*TARGET)]) is not None
    ((x_m, y_m),) = others(track)
    assert (x_m, y_m) == (pytest.approx(3.0), pytest.approx(-0.05, abs=0.1))


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
