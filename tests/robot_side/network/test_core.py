"""The network core: which frames, answers and models it passes on, with numbers."""

import pytest

from sightline.protocol.channels import ACK
from sightline.protocol.codec import encode
from sightline.protocol.messages import AnswerHeader, Echo
from sightline.protocol.transports.link import Message
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.network.stream import StreamConfig
from sightline.robot_side.ports import Picture

ROBOT, VISION = "0000aaaa", "0000bbbb"
LATER_US = 60_000
"""After the interval of a frame at time 0, and before its credit times out."""


def core_with_a_frame_in_flight(seq=0):
    core = NetworkCore(StreamConfig(), ROBOT, seq, 400_000)
    assert core.on_camera(Picture(b"jpeg", 1), 1) is not None
    assert not core.may_capture(LATER_US, True), "no credit"
    return core


def ack(*, key="vision", source="vision", session=ROBOT, seq=0):
    echo = Echo(channel="frame", session=session, seq=seq, t_us=1)
    return Message(ACK, key, encode(AnswerHeader(source=source, session=VISION, seq=5, echo=echo)), b"")


@pytest.mark.parametrize(("key", "source"), [("viewer", "vision"), ("vision", "viewer")])
def test_ack_under_the_key_of_another_source_returns_no_credit(key, source):
    core = core_with_a_frame_in_flight()
    core.on_ack(ack(key=key, source=source), 20_000)
    assert not core.may_capture(LATER_US, True)
    core.on_ack(ack(), 30_000)
    assert core.may_capture(LATER_US, True)
