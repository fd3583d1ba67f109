"""Teleop drives, hands over, takes over and releases: against the robot's own gate in virtual time."""

import pytest

from sightline.operator_side.teleop.control import LEGACY, WASD, Mode
from sightline.protocol.channels import REQUEST, TWIST
from sightline.protocol.codec import decode
from sightline.protocol.messages import STILL, Request, State, Twist, Verb
from tests.operator_side.teleop.fixture import OPERATOR, VISION, TeleopRig, vision_drives

MOVING_MS, ZERO_MS = 120, 150
"""The issue's bounds: a key held to a moving wheel, a key let go of to a zero command."""


# --- driving ---------------------------------------------------------------------------------------------------------


def test_nothing_is_commanded_before_a_key_and_frames_are_acknowledged():
    rig = TeleopRig()
    rig.run(1.0)
    assert rig.commands == [] and rig.requested == [] and rig.acked > 25
    assert rig.state is State.DISARMED


def test_the_first_press_arms_and_drives():
    rig = TeleopRig()
    rig.run(0.3)
    rig.hold("i")
    assert rig.until(lambda: rig.applied.linear_mps > 0.0, 1.0) <= 400
    assert rig.until(lambda: rig.applied.linear_mps == pytest.approx(0.2)) is not None
    assert rig.holder.session == OPERATOR and rig.state is State.ACTIVE
    assert rig.requested.count(Verb.ARM) <= 6


@pytest.mark.parametrize("key", [*"uiojlm,.", "\x1b[A", "\x1b[D"])
def test_a_held_key_moves_the_wheels_within_the_bound(key):
    rig = TeleopRig().armed()
    rig.hold(key)
    assert rig.until(lambda: rig.applied != STILL) <= MOVING_MS
    rig.run(1.5)
    linear, angular = LEGACY.moves[key]
    assert rig.applied == Twist(linear_mps=linear * 0.2, angular_rad_s=angular * 1.0)


@pytest.mark.parametrize("repeat_ms", [15, 33, 50, 90])
@pytest.mark.parametrize("offset_ms", [0, 7, 19, 29])
def test_released_key_sends_zero_within_the_bound(repeat_ms, offset_ms):
    rig = TeleopRig().armed()
    rig.hold("u", repeat_us=repeat_ms * 1000)
    rig.run(1.5 + offset_ms / 1000)
    assert rig.applied.linear_mps == pytest.approx(0.2)
    rig.let_go()
    assert rig.until(lambda: rig.commands[-1][1] == STILL) <= ZERO_MS
    assert rig.until(lambda: rig.applied == STILL) <= 350
    rig.run(5)
    assert {twist for us, twist in rig.commands if us > rig.now_us - 4_000_000} == {STILL}
    assert rig.state is State.ACTIVE, "the operator is still the driver"


@pytest.mark.parametrize("key", ["k", " "])
def test_a_stop_key_is_zero_in_the_next_command(key):
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.0)
    rig.let_go()
    rig.tap(key)
    rig.step()
    assert rig.commands[-1] == (rig.now_us, STILL)


def test_default_layout_drives_stops_and_quits():
    rig = TeleopRig(layout=WASD).armed("w")
    rig.hold("a")
    rig.run(1.5)
    assert rig.applied == Twist(linear_mps=0.0, angular_rad_s=1.0)
    rig.let_go()
    rig.tap(" ")
    rig.step()
    assert rig.commands[-1] == (rig.now_us, STILL)
    assert not rig.teleop.wants_to_quit
    rig.tap("q")
    assert rig.teleop.wants_to_quit


def test_commands_come_at_their_period_while_a_key_repeats():
    rig = TeleopRig().armed()
    rig.hold("i", repeat_us=15_000)
    rig.run(1.0)
    count = len(rig.commands)
    rig.run(1.0)
    assert 30 <= len(rig.commands) - count <= 34


def test_speeds_that_change_in_the_middle_are_driven():
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.0)
    rig.tap("w")
    rig.run(0.5)
    assert rig.applied.linear_mps == pytest.approx(0.22)


def test_restarted_robot_is_driven_by_a_new_press():
    """Its frames are of another session, and it rejects a request that cites an older status."""
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.0)
    rig.restart("000000ff")
    rig.run(1.5)
    assert rig.state is State.DISARMED and rig.applied == STILL, "the key is still held"
    rig.let_go()
    rig.run(1.0)
    rig.hold("i")
    rig.run(1.5)
    assert rig.applied.linear_mps == pytest.approx(0.2)


# --- who drives ------------------------------------------------------------------------------------------------------


def test_tab_hands_over_to_vision_and_commands_end():
    rig = vision_drives()
    assert rig.teleop.mode is Mode.WATCHING and rig.state is State.ACTIVE
    count = len(rig.commands)
    rig.run(1.0)
    assert len(rig.commands) == count


@pytest.mark.parametrize("key", ["u", ",", "k", "\t"])
def test_movement_and_stop_keys_take_over(key):
    rig = vision_drives()
    rig.hold(key)
    assert rig.until(lambda: rig.holder.session == OPERATOR) <= MOVING_MS
    rig.run(1.0)
    linear, angular = LEGACY.moves.get(key, (0, 0))
    assert rig.applied == Twist(linear_mps=linear * 0.2, angular_rad_s=angular * 1.0)


def test_hand_over_without_vision_stops_the_robot_and_notes_it():
    rig = TeleopRig().armed()
    rig.tap("\t")
    rig.run(6.0)
    assert rig.state is State.DISARMED and rig.applied == STILL
    assert "run `sightline vision`" in rig.teleop.note
    assert rig.teleop.mode is Mode.WATCHING


def test_a_movement_key_in_the_middle_of_handing_over_takes_back():
    rig = TeleopRig(vision=True).armed()
    rig.tap("\t")
    rig.run(0.03)
    rig.hold("i")
    rig.run(1.5)
    assert rig.holder.session == OPERATOR and rig.applied.linear_mps == pytest.approx(0.2)


def test_movement_key_right_after_a_hand_over_arms_again():
    """The release is already sent; the next key needs no pause before it."""
    rig = TeleopRig(delay_us=20_000).armed()
    rig.hold("i")
    rig.run(1.0)
    rig.let_go()
    rig.tap("\t")
    rig.run(0.01)
    rig.hold("u")
    rig.run(1.5)
    assert rig.applied.linear_mps == pytest.approx(0.2)


def test_second_hand_over_ignores_an_old_status():
    rig = vision_drives()
    rig.tap("i")
    rig.run(0.01)
    rig.tap("\t")
    rig.teleop.on_status(rig.last_status, rig.now_us)
    rig.run(2.0)
    assert rig.state is State.ACTIVE and rig.holder.session == VISION and rig.teleop.mode is Mode.WATCHING


def test_handing_over_works_on_a_long_link():
    """Replies come later than the next request is sent."""
    rig = TeleopRig(vision=True, delay_us=60_000).armed()
    rig.tap("\t")
    assert rig.until(lambda: rig.holder is not None and rig.holder.session == VISION and rig.applied != STILL, 3.0)


def test_taking_over_begins_its_ramp_at_zero():
    rig = TeleopRig(vision=True).armed()
    rig.hold("i")
    rig.run(1.5)
    rig.let_go()
    rig.tap("\t")
    rig.run(2.0)
    count = len(rig.commands)
    rig.hold("i")
    rig.run(0.05)
    first = rig.commands[count][1]
    assert 0 < first.linear_mps < 0.05


def test_watching_takes_nothing_from_the_driver():
    rig = TeleopRig(vision=True)
    rig.run(1.0)
    assert rig.holder.session == VISION
    assert list(rig.teleop.leave()) == [] and rig.teleop.has_left


# --- what must not move ----------------------------------------------------------------------------------------------


def test_a_stopped_robot_is_not_armed_by_any_key():
    rig = TeleopRig(stopped=True)
    rig.run(0.3)
    rig.hold("i")
    rig.run(2.0)
    assert rig.state is State.STOPPED and rig.applied == STILL
    assert rig.requested == [Verb.ARM] and "reset first" in rig.teleop.note, "requested once, and noted"


@pytest.mark.parametrize("what", ["stop", "disarm"])
def test_key_held_during_a_disarm_does_not_arm_again(what):
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.5)
    getattr(rig.driving.gate, what)()
    rig.run(3.0)
    assert rig.state is (State.STOPPED if what == "stop" else State.DISARMED) and rig.applied == STILL
    rig.let_go()
    rig.run(1.0)
    rig.hold("i")
    rig.run(1.0)
    assert (rig.applied.linear_mps > 0) == (what == "disarm"), "a new press is a new decision; STOP takes a reset"


def test_restored_link_does_not_continue_the_drive():
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.5)
    rig.connected = False
    assert rig.until(lambda: rig.applied == STILL) <= 700
    rig.run(2.0)
    rig.connected = True
    rig.run(2.0)
    assert rig.applied == STILL and rig.state is State.DISARMED


def test_quitting_sends_zero_and_then_releases_the_lease():
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.5)
    rig.let_go()
    for message in rig.teleop.leave():
        rig.send(message)
    rig.run(0.05)
    assert rig.commands[-1][1] == STILL and rig.requested[-1] is Verb.RELEASE
    assert rig.teleop.has_left and rig.holder is None and rig.state is State.DISARMED
    assert rig.driving.gate.reason == "the operator released control; arm again"


@pytest.mark.parametrize("seed", range(20))
def test_on_a_lossy_link_a_release_still_stops_the_robot(seed):
    rig = TeleopRig(loss=0.2, delay_us=20_000, seed=seed)
    rig.run(0.3)
    rig.hold("i")
    assert rig.until(lambda: rig.applied.linear_mps > 0.15, 4.0) is not None
    rig.run(0.013 * seed)
    rig.let_go()
    assert rig.until(lambda: rig.applied == STILL) <= 700 + 500, "a key just pressed is held for its first delay"


def test_second_operator_does_not_take_over():
    rig, other = TeleopRig().armed(), TeleopRig()
    other.driving = rig.driving
    other.teleop.session = "000000dd"
    rig.hold("i")
    for _ in range(700):
        rig.step()
        other.now_us = rig.now_us
        if rig.now_us % 1_000_000 < 4_000:
            other.teleop.on_keys("j", rig.now_us)
    assert rig.holder.session == OPERATOR and rig.applied.linear_mps == pytest.approx(0.2)


# --- STOP ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["\n", "\r"])
def test_enter_latches_stop_and_is_repeated_until_a_status_proves_it(key):
    rig = TeleopRig(loss=0.3).armed()
    rig.hold("i")
    rig.run(1.0)
    rig.let_go()
    rig.tap(key)
    assert rig.teleop.is_stopping and "STOP" in rig.teleop.note
    assert rig.until(lambda: rig.state is State.STOPPED) <= 400
    assert rig.until(lambda: not rig.teleop.is_stopping) <= 1500
    assert rig.applied == STILL and Verb.STOP in rig.requested
    sent = len(rig.requested)
    rig.run(0.5)
    assert len(rig.requested) == sent


def test_enter_counts_among_many_late_keys_and_a_held_key_does_not_drive_on():
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(0.5)
    rig.teleop.on_keys("iiiii\niiii", rig.now_us)
    assert rig.until(lambda: rig.state is State.STOPPED) is not None
    rig.run(1.0)
    assert rig.state is State.STOPPED and rig.applied == STILL


def test_an_answer_to_a_datagram_ends_the_repetition():
    rig = TeleopRig().armed()
    rig.tap("\n")
    rig.teleop.on_stopped()
    assert not rig.teleop.is_stopping and rig.teleop.note == ""


def test_leaving_repeats_a_stop_that_is_not_proven():
    rig = TeleopRig()
    rig.tap("\nq")
    for _ in range(3):
        messages = list(rig.teleop.leave())
        assert [decode(Request, message.payload).verb for message in messages] == [Verb.STOP]
        assert rig.teleop.wants_to_quit and not rig.teleop.has_left
    rig.teleop.on_stopped()
    assert list(rig.teleop.leave()) == [] and rig.teleop.has_left


def test_leaving_while_driving_sends_stop_too_and_waits_for_its_proof():
    rig = TeleopRig().armed()
    rig.tap("\n")
    rig.tap("i")
    messages = list(rig.teleop.leave())
    assert [message.channel for message in messages] == [REQUEST, TWIST, REQUEST]
    for message in messages:
        rig.send(message)
    assert rig.until(lambda: rig.teleop.has_left, 1.0) is not None
    assert rig.state is State.STOPPED and rig.applied == STILL
