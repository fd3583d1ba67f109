"""The text next to the image of `sightline watch`."""

import pytest

from sightline.operator_side.client.missions import MissionClient
from sightline.operator_side.cockpit.watch_page import _robot_lines, state_of
from sightline.protocol.channels import REPORT, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.messages import DetectionsHeader, MissionReport, Stamp, State, Status, StreamStatus
from sightline.protocol.transports.memory import MemoryNetwork


@pytest.mark.parametrize("is_online", [True, False])
def test_state_of_an_offline_robot_is_empty(is_online):
    network = MemoryNetwork()
    missions = MissionClient(network.link("r1", role="operator"))
    status = Status(state=State.ACTIVE, reason="drives", applied=(0.4, 0.0))
    network.link("r1").publish(STATUS, encode(Stamp(session="0000000a", seq=1, t_us=1)), encode(status))
    report = MissionReport(mission="follow", phase="tracking", detector="hsv")
    header = DetectionsHeader(source="vision", session="0000000b", seq=1)
    network.link("r1", role="vision").publish(REPORT, encode(header), encode(report), "vision")
    network.advance(1)
    shown = state_of("r1", missions, is_online)
    assert (shown["online"], shown["state"], shown["reason"]) == (
        (True, "ACTIVE", "drives") if is_online else (False, "", "")
    )
    assert [name for name, _text in shown["lines"]] == (
        ["mission", "driver", "wheels", "frame age", "stream", "dropped", "commands", "detector"] if is_online else []
    )


@pytest.mark.parametrize(("quality", "expected"), [
    (100, "7 frames per second, encoding as configured"),
    (80, "7 frames per second, encoding reduced for this link: quality 80 %, side length 100 %"),
])  # fmt: skip
def test_stream_line_does_not_call_the_rate_configured(quality, expected):
    stream = StreamStatus(fps=7.2, quality_percent=quality)
    lines = dict(_robot_lines(Status(state=State.ACTIVE, reason="drives", stream=stream)))
    assert lines["stream"] == expected
