"""The stream's credit, step by step: when a frame may leave, whose answer counts, what a new holder begins with."""

import pytest

from sightline.protocol.messages import Holder
from sightline.robot_side.network.stream import Stream, StreamConfig

VISION, VIEWER = Holder(source="vision", session="0000bbbb"), Holder(source="viewer", session="0000cccc")
FAR_US = 100_000
"""A link of this delay carries four frames at once."""


class FarLink:
    """A stream, a camera and an owner behind a link of constant delay, in steps of 1 ms."""

    def __init__(self, stream=None):
        self.stream = stream or Stream(StreamConfig())
        self.now_us = self.seq = 0
        self.flying = []

    def run(self, who, seconds, delay_us=FAR_US):
        until_us = self.now_us + round(seconds * 1e6)
        while self.now_us < until_us:
            self.now_us += 1_000
            while self.flying and self.flying[0][0] <= self.now_us:
                self.stream.on_answer(who, self.flying.pop(0)[1], 0, self.now_us)
            if self.stream.may_capture(self.now_us, listening=True):
                self.stream.on_sent(self.seq, self.now_us, self.now_us, 10_000)
                self.flying.append((self.now_us + delay_us, self.seq))
                self.seq += 1
        return self


@pytest.mark.parametrize("silent", [False, True])
def test_new_owner_of_the_credit_begins_with_one_frame_in_flight(silent):
    """The width that a far owner needs would be a queue at its successor: after a hand-over, and after silence."""
    link = FarLink().run(VISION, 3.0)
    assert link.stream.window == 4
    if silent:
        assert link.stream.on_answer(VIEWER, link.seq, 0, link.now_us + 1_000_000)
    else:
        link.stream.on_holder(VIEWER, link.now_us)
    assert link.stream.window == 1
