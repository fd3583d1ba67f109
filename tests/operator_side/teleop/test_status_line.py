"""The status lines of teleop, and a gamepad's stick at the gate, in virtual time."""

import re

import pytest

from sightline.operator_side.teleop.control import LAYOUTS, QUIT, SWITCH, Speeds, Teleop
from sightline.operator_side.teleop.terminal import live_lines
from sightline.protocol.channels import STATUS
from sightline.protocol.messages import STILL, State, Twist, Verb
from sightline.protocol.transports.link import Message
from tests.operator_side.teleop.fixture import OPERATOR, TeleopRig, vision_drives

ARROWS = ("\x1b[A", "\x1b[B", "\x1b[C", "\x1b[D")


def shown(rig, width):
    return "\n".join(live_lines("r1", rig.teleop, width, rig.now_us))


def test_lines_show_state_reason_driver_and_fit_the_width():
    rig = TeleopRig()
    assert shown(rig, 80) == "r1: no status yet; `sightline robots` lists the robots\n"
    rig.run(0.3)
    assert shown(rig, 200).startswith("r1 DISARMED: not armed\nno driver | ")
    rig.hold("i")
    rig.run(1.5)
    first, second = shown(rig, 80).split("\n")
    assert first == "r1 ACTIVE: driving"
    assert re.fullmatch(r"you drive \| frame \d+ ms \| \+0.20 m/s \+0.00 rad/s \| up to 0.20 m/s 1.00 rad/s", second)
    assert [len(line) for line in shown(rig, 15).split("\n")] == [15, 15]
    assert "vision drives" in shown(vision_drives(), 200)


def test_text_of_a_robot_does_not_control_the_terminal():
    rig = TeleopRig()
    rig.teleop.note = "\x1b]0;mine\x07"
    assert shown(rig, 80) == "r1: ?]0;mine?\n"


@pytest.mark.parametrize("layout", LAYOUTS)
def test_help_names_every_key_and_fits_eighty_columns(layout):
    layout = LAYOUTS[layout]
    assert max(map(len, layout.help.splitlines())) < 80
    names = {" ": "Space", "\t": "Tab", "=": "+", "\x1b[E": ""}
    for key in (*layout.moves, *layout.speeds, *layout.stops, SWITCH, QUIT):
        name = "arrow" if key in ARROWS else names.get(key, key)
        assert re.search(rf"(^|\s){re.escape(name)}(\s|$)", layout.help.replace("arrows", "arrow")), key


def test_silent_robot_is_not_shown_with_its_old_state():
    rig = TeleopRig()
    rig.hold("i")
    rig.run(1.0)
    assert "ACTIVE" in shown(rig, 200)
    rig.connected = False
    rig.run(2.0)
    assert shown(rig, 200).startswith("r1: no status for 2 s")
    rig.hold("\n")
    rig.run(0.3)
    assert shown(rig, 200).endswith("\nSTOP is not confirmed, repeating")
    rig.connected = True
    rig.run(0.5)
    assert shown(rig, 200).startswith("r1 ")


def test_robot_of_another_version_is_not_reported_silent():
    rig = TeleopRig()
    rig.run(0.3)
    rig.teleop.on_status(Message(STATUS, "", b"{}", b"{}"), rig.now_us)
    assert "invalid status from the robot" in shown(rig, 200)
    fresh = Teleop(OPERATOR, Speeds(0.2, 1.0))
    fresh.on_status(Message(STATUS, "", b"{}", b"{}"), 0)
    assert live_lines("r1", fresh, 200, 0)[0].startswith("r1: invalid status from the robot")


def test_press_before_the_first_status_arms_after_it():
    rig = TeleopRig()
    rig.driving.tick(rig.now_us, None, None)
    rig._tick_due_us += 200_000
    rig.run(0.05)
    rig.hold("i")
    assert rig.until(lambda: rig.applied.linear_mps > 0, 1.0) is not None


def test_missing_image_is_reported():
    rig = TeleopRig()
    rig._frame = lambda: None
    rig.hold("i")
    rig.run(1.0)
    assert rig.commands == [] and "no image yet" in shown(rig, 200)


def test_stick_drives_proportionally_and_its_release_is_zero():
    rig = TeleopRig().armed()
    rig.teleop.on_stick((0.5, -0.25), rig.now_us)
    rig.run(1.0)
    assert rig.applied == Twist(linear_mps=0.1, angular_rad_s=-0.25)
    rig.teleop.on_stick(None, rig.now_us)
    rig.step()
    assert rig.commands[-1] == (rig.now_us, STILL)


@pytest.mark.parametrize("act", ["k", " ", "\t"])
def test_stick_held_during_a_stop_key_drives_only_after_a_new_press(act):
    rig = TeleopRig(vision=True).armed()
    rig.teleop.on_stick((1.0, 0.0), rig.now_us)
    rig.run(0.5)
    rig.tap(act)
    before = len(rig.requested)
    for _ in range(100):  # a stick that jitters, its button held or jammed
        rig.teleop.on_stick((0.99, 0.01), rig.now_us)
        rig.run(0.01)
    assert all(twist == STILL for us, twist in rig.commands if us > rig.now_us - 900_000)
    assert act == "\t" or Verb.ARM not in rig.requested[before:], "a hand-over arms the vision service"
    rig.teleop.on_stick(None, rig.now_us)
    rig.teleop.on_stick((1.0, 0.0), rig.now_us)
    assert rig.until(lambda: rig.applied.linear_mps == pytest.approx(0.2), 2.0) is not None


@pytest.mark.parametrize("pile", ["i" * 90, "sightline arm", "iiiii", "\x1b[A" * 6])
def test_many_keys_of_one_read_neither_arm_nor_drive(pile):
    """They come from a stalled link or a paste."""
    rig = TeleopRig()
    rig.run(0.5)
    rig.tap(pile)
    rig.run(2.0)
    assert Verb.ARM not in rig.requested and rig.state is State.DISARMED
    assert {twist for _, twist in rig.commands} <= {STILL}


@pytest.mark.parametrize("pile", ["x" * 256, "iiii k iii"])
def test_keys_shortly_after_many_keys_do_not_drive(pile):
    """They are a second read, or a second segment of the stalled link."""
    rig = TeleopRig()
    rig.run(0.5)
    for text in (pile, "hi", "i"):
        rig.tap(text)
        rig.run(0.1)
    rig.run(1.0)
    assert Verb.ARM not in rig.requested and rig.state is State.DISARMED
    assert {twist for _, twist in rig.commands} <= {STILL}
    rig.hold("i")
    assert rig.until(lambda: rig.applied.linear_mps > 0, 1.0) is not None, "hands on the keyboard drive"


def test_many_keys_release_the_held_key_and_a_stop_among_them_stops():
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


def test_key_still_held_after_many_keys_drives_without_arming():
    rig = TeleopRig().armed()
    rig.hold("i")
    rig.run(1.0)
    before = len(rig.requested)
    rig.tap("i" * 30)
    rig.run(1.0)
    assert rig.applied.linear_mps == pytest.approx(0.2) and rig.requested[before:] == []
