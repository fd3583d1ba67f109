"""Every number and branch of requests and arming: just inside, at the bound, just outside."""

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, Echo, Request, RequestHeader, Twist, Verb
from sightline.protocol.proof import session_digest
from sightline.robot_side.safety.gate import SafetyGate
from sightline.robot_side.safety.limits import SafetyConfig
from tests.fixtures.safety import HUMAN, OTHER, ROBOT, A, D, F, H, Rig, S, driving, refused

# --- requests ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("verb", Verb)
def test_stop_disarm_and_release_need_no_echo(verb):
    rig = Rig()
    if verb in (Verb.STOP, Verb.DISARM, Verb.RELEASE):
        assert rig.request(verb, echo=False)
    else:
        error = refused(rig, verb, echo=False)
        assert error.reason is RejectReason.MALFORMED
        assert error.detail == "a request that permits motion must cite a status"


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET, Verb.ACQUIRE])
@pytest.mark.parametrize(
    ("age_us", "reason"),
    [(-1, RejectReason.FROM_FUTURE), (0, None), (2_000_000, None), (2_000_001, RejectReason.STALE)],
)
def test_other_requests_cite_something_young(verb, age_us, reason):
    gate = SafetyGate(SafetyConfig(), ROBOT)
    gate.issued.add("status", 3, 10_000_000)
    cited = Echo(channel="status", session=ROBOT, seq=3, t_us=10_000_000)
    header = RequestHeader(source="teleop", session=HUMAN, seq=0, echo=cited)
    try:
        gate.request(header, Request(id=1, verb=verb), 10_000_000 + age_us)
    except WireError as error:
        assert error.reason is (reason or RejectReason.NOT_ALLOWED) and (reason or verb is Verb.ARM)
    else:
        assert reason is None


def test_each_verb_returns_its_result():
    rig = Rig().armed()
    assert rig.gate.reason == "armed by operator" and rig.gate.state is H
    assert rig.request(Verb.ARM) == "already armed"
    assert rig.request(Verb.DISARM) == "disarmed" and rig.gate.reason == "disarmed by operator"
    assert rig.gate.state is D
    assert rig.request(Verb.RESET) == "nothing to reset: DISARMED"
    assert rig.request(Verb.STOP) == "STOPPED" and rig.gate.reason == "STOP by operator"
    error = refused(rig, Verb.ARM)
    assert (error.reason, error.detail) == (RejectReason.STOPPED, "STOP by operator; reset first")
    assert rig.request(Verb.RESET) == "reset; arm to drive" and rig.gate.reason == "reset by operator; not armed"
    assert rig.gate.state is D
    assert rig.gate.stop() == "STOPPED" and rig.gate.reason == "STOP"
    assert rig.gate.stop("again") == "STOPPED" and rig.gate.reason == "STOP", "what set the latch stays"
    rig.request(Verb.RESET)
    rig.gate.fault("no drive")
    assert (rig.gate.state, rig.gate.reason) == (F, "no drive")
    assert refused(rig, Verb.ARM).reason is RejectReason.FAULT
    assert rig.request(Verb.RESET) == "reset; arm to drive"
    rig.armed()
    assert rig.gate.disarm() == "disarmed" and rig.gate.reason == "disarmed"


@pytest.mark.parametrize("state", [S, F])
def test_reset_waits_for_the_wheels(state):
    rig = Rig().armed().drive(600)
    rig.gate.stop() if state is S else rig.gate.fault("broken")
    while rig.gate.applied != STILL:
        error = refused(rig, Verb.RESET)
        assert error.reason is RejectReason.NOT_ALLOWED and "not at zero" in error.detail
        rig.step()
    assert rig.request(Verb.RESET) and rig.gate.state is D


@pytest.mark.parametrize(("state", "after"), [(A, F), (S, S)])
def test_gate_that_cannot_step_stops_immediately(state, after):
    rig = Rig().armed().drive(400)
    if state is S:
        rig.gate.stop("STOP by test")
    rig.gate.halt("broken")
    assert (rig.gate.state, rig.gate.reason) == (after, "STOP by test" if state is S else "broken")
    assert rig.gate.applied == STILL
    assert rig.step().twist == STILL, "nor does the earlier speed return"
    assert rig.request(Verb.RESET) and rig.gate.state is D


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET])
def test_other_operators_cannot_arm_or_reset_while_a_human_drives(verb):
    rig = Rig()
    rig.offer(source="teleop", session=HUMAN)
    for source, session in [("operator", OTHER), ("teleop", OTHER), ("operator", HUMAN), ("vision", HUMAN)]:
        error = refused(rig, verb, source=source, session=session)
        assert error.reason is RejectReason.NOT_ALLOWED
        assert error.detail == f"teleop {session_digest('teleop', HUMAN)} drives"
    if verb is Verb.RESET:
        assert rig.request(verb, source="teleop", session=HUMAN).startswith("nothing")
    else:
        assert "live commands" in refused(rig, verb, source="teleop", session=HUMAN).detail
    beside_vision = Rig()
    beside_vision.offer()
    assert "live commands" in refused(beside_vision, Verb.ARM, session=OTHER).detail


# --- arming ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("commands", "missing"),
    [
        (0, "no valid commands yet; start the vision service"),
        (1, "1 of 5 live commands received; repeat the request"),
        (4, "4 of 5 live commands received; repeat the request"),
        (5, None),
        (6, None),
    ],
)
def test_arming_needs_five_live_commands(commands, missing):
    rig = Rig()
    for _ in range(commands):
        rig.offer()
    if missing is None:
        assert rig.request(Verb.ARM) == "armed"
    else:
        error = refused(rig, Verb.ARM)
        assert (error.reason, error.detail) == (RejectReason.NOT_ALLOWED, missing)


def test_the_five_are_of_one_driver_in_a_row():
    rig = Rig()
    for _ in range(4):
        rig.offer()
    rig.offer(source="teleop", session=HUMAN)
    assert "1 of 5" in refused(rig, Verb.ARM, source="teleop", session=HUMAN).detail
    for _ in range(4):
        rig.offer(source="teleop", session=HUMAN)
    assert rig.request(Verb.ARM, source="teleop", session=HUMAN) == "armed"


@pytest.mark.parametrize(("gap_us", "granted"), [(999_999, True), (1_000_000, False)])
def test_the_five_are_live_as_long_as_the_lease(gap_us, granted):
    rig = Rig()
    for _ in range(4):
        rig.offer()
    rig.now_us += gap_us
    rig.offer()
    assert (granted and rig.request(Verb.ARM) == "armed") or "1 of 5" in refused(rig, Verb.ARM).detail


def test_five_live_commands_are_required_again_after_disarming():
    rig = Rig().armed()
    rig.request(Verb.DISARM)
    assert "0 of 5" in refused(rig, Verb.ARM).detail
    assert Rig(live_commands_to_arm=1).gate.config.live_commands_to_arm == 1


def test_arming_waits_for_the_wheels():
    rig = Rig().armed().drive(600)
    rig.request(Verb.DISARM)
    while rig.gate.applied != STILL:
        for _ in range(5):
            rig.offer()
        error = refused(rig, Verb.ARM)
        assert error.reason is RejectReason.NOT_ALLOWED
        assert error.detail == "the wheels are not at zero yet; repeat the request"
        rig.step()
    for _ in range(5):
        rig.offer()
    assert rig.request(Verb.ARM) == "armed"


def test_commands_from_before_arming_are_forgotten():
    rig = driving(A)
    rig.request(Verb.DISARM)
    assert rig.gate.frame_age_us(rig.now_us) is None
    rig.silence(600).armed()
    assert rig.step().reason == "armed; no command yet"


# --- auto_arm ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("commands", "state"), [(4, D), (5, H)])
def test_auto_arm_arms_with_the_fifth_command(commands, state):
    rig = Rig(auto_arm=True)
    for _ in range(commands):
        rig.offer()
    assert rig.step().state is state
    off = Rig()
    for _ in range(commands):
        off.offer()
    assert off.step().state is D


def test_auto_arm_reports_itself_and_waits_for_a_command():
    rig = Rig(auto_arm=True)
    for _ in range(5):
        rig.offer()
    assert rig.gate.state is D
    assert rig.step().reason == "armed; no command yet"
    rig.offer()
    assert rig.step().state is A


LEAVING = {
    "stop": lambda rig: rig.request(Verb.STOP, echo=False),
    "disarm": lambda rig: rig.request(Verb.DISARM, echo=False),
    "fault": lambda rig: rig.gate.fault("broken"),
    "release": lambda rig: rig.drive(60, source="teleop", session=HUMAN).request(
        Verb.RELEASE, source="teleop", session=HUMAN, echo=False
    ),
    "lost": lambda rig: rig.drive(60, source="teleop", session=HUMAN).silence(1_100),
}


@pytest.mark.parametrize("how", LEAVING)
def test_robot_after_the_end_by_an_operator_does_not_arm_itself(how):
    rig = Rig(auto_arm=True).drive(400)
    assert rig.gate.state is A
    LEAVING[how](rig)
    rig.silence(1_200)
    rig.request(Verb.RESET)
    assert rig.drive(400).gate.state is D
    rig.request(Verb.ARM)
    rig.drive(100).silence(10_400)
    assert rig.gate.state is D
    assert rig.drive(400).gate.state is A, "an operator armed: unattended again"


def test_robot_that_starts_stopped_does_not_arm_automatically():
    rig = Rig(auto_arm=True, stopped=True)
    rig.request(Verb.RESET)
    assert rig.drive(400).gate.state is D


def test_disarming_a_disarmed_gate_ends_auto_arm():
    rig = Rig(auto_arm=True)
    rig.request(Verb.DISARM, echo=False)
    assert rig.drive(400).gate.state is D


def test_arming_by_an_operator_does_not_switch_auto_arm_on():
    rig = Rig().armed().drive(100)
    rig.silence(10_400)
    assert rig.gate.state is D
    assert rig.drive(400).gate.state is D


# --- earlier requests --------------------------------------------------------------------------------------------


def ask(rig, verb=Verb.ARM):
    """A request as it goes out, to be delivered later or once more: it cites a status of now."""
    rig._frame += 1
    rig.gate.issued.add("status", rig._frame, rig.now_us)
    cited = Echo(channel="status", session=ROBOT, seq=rig._frame, t_us=rig.now_us)
    return RequestHeader(source="operator", session=OTHER, seq=rig._frame, echo=cited), Request(id=1, verb=verb)


def stale(rig, asked):
    with pytest.raises(WireError) as caught:
        rig.gate.request(*asked, rig.now_us)
    return caught.value.reason is RejectReason.STALE


@pytest.mark.parametrize("how", LEAVING)
def test_request_from_before_the_loss_of_an_operator_does_not_arm(how):
    rig = Rig().armed().drive(100, 0.2)
    asked = ask(rig)
    assert rig.gate.request(*asked, rig.now_us) == "already armed"
    LEAVING[how](rig)
    rig.silence(500)
    rig.request(Verb.RESET)
    rig.drive(100)
    assert stale(rig, asked) and rig.gate.state is D
    assert rig.request(Verb.ARM) == "armed"


@pytest.mark.parametrize("how", ["stop", "disarm", "release", "lost"])
def test_request_from_before_the_loss_does_not_arm_a_disarmed_robot(how):
    rig = Rig().drive(100)
    asked = ask(rig)
    LEAVING[how](rig)
    rig.request(Verb.RESET)
    rig.drive(100)
    assert stale(rig, asked) and rig.gate.state is D


@pytest.mark.parametrize("how", ["release", "lost"])
def test_loss_of_a_human_before_arming_ends_auto_arm(how):
    rig = Rig(auto_arm=True)
    LEAVING[how](rig)
    assert rig.gate.state is D
    assert rig.drive(400).gate.state is D
    assert rig.request(Verb.ARM) == "armed"


def test_repeated_drive_failure_does_not_prevent_a_reset():
    rig = Rig()
    for state in (S, F):
        rig.gate.stop() if state is S else rig.gate.fault("broken")
        asked = ask(rig, Verb.RESET)
        rig.gate.fault("broken")
        assert rig.gate.state is state
        assert rig.gate.request(*asked, rig.now_us) == "reset; arm to drive"


# --- a drive that takes no speeds --------------------------------------------------------------------------------


SLOW, FAST = Twist(linear_mps=0.1, angular_rad_s=0.0), Twist(linear_mps=0.3, angular_rad_s=0.2)


@pytest.mark.parametrize(("before", "attempted", "applied"), [
    (SLOW, STILL, SLOW), (SLOW, FAST, SLOW), (STILL, FAST, FAST), (STILL, STILL, STILL),
])
def test_wheels_turn_as_before_where_the_drive_took_nothing(before, attempted, applied):
    """From zero, a failed attempt may have reached one wheel of two."""
    gate = Rig().gate
    gate.applied = attempted
    gate.note_drive(before, is_taken=True)
    assert gate.applied == attempted
    gate.note_drive(before, is_taken=False)
    assert gate.applied == applied


def test_reset_needs_a_drive_that_took_zero():
    rig = Rig()
    rig.gate.stop()
    rig.gate.note_drive(STILL, is_taken=False)
    with pytest.raises(WireError) as caught:
        rig.request(Verb.RESET)
    assert (caught.value.reason, caught.value.detail) == (
        RejectReason.NOT_ALLOWED, "the drive takes no speeds; see its error in the robot's log"
    )
    rig.gate.note_drive(STILL, is_taken=True)
    assert rig.request(Verb.RESET) == "reset; arm to drive"
