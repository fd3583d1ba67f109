"""Refusals in the robot's log: the first at once, a flood never more than once a second, each reason by itself."""

import itertools

import pytest

from sightline.protocol.channels import ACK, TWIST, key_for
from sightline.protocol.messages import LastRejection
from sightline.protocol.transports.zenoh.session import open_session
from sightline.robot_side.driver.process import RejectionLog
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision


def refusal(reason="STALE", detail="frame 7 is 900 ms old"):
    return LastRejection(source="vision", reason=reason, detail=detail)


def told(log, reason, from_us, until_us, step_us):
    """(when, line) for a refusal every `step_us`."""
    lines = ((now_us, log.line(refusal(reason), now_us)) for now_us in range(from_us, until_us, step_us))
    return [(now_us, line) for now_us, line in lines if line]


def test_the_first_is_told_at_once_with_source_reason_and_detail():
    assert RejectionLog().line(refusal(), 5) == "refused STALE from vision: frame 7 is 900 ms old"


@pytest.mark.parametrize("step_us", [100, 20_000, 100_000])
def test_a_flood_is_told_after_one_two_and_four_seconds_with_its_count(step_us):
    lines = told(RejectionLog(), "STALE", 0, 8_000_000, step_us)
    assert [when_us for when_us, _ in lines] == [0, 1_000_000, 3_000_000, 7_000_000]
    assert f"({2_000_000 // step_us} times)" in lines[2][1]


def test_it_never_falls_silent_for_more_than_a_minute():
    times = [when_us for when_us, _ in told(RejectionLog(), "STALE", 0, 600_000_000, 1_000_000)]
    assert max(b - a for a, b in itertools.pairwise(times)) == 60_000_000


def test_each_reason_has_its_own_share():
    log = RejectionLog()
    assert log.line(refusal("STALE"), 0) and log.line(refusal("MALFORMED"), 1) and not log.line(refusal("STALE"), 2)


@pytest.mark.parametrize(("gap_us", "again"), [(9_999_999, False), (10_000_000, True)])
def test_a_reason_that_was_silent_for_ten_seconds_is_news_again(gap_us, again):
    log = RejectionLog()
    last_us = told(log, "STALE", 0, 70_000_000, 1_000_000)[-1][0] + 1_000_000
    while log.line(refusal(), last_us):
        last_us += 1
    assert bool(log.line(refusal(), last_us + gap_us)) is again


def test_a_flood_of_refused_commands_is_a_few_lines_in_the_log_and_readable_in_the_status(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint, twist=b"nan|0") as vision:
        assert until(lambda: vision.status().refused.get("NOT_FINITE", 0) > 60, 10)

        def flooded():
            """Little by little: what a busy machine cannot send at once is dropped before the robot sees it."""
            for _ in range(50):
                vision.link.publish(TWIST, b"{", b"0.1|0")
            return vision.status().refused.get("MALFORMED", 0) > 1000

        assert until(flooded, 10)
        lines = [line for line in robot.output().splitlines() if "refused" in line]
        assert any("refused NOT_FINITE from vision" in line for line in lines)
        assert any("refused MALFORMED from vision" in line for line in lines)
        assert sum("MALFORMED" in line for line in lines) <= 4 and sum("NOT_FINITE" in line for line in lines) <= 5


def test_what_the_transport_turned_away_is_readable_in_the_status_and_told(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as vision:
        with open_session((), [robot.endpoint], 5.0) as stranger:
            stranger.put(key_for("r1", TWIST, "vision"), b"0" * 300)
            stranger.put(key_for("r1", ACK, "vision"), b"", attachment=b"{")
            assert until(lambda: vision.status().refused.get("OVERSIZE") == 1, 5)
        assert until(lambda: vision.status().refused.get("MALFORMED", 0) == 1, 5)
        assert until(lambda: "refused OVERSIZE from the network: turned away by the transport" in robot.output(), 2)


def test_what_an_earlier_network_process_counted_stays_in_the_status(tmp_path):
    def refused():
        try:
            return vision.status().refused.get("OVERSIZE", 0)
        except AttributeError:  # no status while the network process is away
            return -1

    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as vision:
        for count in (1, 2):
            with open_session((), [robot.endpoint], 10.0) as stranger:
                stranger.put(key_for("r1", TWIST, "vision"), b"0" * 300)
                assert until(lambda count=count: refused() == count, 8)
            if count == 1:
                robot.kill_network()
                assert until(lambda: len(vision.headers) and refused() == 1, 10), "the old count, from the new process"
