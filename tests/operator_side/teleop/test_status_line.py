"""What teleop shows a person, and a gamepad's stick at the gate: in virtual time."""

import pytest

from sightline.operator_side.teleop.control import Speeds, Teleop
from sightline.operator_side.teleop.terminal import live_line
from sightline.protocol.channels import STATUS
from sightline.protocol.messages import STILL, State, Twist, Verb
from sightline.protocol.transports.link import Message
from tests.operator_side.teleop.fixture import PERSON, TeleopRig, vision_drives


def shown(rig, width):
    return live_line("r1", rig.teleop, width, rig.now_us)


def test_the_line_says_state_reason_driver_and_fits():
    rig = TeleopRig()
    assert shown(rig, 80) == "r1: nothing heard yet"
    rig.run(0.3)
    assert shown(rig, 200).startswith("r1 DISARMED: not armed | nobody drives | ")
    rig.hold("i")
    rig.run(1.5)
    line = shown(rig, 200)
    assert line.startswith("r1 ACTIVE: driving | you drive | +0.20 m/s +0.00 rad/s | up to 0.20 m/s 1.00 rad/s | frame")
    assert len(shown(rig, 30)) == 30
    assert "vision drives" in shown(vision_drives(), 200)


def test_a_robot_that_fell_silent_is_not_shown_as_it_was():
    rig = TeleopRig()
    rig.hold("i")
    rig.run(1.0)
    assert "ACTIVE" in shown(rig, 200)
    rig.connected = False
    rig.run(2.0)
    assert shown(rig, 200).startswith("r1: nothing heard for 2 s")
    rig.connected = True
    rig.run(0.5)
    assert shown(rig, 200).startswith("r1 ")


def test_a_robot_of_another_version_is_not_told_to_be_silent():
    rig = TeleopRig()
    rig.run(0.3)
    rig.teleop.on_status(Message(STATUS, "", b"{}", b"{}"), rig.now_us)
    assert "the robot's status is not understood" in shown(rig, 200)
    fresh = Teleop(PERSON, Speeds(0.2, 1.0))
    fresh.on_status(Message(STATUS, "", b"{}", b"{}"), 0)
    assert live_line("r1", fresh, 200, 0).startswith("r1: the robot's status is not understood")


def test_a_press_before_the_first_status_arms_once_it_has_come():
    rig = TeleopRig()
    rig.driving.tick(rig.now_us, None, None)
    rig._tick_due_us += 200_000
    rig.run(0.05)
    rig.hold("i")
    assert rig.until(lambda: rig.applied.linear_mps > 0, 1.0) is not None


def test_without_a_picture_it_is_said_why_nothing_moves():
    rig = TeleopRig()
    rig._frame = lambda: None
    rig.hold("i")
    rig.run(1.0)
    assert rig.commands == [] and "no picture yet" in shown(rig, 200)


def test_a_stick_drives_proportionally_and_its_release_is_zero_at_once():
    rig = TeleopRig().armed()
    rig.teleop.on_stick((0.5, -0.25), rig.now_us)
    rig.run(1.0)
    assert rig.applied == Twist(linear_mps=0.1, angular_rad_s=-0.25)
    rig.teleop.on_stick(None, rig.now_us)
    rig.step()
    assert rig.commands[-1] == (rig.now_us, STILL)


@pytest.mark.parametrize("act", ["k", " ", "a"])
def test_a_stick_that_was_held_when_a_key_stopped_it_drives_only_once_pressed_anew(act):
    rig = TeleopRig(vision=True).armed()
    rig.teleop.on_stick((1.0, 0.0), rig.now_us)
    rig.run(0.5)
    rig.tap(act)
    asked = len(rig.asked)
    for _ in range(100):  # a stick that jitters, its button held or jammed
        rig.teleop.on_stick((0.99, 0.01), rig.now_us)
        rig.run(0.01)
    assert all(twist == STILL for us, twist in rig.commands if us > rig.now_us - 900_000)
    assert act == "a" or Verb.ARM not in rig.asked[asked:], "handing over arms whoever else drives"
    rig.teleop.on_stick(None, rig.now_us)
    rig.teleop.on_stick((1.0, 0.0), rig.now_us)
    assert rig.until(lambda: rig.applied.linear_mps == pytest.approx(0.2), 2.0) is not None


@pytest.mark.parametrize("pile", ["i" * 90, "sightline arm", "iiiii", "\x1b[A" * 6])
def test_a_pile_of_keys_of_one_read_neither_arms_nor_drives(pile):
    """What a link that stalled hands over at once, or a paste."""
    rig = TeleopRig()
    rig.run(0.5)
    rig.tap(pile)
    rig.run(2.0)
    assert Verb.ARM not in rig.asked and {twist for _, twist in rig.commands} <= {STILL} and rig.state is State.DISARMED


@pytest.mark.parametrize("pile", ["x" * 256, "iiii k iii"])
def test_what_comes_just_behind_a_pile_is_of_it(pile):
    """A second read, or a second segment of the link that stalled."""
    rig = TeleopRig()
    rig.run(0.5)
    for text in (pile, "hi", "i"):
        rig.tap(text)
        rig.run(0.1)
    rig.run(1.0)
    assert Verb.ARM not in rig.asked and {twist for _, twist in rig.commands} <= {STILL} and rig.state is State.DISARMED
    rig.hold("i")
    assert rig.until(lambda: rig.applied.linear_mps > 0, 1.0) is not None, "hands on the keyboard drive"


def test_a_pile_of_keys_lets_go_of_what_was_held_and_a_stop_in_it_stops():
    for pile in ("i" * 30, "iiii k iii"):
        rig = TeleopRig().armed()
        rig.hold("i")
        rig.run(1.0)
        rig.let_go()
        rig.tap(pile)
        rig.step()
        assert rig.until(lambda: rig.applied == STILL, 1.0) is not None  # noqa: B023
        rig.run(0.5)
        assert rig.commands[-1][1] == STILL


def test_a_key_still_held_after_a_pile_drives_without_arming():
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.0)
    asked = len(rig.asked)
    rig.tap("i" * 30)
    rig.run(1.0)
    assert rig.applied.linear_mps == pytest.approx(0.2) and rig.asked[asked:] == []
