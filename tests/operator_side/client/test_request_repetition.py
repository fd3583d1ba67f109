"""Requests that are repeated, in virtual time: what a repeat cites, when it leaves, and when the operator gives up."""

import inspect
import threading
from itertools import pairwise
from types import SimpleNamespace

import pytest

from sightline.operator_side.client import requests
from sightline.operator_side.client.requests import Operator
from sightline.protocol.channels import REPLY, REQUEST, STATUS, TWIST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import LinkError, RejectReason, WireError
from sightline.protocol.messages import (
    AnswerHeader,
    Echo,
    Holder,
    Reply,
    Request,
    RequestHeader,
    Stamp,
    State,
    Status,
    Twist,
    Verb,
)
from sightline.protocol.proof import session_digest
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore

ROBOT, VISION, TWIN = "0000000a", "0000000b", "0000000c"
TICK_US = 10_000
BEGIN_US = 1_160_000
"""The robot's clock starts at 1 s and publishes its status each 100 ms, the next one 50 ms after this."""


class VirtualRobot:
    """A robot and the link to it, with one virtual clock: time passes only while the operator waits."""

    robot = "r1"

    def __init__(self):
        config = RobotConfig(drive=PluginChoice(kind="log"), camera=PluginChoice(kind="folder"))
        self.driving = DriverCore(config, ROBOT)
        self.handlers, self.sent, self.published = {}, [], []
        self.now_us = 1_000_000
        self.clock_s = 0.0
        """What the operator's clock shows at BEGIN_US."""
        self.drives = self.publishes = self.receives = True
        self.lost_requests = 0
        """So many of the next requests do not arrive."""
        self.on_sent = lambda count: None
        """Runs after each request of the operator, with their count."""
        self.twin = None
        """Status of another robot of this id, which it publishes when this one publishes its own."""
        self._seq = 0

    def subscribe(self, channel, handler):
        self.handlers[channel] = handler

    def publish(self, channel, header, payload, source):
        message = Message(channel, source, header, payload)
        assert channel is REQUEST and source == "operator"
        assert len(self.sent) < 1_000, "endless repetition"
        self.sent.append((self.now_us, decode(RequestHeader, header), decode(Request, payload)))
        if self.lost_requests:
            self.lost_requests -= 1
        elif self.receives:
            self.driving.on_request(message, self.now_us)
        self.on_sent(len(self.sent))

    def turn(self, until_us=None):
        """Let one tick pass, or less until a time: a command of vision, the gate, what the robot publishes."""
        assert self.now_us < BEGIN_US + 60_000_000, "endless wait"
        self.now_us = min(self.now_us + TICK_US, until_us or self.now_us + TICK_US)
        if self.drives:
            self._answer()
        self.driving.tick(self.now_us, None, None)
        for message in self.driving.messages(self.now_us):
            if self.publishes and message.channel in (STATUS, REPLY):
                self.published.append(message)
                self.handlers[message.channel](message)
            if self.twin is not None and message.channel is STATUS:
                stamp = Stamp(session=TWIN, seq=1, t_us=self.now_us)
                self.handlers[STATUS](Message(STATUS, "", encode(stamp), encode(self.twin)))

    def _answer(self):
        self._seq += 1
        self.driving.on_issued(self._seq, self.now_us, 0)
        echo = Echo(channel="frame", session=ROBOT, seq=self._seq, t_us=self.now_us)
        header = AnswerHeader(source="vision", session=VISION, seq=self._seq, echo=echo)
        self.driving.on_twist(Message(TWIST, "vision", encode(header), b"0.1|0"), self.now_us)

    def cited(self):
        """List the number of the status that each request cited, None without one."""
        return [header.echo and header.echo.seq for _, header, _ in self.sent]

    def verbs(self):
        return [request.verb for _, _, request in self.sent]

    def newest(self):
        """Return the number of the newest status that was published."""
        return max(decode(Stamp, message.header).seq for message in self.published if message.channel is STATUS)

    def wheels(self, linear_mps):
        """Let the gate hold this speed."""
        self.driving.gate.applied = Twist(linear_mps=linear_mps, angular_rad_s=0.0)
        self.driving.gate._ramp.force(self.driving.gate.applied)


class VirtualCondition(threading.Condition):
    """Waits in the virtual time of a robot, and counts the calls that wake a waiting thread."""

    def __init__(self, robot):
        super().__init__()
        self._robot = robot
        self.woken = 0

    def wait_for(self, predicate, timeout=None):
        until_us = self._robot.now_us + round(timeout * 1e6)
        while not predicate() and self._robot.now_us < until_us:
            self._robot.turn(until_us)
        return predicate()

    def notify_all(self):
        self.woken += 1
        super().notify_all()


@pytest.fixture
def robot(monkeypatch):
    made = VirtualRobot()
    monkeypatch.setattr(requests, "time", SimpleNamespace(monotonic=lambda: made.clock_s + elapsed_ms(made) / 1e3))
    return made


@pytest.fixture
def operator(robot):
    """An operator that has received two statuses; the clock stands at BEGIN_US."""
    made = Operator(robot)
    while robot.now_us < BEGIN_US:
        robot.turn()
    made._changed = VirtualCondition(robot)
    return made


def elapsed_ms(robot):
    return (robot.now_us - BEGIN_US) / 1000


# --- what a repeat cites -----------------------------------------------------------------------------------------


def test_disarm_between_two_repeats_of_arm_wins(robot, operator):
    """The repeat cites the status that the operator saw, which precedes the disarm; a newer one would arm."""

    def disarm(count):
        if count == 1:
            robot.driving.gate.disarm("disarmed by another operator")

    robot.lost_requests, robot.on_sent = 1, disarm
    reply = operator.request(Verb.ARM)
    assert len(robot.sent) == 2, "the first was lost"
    assert (reply.ok, reply.detail.partition(":")[0]) == (False, "STALE")
    assert robot.driving.gate.state is State.DISARMED


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET, Verb.ACQUIRE])
def test_request_that_permits_motion_waits_for_a_new_status_and_cites_it(robot, operator, verb):
    """The stored one may precede a STOP."""
    before = robot.newest()
    operator.request(verb)
    assert robot.cited() == [before + 1] and robot.verbs() == [verb]


@pytest.mark.parametrize("verb", [Verb.DISARM, Verb.RELEASE, Verb.STOP])
def test_request_that_ends_motion_does_not_wait(robot, operator, verb):
    before = robot.newest()
    assert operator.request(verb).ok
    assert robot.sent[0][0] == BEGIN_US and robot.cited() == [before]


def test_stop_cites_no_status(robot, operator):
    operator.stop(lambda: None)
    assert robot.cited() == [None] and robot.verbs() == [Verb.STOP]


def test_stop_ends_with_the_wheels_at_zero_and_a_latched_one_is_not_slow(robot, operator):
    keep, warned = robot.driving.tick, []

    def turning(*arguments):
        if elapsed_ms(robot) < 500:
            robot.wheels(0.2)
        keep(*arguments)

    robot.driving.tick = turning
    assert operator.stop(lambda: warned.append(True)).applied == (0.0, 0.0)
    assert elapsed_ms(robot) >= 500 and not warned


def test_stop_is_slow_if_only_a_status_from_before_it_shows_stopped(robot, operator):
    robot.driving.gate.stop()
    operator.wait_report()
    robot.receives = robot.publishes = False
    warned = []
    with pytest.raises(LinkError):
        operator.stop(lambda: warned.append(True), timeout_s=0.6)
    assert operator.report.status.state is State.STOPPED and warned == [True]


@pytest.mark.parametrize("sent", [0, 3])
def test_stop_ends_as_soon_as_it_is_proven_in_another_way(robot, operator, sent):
    robot.receives = False
    assert operator.stop(lambda: None, is_proven=lambda: len(robot.sent) >= sent) is None
    assert robot.verbs() == [Verb.STOP] * sent


def test_request_before_the_first_status_cites_none(robot):
    made = Operator(robot)
    made._changed = VirtualCondition(robot)
    assert made.report is None
    assert made.request(Verb.DISARM).ok
    assert robot.cited() == [None]


# --- when it leaves ----------------------------------------------------------------------------------------------


def test_requests_have_a_source_a_session_and_counts_of_their_own(robot, operator):
    robot.lost_requests = 1
    operator.request(Verb.DISARM)
    operator.stop(lambda: None)
    operator.request(Verb.RELEASE)
    headers = [header for _, header, _ in robot.sent]
    assert {(header.source, header.session) for header in headers} == {("operator", operator._session)}
    assert [header.seq for header in headers] == [1, 2, 3, 4]
    assert [request.id for _, _, request in robot.sent] == [1, 1, 2, 3], "a repeat has the same id"
    assert (operator.robot, len(operator._session)) == ("r1", 8)
    assert Operator(robot)._session != operator._session


def test_request_is_repeated_each_200_ms_until_its_time_is_over(robot, operator):
    robot.receives = False
    with pytest.raises(LinkError, match=r"^no answer from robot 'r1' to disarm after 1 s; repeat the command$"):
        operator.request(Verb.DISARM, timeout_s=1.0)
    assert [sent_us - BEGIN_US for sent_us, _, _ in robot.sent] == [0, 200_000, 400_000, 600_000, 800_000]
    assert elapsed_ms(robot) == 1_000


def test_each_request_gets_the_reply_to_its_id(robot, operator):
    assert operator.request(Verb.DISARM).detail == "disarmed"
    assert operator.request(Verb.RELEASE).detail == "not held"
    assert operator.request(Verb.DISARM).id == 3


def test_times_by_default():
    found = {
        (name, parameter.name): parameter.default
        for name in ("wait_report", "request", "arm", "reset", "stop")
        for parameter in inspect.signature(getattr(Operator, name)).parameters.values()
        if parameter.name.endswith("_s")
    }
    assert found == {
        ("wait_report", "timeout_s"): 2.0, ("request", "timeout_s"): 2.0, ("arm", "patience_s"): 5.0,
        ("reset", "patience_s"): 1.5, ("stop", "timeout_s"): 10.0,
    }  # fmt: skip


# --- the status --------------------------------------------------------------------------------------------------


def test_wait_ends_with_the_next_status(robot, operator):
    before = operator.report
    report = operator.wait_report()
    assert report is operator.report is not before
    assert report.stamp.seq == before.stamp.seq + 1 and report.status.state is State.DISARMED
    assert elapsed_ms(robot) == 50


def test_silence_is_an_error_at_the_timeout(robot, operator):
    robot.publishes = False
    with pytest.raises(LinkError, match=r"^no status from robot 'r1' after 1.5 s; run `sightline robots`$"):
        operator.wait_report(1.5)
    assert elapsed_ms(robot) == 1_500


def status_of(version=1, payload=b'{"state":"HOLD","reason":""}'):
    return Message(STATUS, "", b'{"v":%d,"session":"0000000f","seq":1,"t_us":1}' % version, payload)


def test_status_of_another_version_is_an_error_of_its_own_once(robot, operator):
    robot.publishes = False
    operator._on_status(status_of(version=2))
    with pytest.raises(LinkError, match=r"^no status"):
        operator.wait_report(0.1)
    robot.turn = lambda _until_us: operator._on_status(status_of(version=2))
    with pytest.raises(LinkError, match=r"^robot 'r1' uses another protocol version: .* version 2; this peer uses 1$"):
        operator.wait_report()
    assert elapsed_ms(robot) == 100, "at once"


def test_invalid_status_is_ignored(robot, operator):
    before = operator.report
    operator._on_status(status_of(payload=b"{}"))
    assert operator.report is before and operator._changed.woken == 0
    assert operator.wait_report().stamp.seq == before.stamp.seq + 1


def test_status_of_this_version_counts_beside_one_of_another(robot, operator):
    """Any peer may have sent the other."""
    turn = robot.turn

    def stray(until_us):
        turn(until_us)
        if robot.now_us - BEGIN_US == 50_000:
            operator._on_status(status_of(version=2))

    robot.turn = stray
    assert operator.wait_report().status.state is State.DISARMED


@pytest.mark.parametrize(("arrive", "woken"), [
    (lambda operator: operator._on_status(status_of()), 1),
    (lambda operator: operator._on_status(status_of(version=2)), 1),
    (lambda operator: operator._on_reply(reply_to(operator)), 1),
    (lambda operator: operator._on_reply(reply_to(operator, to="0000000f")), 0),
    (lambda operator: operator._on_reply(Message(REPLY, "", b"", b"{}")), 0),
])  # fmt: skip
def test_what_arrives_wakes_the_waiting_thread(operator, arrive, woken):
    arrive(operator)
    assert operator._changed.woken == woken


# --- replies -----------------------------------------------------------------------------------------------------


def reply_to(operator, number=1, *, to=None, detail="done"):
    own = session_digest("operator", operator._session)
    reply = Reply(to=to or own, id=number, ok=True, state="HOLD", detail=detail)
    return Message(REPLY, "", b"", encode(reply))


@pytest.mark.parametrize("changes", [{"to": "0000000f"}, {"number": 2}])
def test_reply_to_another_operator_or_another_request_is_ignored(robot, operator, changes):
    robot.on_sent = lambda _count: operator._on_reply(reply_to(operator, **changes))
    assert operator.request(Verb.DISARM).detail == "disarmed"


def test_first_reply_to_a_request_counts(robot, operator):
    def twice(_count):
        for detail in ("first", "second"):
            operator._on_reply(reply_to(operator, detail=detail))

    robot.on_sent = twice
    assert operator.request(Verb.DISARM).detail == "first"


def test_the_last_64_replies_are_stored(operator):
    for number in range(1, 71):
        operator._on_reply(reply_to(operator, number))
    assert list(operator._replies) == list(range(7, 71))


# --- arm and reset -----------------------------------------------------------------------------------------------


def test_arm_is_repeated_with_a_new_status_until_the_commands_are_there(robot, operator):
    robot.drives = False
    robot.driving.gate._live_commands = 0

    def start(count):
        robot.drives = count >= 3

    robot.on_sent = start
    reply = operator.arm()
    assert reply.ok and reply.detail == "armed"
    cited = robot.cited()
    assert set(robot.verbs()) == {Verb.ARM} and len(cited) > 3
    assert all(after > before for before, after in pairwise(cited)), "each cites a new status"


def test_arm_is_not_repeated_after_another_operator_stopped_and_reset(robot, operator):
    """The commands come at the same time, so that the next request would arm."""
    robot.drives = False
    robot.driving.gate._live_commands = 0

    def on_sent(count):
        if count == 2:
            robot.driving.gate.stop("STOP by another operator")
            robot.driving.gate.reset(Holder(source="teleop", session="0000000c"), robot.now_us)
            robot.drives = True

    robot.on_sent = on_sent
    reply = operator.arm()
    assert not reply.ok and len(robot.sent) == 2 and robot.driving.gate.state is State.DISARMED


def test_arm_gives_up_at_its_patience_with_the_reason(robot, operator):
    robot.drives = False
    robot.driving.gate._live_commands = 0
    reply = operator.arm(patience_s=1.0)
    assert not reply.ok and reply.detail.startswith("NOT_ALLOWED")
    assert 1_000 <= elapsed_ms(robot) < 1_300 and len(robot.sent) >= 5


def test_arm_is_not_repeated_after_another_rejection(robot, operator):
    robot.driving.gate.stop("STOP by another operator")
    reply = operator.arm()
    assert not reply.ok and reply.detail.startswith("STOPPED") and len(robot.sent) == 1


@pytest.mark.parametrize("act", ["arm", "reset"])
@pytest.mark.parametrize(("patience_s", "requested"), [(0.0, 1), (0.06, 1), (0.0601, 2)])
def test_repetition_ends_with_the_patience(robot, operator, act, patience_s, requested):
    """The first reply comes after 60 ms: the status at 50 ms, and one tick."""
    robot.drives = False
    robot.driving.gate._live_commands = 0
    if act == "reset":
        robot.driving.gate.stop()
        robot.driving.gate.reset = lambda *_: (_ for _ in ()).throw(WireError(RejectReason.NOT_ALLOWED, "turning"))
    assert not getattr(operator, act)(patience_s=patience_s).ok
    assert len(robot.sent) == requested


def test_reset_is_repeated_with_the_same_status_until_the_wheels_stand(robot, operator):
    robot.driving.gate.stop()
    robot.wheels(0.2)
    before = robot.newest()
    reply = operator.reset()
    assert reply.ok and robot.driving.gate.state is State.DISARMED
    assert set(robot.cited()) == {before + 1} and len(robot.sent) > 1 and set(robot.verbs()) == {Verb.RESET}
    times_us = [sent_us for sent_us, _, _ in robot.sent]
    assert all(after - before >= 90_000 for before, after in pairwise(times_us)), "once for each status"


def test_reset_gives_up_at_its_patience_and_at_another_rejection(robot, operator):
    robot.driving.gate.stop()
    keep = robot.driving.tick

    def turning(*arguments):
        robot.wheels(0.2)
        keep(*arguments)
        robot.wheels(0.2)

    robot.driving.tick = turning
    reply = operator.reset(patience_s=1.0)
    assert reply.detail.startswith("NOT_ALLOWED") and 1_000 <= elapsed_ms(robot) < 1_300
    robot.sent.clear()
    robot.on_sent = lambda count: robot.driving.gate.stop("another") if count == 1 else None
    reply = operator.reset()
    assert reply.detail.startswith("STALE") and len(robot.sent) == 2, "the STOP in between wins"


@pytest.mark.parametrize("act", ["arm", "reset"])
@pytest.mark.parametrize("lost", ["first", "second"])
def test_without_an_answer_there_is_an_error_after_two_seconds(robot, operator, act, lost):
    if act == "reset":
        robot.driving.gate.stop()
        robot.wheels(0.2)
    robot.drives = False
    robot.driving.gate._live_commands = 0
    if lost == "first":
        robot.receives = False
    robot.on_sent = lambda count: setattr(robot, "receives", False)
    with pytest.raises(LinkError, match=f"to {act} after 2 s"):
        getattr(operator, act)()


# --- STOP --------------------------------------------------------------------------------------------------------


def test_stop_ends_with_a_status_that_shows_it(robot, operator):
    status = operator.stop(lambda: pytest.fail("slow"))
    assert status.state is State.STOPPED and elapsed_ms(robot) == 50
    assert [sent_us - BEGIN_US for sent_us, _, _ in robot.sent] == [0]


def test_stop_is_repeated_each_50_ms_until_its_time_is_over(robot, operator):
    robot.receives, slow_ms = False, []
    with pytest.raises(
        LinkError, match=r"^robot 'r1' did not confirm STOP within 0.6 s; cut its power by hand$"
    ):
        operator.stop(lambda: slow_ms.append(elapsed_ms(robot)), timeout_s=0.6)
    assert [sent_us - BEGIN_US for sent_us, _, _ in robot.sent] == [50_000 * number for number in range(12)]
    assert slow_ms == [350], "once, above 300 ms"
    assert set(robot.verbs()) == {Verb.STOP}


@pytest.mark.parametrize("clock_s", [0.0, 1e5])
def test_operator_is_warned_above_300_ms(robot, operator, clock_s):
    robot.clock_s, robot.receives, slow_ms = clock_s, False, []
    robot.on_sent = lambda count: setattr(robot, "now_us", robot.now_us + (2_000 if count == 1 else 0))
    with pytest.raises(LinkError):
        operator.stop(lambda: slow_ms.append(elapsed_ms(robot)), timeout_s=0.6)
    assert slow_ms == [302]


def test_stop_is_not_confirmed_by_a_status_from_before_it(robot, operator):
    """The robot was stopped, another operator reset it, and now the link is dead: nothing is known."""
    operator.stop(lambda: None)
    robot.publishes = robot.receives = False
    with pytest.raises(LinkError, match="did not confirm STOP"):
        operator.stop(lambda: None, timeout_s=0.6)


# --- two robots of one id ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("state", "applied", "slow"), [
    (State.ACTIVE, (0.3, 0.0), 1), (State.ACTIVE, (0.0, 0.0), 1), (State.STOPPED, (0.3, 0.0), 0),
    (State.STOPPED, (0.0, 0.1), 0),
])  # fmt: skip
def test_stop_is_confirmed_only_when_each_robot_of_the_id_has_stopped(robot, operator, state, applied, slow):
    robot.twin, warned = Status(reason="", state=state, applied=applied), []
    operator.wait_report()
    with pytest.raises(LinkError, match="did not confirm STOP"):
        operator.stop(lambda: warned.append(True), timeout_s=0.6)
    assert len(warned) == slow
    robot.twin = Status(reason="", state=State.STOPPED)
    assert operator.stop(lambda: pytest.fail("slow")).state is State.STOPPED


def test_stop_waits_no_longer_than_half_a_second_for_a_robot_that_ended(robot, operator):
    robot.twin = Status(reason="", state=State.ACTIVE)
    operator.wait_report()
    robot.twin = None
    assert elapsed_ms(robot) == 50
    operator.stop(lambda: None)
    assert elapsed_ms(robot) == 550


@pytest.mark.parametrize(("at_ms", "is_named"), [(200, True), (736, True), (740, False)])
def test_rejection_names_two_robots_of_one_id_while_both_publish_or_did_so_in_the_last_half_second(
    robot, operator, at_ms, is_named
):
    """The other robot publishes at 50 and 150 ms; the status of this one at 250 ms is the last sign of two."""
    robot.twin, robot.drives = Status(reason="", state=State.DISARMED), False
    while elapsed_ms(robot) < at_ms:
        robot.turn(BEGIN_US + at_ms * 1000)
        if elapsed_ms(robot) == 150:
            robot.twin = None
    robot.driving.gate._live_commands = 0
    if is_named:
        with pytest.raises(LinkError, match=r"^two robots have the id 'r1'; end one of them, `sightline robots` lists"):
            operator._request(Verb.ARM, operator.report, 1.0)
    else:
        assert operator._request(Verb.ARM, operator.report, 1.0).detail.startswith("NOT_ALLOWED")
    assert operator._request(Verb.DISARM, None, 1.0).ok, "what is granted is granted by the robot that has that session"


def test_robot_that_starts_again_is_not_two(robot, operator):
    robot.drives = robot.publishes = False
    robot.twin = Status(reason="", state=State.DISARMED)
    operator.wait_report()
    operator.wait_report()
    robot.twin, robot.publishes = None, True
    assert operator._request(Verb.ARM, operator.report, 1.0).detail.startswith("OTHER_SESSION")
