"""Every number and branch of the lease in the gate: just inside, at the bound, just outside."""

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import STILL, AnswerHeader, Echo, Holder, Request, RequestHeader, Verb
from sightline.protocol.proof import session_digest
from sightline.robot_side.safety.gate import Decision, SafetyGate
from sightline.robot_side.safety.limits import SafetyConfig
from tests.fixtures.safety import (
    HUMAN,
    HUMAN_HOLDER,
    OTHER,
    ROBOT,
    VISION,
    VISION_HOLDER,
    A,
    D,
    H,
    Rig,
    driving,
    refused,
)

# --- lease: acquire, release, losing a human ---------------------------------------------------------------------


@pytest.mark.parametrize(("now_us", "held"), [(999_999, True), (1_000_000, False)])
def test_the_holder_holds_for_the_lease(now_us, held):
    rig = Rig()
    rig.offer()
    assert rig.gate.holder(rig.now_us + now_us) == (VISION_HOLDER if held else None)


def test_acquire_takes_the_lease_ahead_of_the_first_command():
    rig = Rig()
    assert rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN) == "acquired"
    assert rig.gate.holder(rig.now_us) == HUMAN_HOLDER
    assert "0 of 5" in refused(rig, Verb.ARM, source="teleop", session=HUMAN).detail
    assert rig.offer().reason is RejectReason.NOT_HOLDER
    for source, session in [("teleop", OTHER), ("vision", VISION), ("operator", OTHER)]:
        error = refused(rig, Verb.ACQUIRE, source=source, session=session)
        shown = f"teleop {session_digest('teleop', HUMAN)} drives"
        assert (error.reason, error.detail) == (RejectReason.NOT_HOLDER, shown)
    error = refused(Rig(), Verb.ACQUIRE, source="operator")
    assert (error.reason, error.detail) == (RejectReason.NOT_HOLDER, "operator may not drive")


def test_acquiring_again_renews_nothing():
    rig = Rig()
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    rig.silence(500)
    assert rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN) == "already held"
    rig.silence(480)
    assert rig.gate.holder(rig.now_us) == HUMAN_HOLDER
    assert rig.gate.holder(rig.now_us + 20_000) is None


def test_robot_ignores_the_former_driver_after_acquire():
    rig = Rig().armed().drive(400)
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    assert rig.step().state is H


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.RESET, Verb.ACQUIRE])
@pytest.mark.parametrize("denial", ["stop", "disarm"])
def test_request_from_before_a_stop_or_disarm_does_not_undo_it(verb, denial):
    rig = Rig().armed()
    rig.gate.issued.add("status", 70, rig.now_us)
    getattr(rig.gate, denial)()
    for seq, reason in ((70, RejectReason.STALE), (71, None)):
        rig.gate.issued.add("status", seq, rig.now_us)
        cited = Echo(channel="status", session=ROBOT, seq=seq, t_us=rig.now_us)
        header = RequestHeader(source="teleop", session=HUMAN, seq=seq, echo=cited)
        try:
            rig.gate.request(header, Request(id=1, verb=verb), rig.now_us)
        except WireError as error:
            expected = "cites a status from before the last STOP or disarm; repeat the request"
            assert reason is None or error.detail == expected
            assert reason is None or error.reason is reason
        else:
            assert reason is None


def test_a_request_cites_a_status_and_no_frame():
    rig = Rig()
    header = RequestHeader(source="operator", session=HUMAN, seq=0, echo=rig.frame())
    with pytest.raises(WireError) as caught:
        rig.gate.request(header, Request(id=1, verb=Verb.RESET), rig.now_us)
    assert caught.value.reason is RejectReason.MALFORMED


def test_human_silent_after_acquire_counts_as_lost():
    rig = Rig().armed().drive(100)
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    rig.silence(980)
    assert rig.gate.state is H
    assert rig.step(20) == Decision(STILL, D, "the operator who drove was lost; arm again")


@pytest.mark.parametrize(
    ("silent_us", "reason"), [(999_999, RejectReason.NOT_HOLDER), (1_000_000, RejectReason.DISARMED)]
)
def test_no_driver_follows_a_human_lost_between_two_ticks(silent_us, reason):
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.now_us += silent_us
    assert rig.offer().reason is reason
    assert (rig.gate.state is D) == (reason is RejectReason.DISARMED)
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.now_us += 1_000_000
    rig.request(Verb.ACQUIRE, source="vision", session=VISION)
    assert (rig.gate.state, rig.gate.reason) == (D, "the operator who drove was lost; arm again")


def test_commands_of_one_driver_do_not_arm_for_another_driver():
    rig = Rig()
    for _ in range(4):
        rig.offer()
    rig.request(Verb.ACQUIRE, source="vision", session=VISION)
    rig.offer()
    assert rig.gate._missing_to_arm(rig.now_us) == "", "its own stay"
    rig.request(Verb.ACQUIRE, source="teleop", session=HUMAN)
    assert "0 of 5" in refused(rig, Verb.ARM, source="teleop", session=HUMAN).detail


def test_release_gives_the_lease_back():
    rig = driving(A)
    assert rig.request(Verb.RELEASE, source="vision", session=OTHER, echo=False) == "not held"
    assert rig.request(Verb.RELEASE, source="teleop", session=VISION, echo=False) == "not held"
    assert rig.gate.holder(rig.now_us) == VISION_HOLDER
    assert rig.request(Verb.RELEASE, source="vision", session=VISION, echo=False) == "released"
    assert rig.gate.holder(rig.now_us) is None and rig.gate.state is A
    assert rig.step().reason == "armed; no command yet"
    assert rig.offer(session=OTHER).accepted


def test_release_by_the_human_holder_disarms():
    rig = driving(A).drive(60, source="teleop", session=HUMAN)
    assert rig.request(Verb.RELEASE, source="teleop", session=HUMAN, echo=False) == "released"
    assert (rig.gate.state, rig.gate.reason) == (D, "the operator released control; arm again")
    assert rig.gate.holder(rig.now_us) is None


@pytest.mark.parametrize(("silent_us", "lost"), [(999_999, False), (1_000_000, True)])
def test_a_human_is_lost_when_the_lease_runs_out(silent_us, lost):
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.now_us += silent_us
    decision = rig.gate.step(rig.now_us)
    assert (decision.state is D) == lost
    assert (decision.reason == "the operator who drove was lost; arm again") == lost
    vision = driving(A)
    vision.offer()
    vision.now_us += silent_us
    assert vision.gate.step(vision.now_us).state is H


def test_a_lost_human_is_lost_once():
    rig = driving(A)
    rig.offer(source="teleop", session=HUMAN)
    rig.silence(1_100)
    rig.armed()
    assert rig.step().state is H


@pytest.mark.parametrize(("guests", "reason"), [(True, RejectReason.DISARMED), (False, RejectReason.UNKNOWN_SOURCE)])
def test_a_guest_with_a_header_is_a_guest(guests, reason):
    gate = SafetyGate(SafetyConfig(guests=guests), ROBOT)
    gate.issued.add("frame", 0, 0)
    cited = Echo(channel="frame", session=ROBOT, seq=0, t_us=0)
    named = AnswerHeader(source="guest", session="0000eeee", seq=0, echo=cited)
    assert gate.offer("guest", named, STILL, 0).reason is reason
    if not guests:
        return
    assert gate.holder(0) == Holder(source="guest", session="0000eeee")


def test_replayed_twist_is_rejected_after_any_number_of_rejected_sessions():
    rig = Rig().armed().drive(60)
    sent = rig.header()
    assert rig.offer(header=sent).accepted
    for number in range(200):
        rejected = rig.offer(header=rig.header(session=f"{number:08x}", seq=1))
        assert rejected.reason is RejectReason.NOT_HOLDER
    assert rig.offer(header=sent).reason is RejectReason.OUT_OF_ORDER
