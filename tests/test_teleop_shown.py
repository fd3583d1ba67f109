"""What teleop shows a person, and a gamepad's stick at the gate: in virtual time."""


from operator_side.teleop_text import live_line
from protocol.messages import STILL, Twist
from tests.teleop_rig import TeleopRig, vision_drives


def test_the_line_says_state_reason_driver_and_fits():
    rig = TeleopRig()
    assert live_line("r1", rig.teleop, 80) == "r1: nothing heard yet"
    rig.run(0.3)
    assert live_line("r1", rig.teleop, 200).startswith("r1 DISARMED: not armed | nobody drives | ")
    rig.hold("i")
    rig.run(1.5)
    line = live_line("r1", rig.teleop, 200)
    assert line.startswith("r1 ACTIVE: driving | you drive | +0.20 m/s +0.00 rad/s | up to 0.20 m/s 1.00 rad/s | frame")
    assert len(live_line("r1", rig.teleop, 30)) == 30
    assert "vision drives" in live_line("r1", vision_drives().teleop, 200)


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
    assert rig.commands == [] and "no picture yet" in live_line("r1", rig.teleop, 200)


def test_a_stick_drives_proportionally_and_its_release_is_zero_at_once():
    rig = TeleopRig().armed()
    rig.teleop.on_stick((0.5, -0.25), rig.now_us)
    rig.run(1.0)
    assert rig.applied == Twist(linear_mps=0.1, angular_rad_s=-0.25)
    rig.teleop.on_stick(None, rig.now_us)
    rig.step()
    assert rig.commands[-1] == (rig.now_us, STILL)
