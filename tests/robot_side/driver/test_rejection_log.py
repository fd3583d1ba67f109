"""Rejected commands in the log of a robot: the first at once, a flood in a few lines, each reason by itself."""

from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.protocol.channels import ACK, TWIST, key_for
from sightline.protocol.messages import Verb
from sightline.protocol.transports.open import open_link
from sightline.protocol.transports.zenoh.session import open_session
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision


def test_flood_of_rejected_commands_writes_few_lines_and_shows_in_status(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint, twist=b"nan|0") as vision:
        assert until(lambda: vision.status().refused.get("NOT_FINITE", 0) > 60, 10)

        def flooded():
            """Little by little: what a busy machine cannot send at once is dropped before the robot sees it."""
            for _ in range(50):
                vision.link.publish(TWIST, b"{", b"0.1|0")
            return vision.status().refused.get("MALFORMED", 0) > 1000

        assert until(flooded, 10)
        lines = [line for line in robot.output().splitlines() if "rejected" in line]
        assert any("rejected NOT_FINITE from vision" in line for line in lines)
        assert any("rejected MALFORMED from vision" in line for line in lines)
        assert sum("MALFORMED" in line for line in lines) <= 4 and sum("NOT_FINITE" in line for line in lines) <= 5


def test_transport_rejections_show_in_the_status_and_the_log(tmp_path):
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as vision:
        with open_session((), [robot.endpoint], 5.0) as stranger:
            stranger.put(key_for("r1", TWIST, "vision"), b"0" * 300)
            stranger.put(key_for("r1", ACK, "vision"), b"", attachment=b"{")
            assert until(lambda: vision.status().refused.get("OVERSIZE") == 1, 5)
        assert until(lambda: vision.status().refused.get("MALFORMED", 0) == 1, 5)
        assert until(lambda: "rejected OVERSIZE from the network: rejected by the transport" in robot.output(), 2)


def test_status_keeps_the_counts_of_an_earlier_network_process(tmp_path):
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
                is_kept = until(lambda: len(vision.headers) and refused() == 1, 10)
                assert is_kept, (refused(), vision.link.connected, robot.output()[-1_000:])


def test_commands_before_arming_are_one_line_that_names_the_next_command(tmp_path):
    with RobotProcess(tmp_path, safety={"auto_arm": False}) as robot, Vision(robot.endpoint) as vision:
        assert until(lambda: vision.status().refused.get("DISARMED", 0) > 30, 10)
        waiting = "receives commands from vision; waiting for `sightline arm r1`"
        assert until(lambda: waiting in robot.output(), 2)
        assert robot.output().count(waiting) == 1
        assert "rejected DISARMED" not in robot.output()
        with open_link("r1", connect=[robot.endpoint], role=SOURCE) as link:
            operator = Operator(link)
            assert operator.arm().ok
            assert operator.request(Verb.DISARM).ok
        assert until(lambda: robot.output().count(waiting) == 2, 5), "again after it was armed"


def test_robot_that_arms_itself_waits_for_an_operator_only_after_a_disarm(tmp_path):
    waiting = "receives commands from vision; waiting for `sightline arm r1`"
    with RobotProcess(tmp_path, safety={"auto_arm": True}) as robot, Vision(robot.endpoint) as vision:
        assert until(lambda: vision.status().refused.get("DISARMED", 0) > 0 and "ACTIVE" in robot.output(), 10)
        assert waiting not in robot.output()
        with open_link("r1", connect=[robot.endpoint], role=SOURCE) as link:
            assert Operator(link).request(Verb.DISARM).ok
        assert until(lambda: robot.output().count(waiting) == 1, 5)
