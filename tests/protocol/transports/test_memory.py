"""The network in memory: its delays, losses and bursts match the settings, and repeat in every run."""

import statistics
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.channels import FRAME, STATUS, TWIST, Direction
from sightline.protocol.transports.memory import MAX_IN_FLIGHT, Leg, MemoryNetwork

pytestmark = pytest.mark.computes

FRAME_US = 33_333


def _run(network: MemoryNetwork, frames: int, status_every: int = 0) -> list[tuple[int, int, str]]:
    """Return (arrival, number, channel) of each received message; the peer answers each frame with a twist."""
    robot, vision = network.link("r1"), network.link("r1", "vision")
    heard: list[tuple[int, int, str]] = []

    def answer(message):
        heard.append((network.now_us, int(message.payload), "frame"))
        vision.publish(TWIST, b"", message.payload + b"|0")

    vision.subscribe(FRAME, answer)
    vision.subscribe(STATUS, lambda message: None)
    robot.subscribe(TWIST, lambda message: heard.append((network.now_us, int(message.payload[:-2]), "twist")))
    for number in range(frames):
        network.advance(number * FRAME_US)
        robot.publish(FRAME, b"", b"%d" % number)
        if status_every and number % status_every == 0:
            robot.publish(STATUS, b"", b"{}")
    network.advance(frames * FRAME_US + 60_000_000)
    return heard


@given(st.integers(0, 2**32), st.integers(0, 400_000), st.integers(0, 50_000), st.floats(0, 0.9), st.floats(1, 9))
@settings(max_examples=40)
def test_a_run_repeats_bit_for_bit(seed, delay_us, jitter_us, loss, burst):
    burst = max(burst, loss / (1 - loss) + 0.01) if burst > 1 else burst
    runs = [_run(MemoryNetwork(seed, delay_us, jitter_us, loss, burst=burst), 40) for _ in range(2)]
    assert runs[0] == runs[1]


def test_another_seed_loses_other_frames():
    lost = [tuple(number for _, number, _ in _run(MemoryNetwork(seed, loss=0.3), 60)) for seed in range(5)]
    assert len(set(lost)) == 5


def test_added_latency_is_halved_between_the_legs():
    for delay_us in (0, 1, 50_000, 200_001):
        heard = _run(MemoryNetwork(delay_us=delay_us), 30)
        sent_us = {number: number * FRAME_US for number in range(30)}
        out = {arrival - sent_us[number] for arrival, number, channel in heard if channel == "frame"}
        back = {arrival - sent_us[number] for arrival, number, channel in heard if channel == "twist"}
        assert out == {delay_us - delay_us // 2}
        assert back == {delay_us}


@given(st.integers(0, 2**32), st.integers(0, 200_000), st.integers(1, 200_000))
@settings(max_examples=30)
def test_jitter_stays_in_its_bounds_and_keeps_the_order(seed, delay_us, jitter_us):
    run = _run(MemoryNetwork(seed, delay_us, jitter_us), 60)
    heard = [(arrival, number) for arrival, number, channel in run if channel == "frame"]
    assert [number for _, number in heard] == list(range(60))
    leg_delay_us, leg_jitter_us = delay_us - delay_us // 2, jitter_us - jitter_us // 2
    assert all(leg_delay_us <= arrival - number * FRAME_US <= leg_delay_us + leg_jitter_us for arrival, number in heard)


@pytest.mark.parametrize("burst", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("loss", [0.02, 0.1, 0.4])
def test_loss_and_bursts_match_the_request(loss, burst):
    network = MemoryNetwork(3, loss=loss, burst=burst)
    numbers = [number for _, number, channel in _run(network, 20_000) if channel == "frame"]
    gaps = [after - before - 1 for before, after in pairwise(numbers) if after - before > 1]
    assert network.dropped["FROM_ROBOT"] == 20_000 - len(numbers)
    assert network.dropped["FROM_ROBOT"] / network.sent["FROM_ROBOT"] == pytest.approx(loss, rel=0.25)
    assert network.dropped["TO_ROBOT"] / network.sent["TO_ROBOT"] == pytest.approx(loss, rel=0.25)
    expected = burst if burst > 1 else 1 / (1 - loss)
    assert statistics.mean(gaps) == pytest.approx(expected, rel=0.2)


def test_legs_lose_independently():
    heard = _run(MemoryNetwork(4, loss=0.3), 20_000)
    frames = {number for _, number, channel in heard if channel == "frame"}
    twists = {number for _, number, channel in heard if channel == "twist"}
    assert len(frames) / 20_000 == pytest.approx(0.7, abs=0.02)
    assert len(twists) / len(frames) == pytest.approx(0.7, abs=0.02)


def test_other_traffic_does_not_change_which_frames_are_lost():
    alone = [item for item in _run(MemoryNetwork(9, 50_000, 9_000, 0.2), 300) if item[2] == "frame"]
    busy = [item for item in _run(MemoryNetwork(9, 50_000, 9_000, 0.2), 300, status_every=2) if item[2] == "frame"]
    assert alone == busy


def test_each_direction_may_have_its_own_leg():
    legs = {Direction.FROM_ROBOT: Leg(delay_us=10_000), Direction.TO_ROBOT: Leg(loss=1.0)}
    network = MemoryNetwork(legs=legs)
    heard = _run(network, 20)
    assert {(arrival - number * FRAME_US, channel) for arrival, number, channel in heard} == {(10_000, "frame")}
    assert network.dropped == {"TO_ROBOT": 20}


def test_messages_in_flight_are_bounded_and_overflow_returns_false():
    network = MemoryNetwork(delay_us=2_000_000)
    robot, _ = network.link("r1"), network.link("r1").subscribe(FRAME, lambda message: None)
    sent = [robot.publish(FRAME, b"", b"x") for _ in range(MAX_IN_FLIGHT + 10)]
    assert sent == [True] * MAX_IN_FLIGHT + [False] * 10
    assert network.dropped == {"overflow": 10}
    network.advance(1_000_000)
    assert network.delivered["FROM_ROBOT"] == MAX_IN_FLIGHT


def test_message_in_flight_to_a_closed_link_is_lost():
    network = MemoryNetwork(delay_us=1_000)
    robot, peer, stays = network.link("r1"), network.link("r1"), network.link("r1")
    heard: list[str] = []
    peer.subscribe(FRAME, lambda message: heard.append("closed"))
    stays.subscribe(FRAME, lambda message: heard.append("open"))
    robot.publish(FRAME, b"", b"x")
    peer.close()
    network.advance(1_000)
    assert heard == ["open"]


def test_next_due_and_time_that_goes_back():
    network = MemoryNetwork(delay_us=10)
    robot, _ = network.link("r1"), network.link("r1").subscribe(FRAME, lambda message: None)
    assert network.next_due_us() is None
    network.advance(100)
    robot.publish(FRAME, b"", b"x")
    assert network.next_due_us() == 105
    with pytest.raises(ValueError, match="back"):
        network.advance(99)


@pytest.mark.parametrize(
    "leg",
    [{"delay_us": -1}, {"jitter_us": -1}, {"loss": -0.1}, {"loss": 1.1}, {"loss": float("nan")}, {"burst": 0.5},
     {"burst": float("nan")}, {"loss": 0.7, "burst": 2.0}],
)  # fmt: skip
def test_impossible_leg_is_rejected(leg):
    with pytest.raises(ValueError):
        Leg(**leg)
