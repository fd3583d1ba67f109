"""Credit in virtual time: what is in flight, how old it gets, who owns the credit."""

import heapq
import random

import pytest

from sightline.protocol.messages import Holder
from sightline.robot_side.network.stream import Stream, StreamConfig

VISION, VIEWER = Holder(source="vision", session="0000bbbb"), Holder(source="viewer", session="0000cccc")
FRAME_US = 33_333


def run(*, seconds=10.0, leg_us=500, compute_us=2_000, loss=0.0, seed=1, fps_us=FRAME_US, config=None):
    """A camera, a link with one leg each way, and a peer with a newest-only slot; returns (ages, most in flight)."""
    stream, chance = Stream(config or StreamConfig()), random.Random(seed)
    events, ages, flying, most = [], [], set(), 0
    seq, slot, busy_until = 0, None, 0
    for now in range(0, round(seconds * 1e6), 1000):
        while events and events[0][0] <= now:
            _, kind, frame, t_us = heapq.heappop(events)
            if kind == "arrive":
                slot = (frame, t_us)
            else:
                flying -= {old for old in flying if old <= frame}
                stream.on_answer(VISION, frame, compute_us, now)
                ages.append(now - t_us)
        if slot and now >= busy_until:
            busy_until = now + compute_us
            if chance.random() >= loss:
                heapq.heappush(events, (busy_until + leg_us, "answer", *slot))
            slot = None
        if now % fps_us < 1000 and stream.may_capture(now, listening=True):
            stream.on_sent(seq, now, now)
            flying.add(seq)
            most = max(most, len(flying)) if now > 1_000_000 else 0  # after the first answers
            if chance.random() >= loss:
                heapq.heappush(events, (now + leg_us, "arrive", seq, now))
            seq += 1
    return ages, most, stream


def median(values):
    return sorted(values)[len(values) // 2]


def test_a_good_link_carries_every_frame():
    ages, most, _ = run()
    assert most == 1 and len(ages) >= 10 * 30 * 0.98 and median(ages) < 6_000


@pytest.mark.parametrize("compute_us", [60_000, 80_000, 200_000])
def test_a_slow_detector_gets_one_fresh_frame_at_a_time(compute_us):
    ages, most, stream = run(compute_us=compute_us)
    assert most == 1 and stream.window == 1
    assert max(ages[3:]) <= compute_us + 3_000, "nothing waits in a queue"


def test_a_long_link_widens_the_window_until_the_rate_is_back():
    ages, most, stream = run(leg_us=50_000)
    assert stream.window == 4 and most <= 4
    assert len(ages) >= 10 * 28 and median(ages) <= 106_000


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_loss_costs_credit_only_until_the_timeout(seed):
    ages, _, stream = run(loss=0.1, seed=seed)
    assert len(ages) >= 10 * 30 * 0.81 * 0.85
    assert stream.credit_timeouts > 0


def test_stream_without_a_listener_captures_nothing_and_without_answers_few():
    stream = Stream(StreamConfig())
    assert not stream.may_capture(0, listening=False)
    sent = 0
    for now in range(0, 5_000_000, 1000):
        if stream.may_capture(now, listening=True):
            stream.on_sent(sent, now, now)
            sent += 1
    assert 38 <= sent <= 42, "one per first timeout of 120 ms"
    assert stream.wait_us(5_000_000) <= 120_000


def test_a_link_longer_than_the_first_timeout_is_still_measured():
    ages, _, stream = run(leg_us=150_000)
    assert stream.window == 10 and len(ages) >= 10 * 28 * 0.85


def test_credit_belongs_to_the_driver():
    stream = Stream(StreamConfig())
    stream.on_sent(0, 0, 0)
    assert stream.on_answer(VIEWER, 0, 0, 1000), "with no driver, the first that acknowledges"
    stream.on_holder(VISION, 2000)
    stream.on_sent(1, 40_000, 40_000)
    assert not stream.on_answer(VIEWER, 1, 0, 41_000)
    assert stream.on_answer(VISION, 1, 0, 42_000)
    stream.on_sent(2, 80_000, 80_000)
    assert stream.on_answer(VIEWER, 2, 0, 2_000_000), "a silent owner loses it"


def test_rate_is_bounded_for_any_camera():
    stream, sent = Stream(StreamConfig(max_fps=10)), 0
    for now in range(0, 2_000_000, 1000):
        if stream.may_capture(now, listening=True):
            stream.on_sent(sent, now, now)
            stream.on_answer(VISION, sent, 0, now)
            sent += 1
    assert sent <= 23
    assert stream.fps(2_000_000) <= 12


@pytest.mark.parametrize("seed", range(40))
def test_stream_captures_again_after_any_events(seed):
    """Frames lost, late, answered out of order, by whom it may be, and changes of the holder: credit always returns."""
    chance, stream, sent, now = random.Random(seed), Stream(StreamConfig()), 0, 0
    for _ in range(400):
        now += chance.choice((1_000, 20_000, 90_000, 400_000))
        if stream.may_capture(now, listening=True):
            stream.on_sent(sent, now, now, chance.choice((0, 12_000, 48_000)))
            sent += 1
        for _ in range(chance.choice((0, 0, 1, 2))):
            who, seq = chance.choice((VISION, VIEWER)), chance.randrange(sent + 1)
            stream.on_answer(who, seq, chance.choice((0, 80_000)), now)
        if chance.random() < 0.05:
            stream.on_holder(chance.choice((VISION, VIEWER, None)), now)
    until = now + 3_000_000
    assert any(stream.may_capture(later, listening=True) for later in range(now, until, 10_000)), "it is stuck"


def test_slow_driver_does_not_inherit_the_timeout_of_a_quick_one():
    stream, sent, due, in_flight = Stream(StreamConfig()), 0, [], []
    for now in range(0, 6_000_000, 1000):
        who, takes_us = (VIEWER, 5_000) if now < 3_000_000 else (VISION, 300_000)
        if now == 3_000_000:
            stream.on_holder(VISION, now)
        while due and due[0][0] <= now:
            stream.on_answer(who, due.pop(0)[1], takes_us, now)
        if stream.may_capture(now, listening=True):
            stream.on_sent(sent, now, now)
            due.append((now + takes_us, sent))
            sent += 1
        if now >= 3_000_000:
            in_flight.append(len(due))
    assert max(in_flight) <= 4, "three until the first answer is measured, and what the quick one left"
