"""A shaped link has the configured delay and loss, keeps order, is bounded, and counts."""

import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.evaluation.demo.shaped_vision import MAX_WAITING, DelayLine, Shape, ShapedLink
from sightline.protocol.channels import FRAME, TWIST
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.memory import Leg, MemoryNetwork

TIMES_US = st.lists(st.integers(0, 50_000), min_size=1, max_size=200)


@given(TIMES_US, st.integers(0, 300_000), st.floats(0, 1), st.integers(0, 2**32))
def test_delivered_messages_are_due_after_the_delay_in_order(steps_us, delay_us, loss, seed):
    line, now_us, sent_us, came = DelayLine(Leg(delay_us, loss=loss), str(seed)), 0, {}, []
    for at, step_us in enumerate(steps_us):
        now_us += step_us
        sent_us[at] = now_us
        line.put(lambda at=at: at, now_us)
        came += [(deliver(), now_us) for deliver in line.take_due(now_us)]
        assert line.next_us is None or line.next_us > now_us
    while line.next_us is not None:
        now_us = line.next_us
        came += [(deliver(), now_us) for deliver in line.take_due(now_us)]
    numbers = [number for number, _ in came]
    assert numbers == sorted(numbers)
    assert len(came) + line.count.lost + line.count.overflow == line.count.sent == len(steps_us)
    for number, came_us in came:
        next_step_us = max(steps_us)
        assert sent_us[number] + delay_us <= came_us <= sent_us[number] + delay_us + next_step_us


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.5, 1.0])
def test_lost_share_matches_the_request_and_repeats(loss):
    counts = []
    for _ in range(2):
        line = DelayLine(Leg(0, loss=loss), "7")
        for at in range(4000):
            line.put(lambda: None, at)
            line.take_due(at)
        counts.append(line.count.lost)
    assert counts[0] == counts[1]
    assert abs(counts[0] / 4000 - loss) < 0.02


def test_a_leg_is_bounded():
    line = DelayLine(Leg(10**9), "1")
    for at in range(MAX_WAITING + 50):
        line.put(lambda: None, at)
    assert line.count.overflow == 50


@pytest.mark.alone
def test_each_leg_has_half_of_the_latency():
    network = MemoryNetwork()
    robot, came = network.link("r1"), threading.Event()
    robot.subscribe(TWIST, lambda _message: came.set())
    with ShapedLink(network.link("r1", role="vision"), latency_ms=80, loss=0.0, seed=1) as shaped:
        frames = shaped.latest(FRAME)
        started_s = time.monotonic()
        robot.publish(FRAME, b"{}", b"jpeg")
        network.advance(1)
        assert frames.take(2.0).payload == b"jpeg"
        out_s = time.monotonic() - started_s
        assert shaped.publish(TWIST, b"{}", b"0|0")
        while network.sent.total() < 2:
            time.sleep(0.001)
        back_s = time.monotonic() - started_s - out_s
        network.advance(2)
        assert came.is_set()
        assert 0.040 <= out_s < 0.080
        assert 0.039 <= back_s < 0.080
        assert {leg: count.sent for leg, count in shaped.counts.items()} == {"from_robot": 1, "to_robot": 1}


def test_shape_reads_its_own_text_and_rejects_other_text():
    shape = Shape(50.5, 0.1, 3)
    assert Shape.parse(shape.text()) == shape
    for text in ("", "1,2", "a,b,c", "1,2,3,4"):
        with pytest.raises(ConfigError, match=r"50,0\.1,1"):
            Shape.parse(text)
