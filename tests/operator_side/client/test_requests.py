"""The operator against a real gate: `DriverCore` on a network in memory, pumped by a thread in real time."""

import threading
import time

import pytest

from sightline.operator_side.client.requests import Operator, read_report
from sightline.operator_side.client.status import reply_line, short_lines, status_line, status_lines
from sightline.protocol.channels import REQUEST, STATUS, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import AnswerHeader, Echo, LeaseHolder, Reply, Stamp, State, Status, Verb
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore


class PumpedRobot:
    """A robot session on a `MemoryNetwork`, ticked by a thread; with `drives` a vision service answers every tick."""

    def __init__(self, *, drives: bool = True, receives: bool = True, version: str = "") -> None:
        config = RobotConfig(drive=PluginChoice(kind="log"), camera=PluginChoice(kind="folder"))
        self.network = MemoryNetwork()
        self.driving = DriverCore(config, "0000000a")
        self.drives, self.version = drives, version
        self.link = self.network.link("r1")
        self.operator = Operator(self.network.link("r1", role="operator"))
        if receives:
            self.link.subscribe(REQUEST, lambda message: self.driving.on_request(message, self.now_us))
        self.now_us = self.network.now_us
        self._ending = threading.Event()
        self._seq = 0
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        while not self._ending.wait(0.002):
            self.now_us += 20_000  # ten times faster than real
            self.network.advance(self.now_us)
            if self.drives:
                self._answer()
            self.driving.tick(self.now_us, None, None)
            for message in self.driving.messages(self.now_us):
                header = message.header.replace(b'"v":1', self.version.encode()) if self.version else message.header
                self.link.publish(message.channel, header, message.payload)

    def _answer(self) -> None:
        self._seq += 1
        self.driving.gate.issued.add("frame", self._seq, self.now_us)
        echo = Echo(channel="frame", session="0000000a", seq=self._seq, t_us=self.now_us)
        header = AnswerHeader(source="vision", session="0000000b", seq=self._seq, echo=echo)
        self.driving.on_twist(Message(TWIST, "vision", encode(header), b"0.1|0"), self.now_us)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_error):
        self._ending.set()
        self._thread.join()


def test_arm_drive_stop_reset():
    with PumpedRobot() as robot:
        operator = robot.operator
        assert operator.arm(patience_s=2.0).ok
        assert operator.wait_report().status.state in ("HOLD", "ACTIVE")
        assert operator.stop(lambda: None).state == "STOPPED"
        rejected = operator.arm(patience_s=2.0)
        assert not rejected.ok
        assert "reset" in rejected.detail
        # The first may still find turning wheels.
        assert operator.request(Verb.RESET).ok or operator.request(Verb.RESET).ok
        assert operator.wait_report().status.state == "DISARMED"
        assert operator.request(Verb.DISARM).ok


@pytest.mark.alone
def test_stop_that_is_answered_is_not_slow():
    with PumpedRobot() as robot:
        assert robot.operator.wait_report() and robot.operator.stop(lambda: pytest.fail("300 ms")).state == "STOPPED"


def test_threads_that_share_an_operator_get_the_replies_to_their_own_requests():
    with PumpedRobot() as robot:
        rejected, states = [], []

        def disarm():
            for _ in range(20):
                reply = robot.operator.request(Verb.DISARM)
                rejected.extend([] if reply.ok else [reply.detail])

        other = threading.Thread(target=disarm)
        other.start()
        while other.is_alive():
            states.append(robot.operator.request(Verb.ACQUIRE).detail)
        other.join()
        assert states and rejected == [], "disarming is always granted"


def test_of_two_robots_of_one_id_both_must_confirm_a_stop():
    with PumpedRobot() as robot:
        other, ending, shown = robot.network.link("r1"), threading.Event(), {"state": "ACTIVE", "applied": (0.3, 0.0)}

        def publish():
            while not ending.wait(0.005):
                other.publish(STATUS, encode(Stamp(session="0000000b", seq=1, t_us=robot.now_us)),
                              encode(Status.model_validate(shown | {"reason": "drives"})))

        threading.Thread(target=publish, daemon=True).start()
        while robot.operator.wait_report().stamp.session != "0000000b":
            pass
        with pytest.raises(LinkError, match="did not confirm STOP"):
            robot.operator.stop(lambda: None, 0.3)
        with pytest.raises(LinkError, match="two robots have the id 'r1'; end one of them"):
            robot.operator.arm(0.1)
        shown.update(state="STOPPED")
        with pytest.raises(LinkError, match="did not confirm STOP"):
            robot.operator.stop(lambda: None, 0.3)
        shown.update(applied=(0.0, 0.0))
        assert robot.operator.stop(lambda: None)
        ending.set()


def test_arm_waits_for_valid_commands_and_reports_the_missing_condition():
    with PumpedRobot(drives=False) as robot:
        reply = robot.operator.arm(patience_s=0.05)
        assert not reply.ok
        assert "start the vision service" in reply.detail
        threading.Timer(0.1, lambda: setattr(robot, "drives", True)).start()
        assert robot.operator.arm(patience_s=3.0).ok


def test_request_without_an_answer_ends_in_time_with_an_error():
    with PumpedRobot(receives=False) as robot:
        robot.operator.wait_report()
        with pytest.raises(LinkError, match="no answer from robot 'r1' to arm"):
            robot.operator.request(Verb.ARM, timeout_s=0.3)


@pytest.mark.alone
def test_stop_is_repeated_at_20_hz_and_warns_when_it_is_slow():
    with PumpedRobot(receives=False) as robot:
        received, warned = [], []
        robot.network.link("r1").subscribe(REQUEST, received.append)
        started_s = time.monotonic()
        with pytest.raises(LinkError, match="cut its power"):
            robot.operator.stop(lambda: warned.append(time.monotonic() - started_s), timeout_s=0.6)
        assert len(warned) == 1
        assert 0.3 <= warned[0] < 0.5
        assert 6 <= len(received) <= 13


def test_silence_and_another_version_have_different_errors():
    robot = PumpedRobot()
    with pytest.raises(LinkError, match="no status from robot 'r1'"):
        robot.operator.wait_report(timeout_s=0.1)
    with PumpedRobot(version='"v":2') as other, pytest.raises(LinkError, match="version 2; this peer uses 1"):
        other.operator.wait_report(timeout_s=1.0)


def test_stray_status_of_another_version_does_not_end_the_next_wait():
    """Any peer may have sent it: the next wait receives a report."""
    with PumpedRobot() as robot:
        stray = Message(STATUS, "", b'{"v":2,"session":"0000000f","seq":1,"t_us":1}', b"{}")
        robot.operator._on_status(stray)
        for _ in range(3):
            assert robot.operator.wait_report(2.0).status is not None


def test_replies_to_other_operators_are_ignored():
    with PumpedRobot() as robot:
        other = Operator(robot.network.link("r1", role="operator"))
        other.wait_report()
        replies = [None, None]

        def request(at: int, operator: Operator, verb: Verb) -> None:
            replies[at] = operator.request(verb)

        threads = [
            threading.Thread(target=request, args=(0, robot.operator, Verb.DISARM), daemon=True),
            threading.Thread(target=request, args=(1, other, Verb.RESET), daemon=True),
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert replies[0].detail == "disarmed"
        assert replies[1].detail.startswith("nothing to reset")


def test_status_text_shows_every_counter_and_the_last_rejection():
    with PumpedRobot(drives=False) as robot:
        robot.operator.arm(patience_s=0)
        for payload in (b"nan|1", b"nonsense", b"1|2|3"):
            robot.driving.on_twist(Message(TWIST, "vision", b"", payload), robot.now_us)
        status = robot.operator.wait_report().status
        while status.refused.get("MALFORMED", 0) < 2:
            status = robot.operator.wait_report().status
    text = "\n".join(status_lines("r1", status))
    for reason, count in status.refused.items():
        assert f"{reason} {count}" in text
    assert status.last_refusal.detail in text
    assert status_line("r1", status) == "r1: DISARMED (not armed)"


@pytest.mark.parametrize(("verb", "reply", "expected"), [
    ("arm", (True, "HOLD", "armed"), "r1 is armed (HOLD); it follows the commands of vision; `sightline stop r1`"),
    ("arm", (True, "ACTIVE", "already armed"), "r1 was already armed (ACTIVE); it follows"),
    ("arm", (False, "DISARMED", "NOT_ALLOWED: none; start it"), "robot r1 rejected arm (NOT_ALLOWED): none; start"),
    ("arm", (False, "STOPPED", "STOPPED: STOP by x; reset first"),
     "robot r1 rejected arm (STOPPED): STOP by x; run `sightline reset r1`, then arm again"),
    ("disarm", (True, "DISARMED", "disarmed"), "r1 is disarmed; `sightline arm r1` permits motion again"),
    ("reset", (True, "DISARMED", "reset; arm to drive"), "r1 is reset and disarmed; `sightline arm r1`"),
    ("reset", (True, "HOLD", "nothing to reset: HOLD"), "r1: nothing to reset: HOLD (HOLD)"),
])
def test_reply_names_the_next_command(verb, reply, expected):
    ok, state, detail = reply
    line = reply_line("r1", Verb(verb), Reply(to="0000000a", id=1, ok=ok, state=state, detail=detail), "vision")
    assert line.startswith(expected)


@pytest.mark.parametrize(("state", "holder", "expected"), [
    (State.DISARMED, True, "next      sightline arm r1"), (State.DISARMED, False, "next      sightline vision,"),
    (State.STOPPED, True, "next      sightline reset r1"), (State.ACTIVE, True, ""),
])
def test_short_status_fits_a_glance_and_names_the_next_command(state, holder, expected):
    driver = LeaseHolder(source="vision", digest="0000000a") if holder else None
    lines = list(short_lines("r1", Status(state=state, reason="why", holder=driver, frame_age_us=84_000)))
    assert lines[1] == f"state     {state}: why" and len(lines) <= 7
    assert "frame age 84 ms" in lines[4]
    assert [line for line in lines if line.startswith("next")] == ([lines[-1]] if expected else [])
    assert lines[-1].startswith(expected)


def test_report_has_the_published_status():
    driving = DriverCore(RobotConfig(), "0000000a")
    message = next(one for one in driving.messages(5) if one.channel is STATUS)
    report = read_report(message)
    assert report.stamp.t_us == 5
    assert report.status == Status.model_validate_json(message.payload)


def test_reset_is_repeated_while_the_wheels_turn_and_cites_the_same_status_so_that_a_stop_wins(monkeypatch):
    with PumpedRobot() as robot:
        cited, details = [], iter(["NOT_ALLOWED: the wheels are not at zero yet", "STALE: before the last STOP"])

        def reject(_verb, status, _timeout_s):
            cited.append(status)
            return Reply(id=1, to="00000000", ok=False, state="STOPPED", detail=next(details))

        monkeypatch.setattr(robot.operator, "_request", reject)
        assert robot.operator.reset().detail.startswith("STALE")
        assert len(cited) == 2 and cited[0] is cited[1]
