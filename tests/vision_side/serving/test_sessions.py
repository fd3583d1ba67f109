"""Whose frames count when several sessions claim one robot: restarts, late frames, forgeries, two robots of one id."""

import random

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import MAX_INTEGER, Stamp
from sightline.vision_side.serving.service import GOES_ON_US, KEPT, SILENT_US, SessionSelector

A, B, C = "0000aaaa", "0000bbbb", "0000cccc"
FRAME_US = 33_333


class Watch:
    """Plays frames of several robots, each with its own clock, at one `SessionSelector`."""

    def __init__(self):
        self.sessions = SessionSelector()
        self.now_us = 50_000_000

    def frame(self, session, late_us=0, seq=0):
        stamp = Stamp(session=session, seq=seq, t_us=self.now_us - late_us + int(session, 16))
        try:
            self.sessions.check(stamp, self.now_us)
        except WireError as error:
            self.reason = error.reason
            return False
        return True

    def film(self, *playing, seconds=1.0, every_us=FRAME_US):
        """Frames of all that play, side by side; the share of each that was admitted."""
        rounds, admitted = round(seconds * 1e6 / every_us), dict.fromkeys(playing, 0)
        for _ in range(rounds):
            self.now_us += every_us
            for session in playing:
                admitted[session] += self.frame(session)
        return [admitted[session] / rounds for session in playing]


@pytest.fixture
def watch():
    return Watch()


def test_restarted_robot_is_used_immediately(watch):
    assert watch.film(A) == [1.0]
    assert watch.film(B) == [1.0]
    assert watch.film(C) == [1.0]


def test_late_frames_from_before_a_restart_are_skipped(watch):
    watch.film(A)
    watch.film(B, seconds=0.1)
    for held_back_us in range(0, 500_000, 20_000):  # half a second of frames that the network held back, in one burst
        watch.now_us += 1_000
        assert not watch.frame(A, late_us=500_000 - held_back_us)
    assert watch.frame(B)


def test_late_frames_that_come_slowly_are_left_out_as_long_as_they_show_little_time(watch):
    watch.film(A)
    watch.film(B, seconds=0.1)
    for _ in range(20):
        watch.now_us += 50_000
        assert not watch.frame(A, late_us=watch.now_us - 50_000_000)  # all captured at one moment
    assert watch.frame(B)


@pytest.mark.parametrize("every_us", [FRAME_US, 120_000, 250_000, 499_000])
def test_one_forged_frame_costs_a_moment(watch, every_us):
    """A robot whose frames are not answered sends few of them; it is taken back all the same."""
    watch.film(A)
    assert watch.frame(B)
    lost = 0
    while not watch.frame(A):
        watch.now_us += every_us
        lost += 1
        assert lost < 20
    assert lost * every_us <= GOES_ON_US + every_us
    assert watch.film(A) == [1.0]


@pytest.mark.parametrize("per_frame", [1, 3, 40])
def test_forged_frames_of_ever_new_sessions_cost_no_more_than_one(watch, per_frame):
    watch.film(A)
    forged, lost, obeyed = random.Random(7), 0, 0
    for _ in range(300):
        for _ in range(per_frame):
            watch.now_us += FRAME_US // per_frame
            obeyed += watch.frame(f"{forged.getrandbits(32):08x}")
        lost += not watch.frame(A)
    assert lost <= GOES_ON_US / FRAME_US + 2
    assert per_frame > KEPT or obeyed <= per_frame * (GOES_ON_US / FRAME_US + 2)


def test_forged_frames_of_two_sessions_in_turn_do_not_keep_the_robot_out(watch):
    watch.film(A)
    watch.film(B, C, A, seconds=0.5)
    assert watch.film(A, B, C) == [1.0, 0.0, 0.0]


def test_first_of_two_robots_with_one_id_is_steered(watch):
    watch.film(A)
    share_a, share_b = watch.film(A, B, seconds=10)
    assert share_a > 0.95 and share_b < 0.05
    assert watch.film(A, B, seconds=10) == [1.0, 0.0]


@pytest.mark.parametrize("share", [1, 2])
def test_when_the_first_of_two_ends_the_second_is_steered(watch, share):
    watch.film(A)
    watch.film(A, B, seconds=2)
    later = watch.film(B, seconds=4.0)[0]
    assert 1 - later <= (SILENT_US + GOES_ON_US + 2 * FRAME_US) / 4e6
    assert watch.film(B, seconds=share) == [1.0]


def test_restarted_robot_after_a_dispute_waits_for_silence(watch):
    watch.film(A)
    watch.film(A, B, seconds=2)
    assert not watch.frame(C)
    watch.now_us += SILENT_US + 1
    assert watch.frame(C)
    assert watch.film(C) == [1.0]


@pytest.mark.parametrize("seed", range(5))
def test_at_most_one_session_is_admitted_within_the_time_to_change(watch, seed):
    draw, last = random.Random(seed), (0, "")
    for _ in range(2_000):
        watch.now_us += draw.choice([1_000, FRAME_US, 400_000])
        session = draw.choice([A, A, B, C, f"{draw.getrandbits(32):08x}"])
        if watch.frame(session):
            assert watch.sessions.current == session
            last = (watch.now_us, session)
    assert watch.sessions.current == last[1]


# --- time within a session ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("ahead_us", [600_000, 3_600_000_000, MAX_INTEGER - 2**40])
@pytest.mark.parametrize("times", [1, 100])
def test_forged_frames_of_the_future_cost_nothing(watch, ahead_us, times):
    watch.film(A)
    for _ in range(times):
        assert not watch.frame(A, late_us=-ahead_us)
        assert watch.reason is RejectReason.FROM_FUTURE
        assert watch.film(A, seconds=0.1) == [1.0]


@pytest.mark.parametrize("every_us", [FRAME_US, 120_000, 250_000])
def test_forged_first_frame_of_a_session_costs_less_than_a_second(watch, every_us):
    assert watch.frame(A, late_us=-3_600_000_000)
    lost = 0
    while not watch.frame(A):
        watch.now_us += every_us
        lost += 1
    assert 0 < lost * every_us <= 600_000 and watch.sessions.clock.replaced == 1
    assert watch.film(A) == [1.0]


@pytest.mark.parametrize("seq", [2_000, 2**52, MAX_INTEGER])
def test_forged_seq_of_the_future_costs_nothing(watch, seq):
    for number in range(100):
        watch.now_us += FRAME_US
        assert watch.frame(A, seq=number)
    assert not watch.frame(A, seq=seq)
    assert watch.frame(A, seq=101)


def test_frames_that_a_link_held_back_are_of_the_robot(watch):
    watch.film(A)
    watch.now_us += 4_000_000
    for late_us in range(3_990_000, 0, -10_000):
        assert watch.frame(A, late_us=late_us)


def test_session_that_began_on_a_stalled_link_is_used_again_within_half_a_second(watch):
    assert watch.frame(A, late_us=3_000_000)
    watch.film(A, seconds=0.4)
    assert watch.film(A) == [1.0]


@pytest.mark.parametrize("ppm", [-200, 200])
def test_clocks_of_different_pace_agree(watch, ppm):
    for _ in range(2_000):
        watch.now_us += 10_000_000
        assert watch.frame(A, late_us=watch.now_us * ppm // 1_000_000)
    assert not watch.frame(A, late_us=watch.now_us * ppm // 1_000_000 - 600_000)
