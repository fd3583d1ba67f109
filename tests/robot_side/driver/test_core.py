"""The driver core: what a message changes, which credit it returns, and when each message leaves."""

import array
import math
import re
from collections import Counter
from contextlib import nullcontext
from random import Random

import pytest

from sightline.protocol.channels import ODOMETRY, REPLY, REQUEST, SCAN, STATUS, TWIST
from sightline.protocol.codec import decode, decode_ranges, encode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import (
    STILL,
    AnswerHeader,
    Echo,
    Holder,
    LastRejection,
    LeaseHolder,
    Odometry,
    Reply,
    Request,
    RequestHeader,
    ScanHeader,
    Stamp,
    State,
    Status,
    StreamStatus,
    Twist,
    Verb,
)
from sightline.protocol.proof import ProofChain, session_digest
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.robot_side.pipe import CommandAck, RobotMotion
from sightline.robot_side.ports import Ranges, WheelAngles
from sightline.robot_side.safety.limits import SafetyConfig

ROBOT, VISION = "0000000a", "0000000b"
NOW_US = 10_000_000
LOG = {"drive": PluginChoice(kind="log"), "camera": PluginChoice(kind="folder")}
WHEELS = DiffDriveConfig(wheel_radius_m=0.05, track_width_m=0.2, max_wheel_rad_s=22.0)


def core_of(*, stopped=False, **changes):
    return DriverCore(RobotConfig(**{**LOG, "wheels": WHEELS, **changes}), ROBOT, stopped=stopped)


def echo_of(seq=7, t_us=NOW_US, session=ROBOT, channel="frame"):
    return Echo(channel=channel, session=session, seq=seq, t_us=t_us)


def twist(payload=b"0.1|0.2", *, number=1, compute_us=900, header=None, proof=None, **echo):
    answer = AnswerHeader(
        source="vision", session=VISION, seq=number, echo=echo_of(**echo), compute_us=compute_us, proof=proof
    )  # fmt: skip
    return Message(TWIST, "vision", encode(answer) if header is None else header, payload)


def request(verb, *, number=1, source="operator", key=None, echo=None, payload=None):
    header = RequestHeader(source=source, session="0000000c", seq=number, echo=echo)
    return Message(REQUEST, key or source, encode(header), payload or encode(Request(id=number, verb=verb)))


def sent(core, now_us, channel):
    """Return the messages of a channel that leave now."""
    return [message for message in core.messages(now_us) if message.channel is channel]


def status_of(core, now_us):
    (message,) = sent(core, now_us, STATUS)
    return decode(Status, message.payload, STATUS.max_payload_bytes)


def armed(core, count=5):
    """Let vision command until the core arms by itself; each command answers a frame of its own."""
    for number in range(1, count + 1):
        core.on_issued(number, NOW_US, number)
        core.on_twist(twist(number=number, seq=number), NOW_US)
    return core


AUTO = {"safety": SafetyConfig(auto_arm=True)}


# --- commands ----------------------------------------------------------------------------------------------------


def test_command_for_a_frame_of_this_robot_returns_its_credit_and_names_the_holder():
    """Also where it is rejected: its frame was answered."""
    core = core_of()
    core.on_issued(7, NOW_US, 0)
    holder = Holder(source="vision", session=VISION)
    assert core.on_twist(twist(), NOW_US) == CommandAck(holder, 7, 900, holder)
    assert core.gate.last_rejection.reason == "DISARMED"
    assert core.on_twist(twist(), NOW_US) == CommandAck(holder, 7, 900, holder), "once more: OUT_OF_ORDER"
    assert core.gate.last_rejection.reason == "OUT_OF_ORDER"


@pytest.mark.parametrize(("changes", "reason"), [
    ({"session": "0000000f"}, "OTHER_SESSION"), ({"seq": 8}, "UNKNOWN_FRAME"), ({"t_us": NOW_US + 1}, "UNKNOWN_FRAME"),
    ({"header": b"{}"}, "MALFORMED"), ({"header": b"x" * 600}, "MALFORMED"), ({"payload": b"0.1"}, "MALFORMED"),
    ({"payload": b"1" * 65}, "MALFORMED"), ({"header": b""}, "MALFORMED"),
])  # fmt: skip
def test_command_that_cites_nothing_of_this_robot_returns_no_credit(changes, reason):
    core = core_of()
    core.on_issued(7, NOW_US, 0)
    assert core.on_twist(twist(**changes), NOW_US) is None
    assert (core.gate.last_rejection.source, core.gate.last_rejection.reason) == ("vision", reason)
    assert core.gate.counters[reason] == 1


@pytest.mark.parametrize("key", ["teleop", "viewer"])
def test_command_under_the_key_of_another_source_returns_no_credit(key):
    core = core_of()
    core.on_issued(7, NOW_US, 0)
    assert core.on_twist(Message(TWIST, key, twist().header, b"0|0"), NOW_US) is None
    assert core.gate.last_rejection.reason == "UNKNOWN_SOURCE"


def test_command_for_a_frame_of_the_future_returns_no_credit_and_for_a_stale_one_does():
    core = core_of()
    core.on_issued(7, NOW_US, 0)
    assert core.on_twist(twist(), NOW_US - 1) is None
    assert core.gate.last_rejection.reason == "FROM_FUTURE"
    assert core.on_twist(twist(number=2), NOW_US + 9_000_000) is not None
    assert core.gate.last_rejection.reason == "STALE"


def test_lease_ends_with_the_token_of_the_driver():
    core, chain = core_of(), ProofChain(Random(1).randbytes)
    core.on_token(chain.token, True, NOW_US)
    core.on_issued(7, NOW_US, 0)
    core.on_twist(twist(proof=chain.next().proof), NOW_US)
    core.on_token("0" * 32, False, NOW_US)
    assert core.gate.holder(NOW_US) is not None
    core.on_token(chain.token, False, NOW_US)
    assert core.gate.holder(NOW_US) is None


def test_command_without_a_proof_returns_no_credit():
    core = core_of()
    core.gate._needs_proof = True
    core.on_issued(7, NOW_US, 0)
    assert core.on_twist(twist(), NOW_US) is None
    assert core.gate.last_rejection.reason == "NOT_PROVEN"


def test_large_header_is_rejected_by_its_size():
    """Spaces after the object are valid JSON, so only the bound rejects it."""
    core = core_of()
    core.on_issued(7, NOW_US, 0)
    header = twist().header
    assert core.on_twist(twist(header=header + b" " * (513 - len(header))), NOW_US) is None
    assert core.on_twist(twist(header=header + b" " * (512 - len(header))), NOW_US) is not None
    padded = encode(Request(id=1, verb=Verb.STOP))
    core.on_request(request(Verb.STOP, payload=padded + b" " * (REQUEST.max_payload_bytes + 1 - len(padded))), NOW_US)
    assert core.gate.state is State.DISARMED and core.gate.last_rejection.source == "operator"


def test_guest_without_a_header_is_offered_to_the_gate():
    core = core_of(safety=SafetyConfig(guests=True))
    assert core.on_twist(Message(TWIST, "guest", b"", b"0.1|0"), NOW_US) is None
    assert core.gate.last_rejection.reason == "DISARMED" and core.gate.holder(NOW_US).source == "guest"


def test_frozen_image_makes_its_command_stale():
    """Each frame has the image of the first one."""
    core = core_of()
    for seq, t_us in ((1, NOW_US), (2, NOW_US + 2_000_000)):
        core.on_issued(seq, t_us, 77)
    core.on_twist(twist(seq=2, t_us=NOW_US + 2_000_000), NOW_US + 2_000_000)
    assert core.gate.last_rejection.reason == "STALE"


# --- the wheels --------------------------------------------------------------------------------------------------


def test_tick_steps_the_gate_and_returns_its_twist_as_wheel_speeds():
    core = armed(core_of(**AUTO))
    core.tick(NOW_US, None, None)
    core.on_issued(9, NOW_US, 9)
    core.on_twist(twist(number=9, seq=9), NOW_US)
    for step in range(1, 10):
        speeds = core.tick(NOW_US + step * 20_000, None, None)
    assert core.gate.applied == Twist(linear_mps=0.1, angular_rad_s=0.2) and not core.at_rest
    assert speeds == pytest.approx(((0.1 - 0.02) / 0.05, (0.1 + 0.02) / 0.05))
    assert core.motion().applied == (0.1, 0.2)


def test_tick_compares_the_encoders_with_the_speeds_of_the_tick_before():
    core = armed(core_of(**AUTO))
    assert core.doubtful_wheel == ""
    doubts = []
    for step in range(1, 250):
        now_us = NOW_US + step * 20_000
        core.on_issued(9 + step, now_us, 9 + step)
        core.on_twist(twist(number=9 + step, seq=9 + step, t_us=now_us), now_us)
        core.tick(now_us, WheelAngles(0.0, 2.4 * step * 0.02, now_us), None)
        doubts.append(core.doubtful_wheel)
    found = [doubt for doubt in doubts if doubt]
    assert found[0].startswith("left wheel turned 0 rad where ") and len(found) == 1
    core.tick(now_us + 20_000, WheelAngles(0.0, 1000.0, now_us + 20_000), None)
    assert core.doubtful_wheel.startswith("right wheel jumped by ")
    core.tick(now_us + 40_000, None, None)
    assert core.doubtful_wheel == ""


@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("jump_rad", [-1e6, -10.0, 10.0, 1000.0])
@pytest.mark.parametrize("back_at", [13, 99])
def test_jump_of_an_encoder_does_not_enter_the_odometry(side, jump_rad, back_at):
    """A counter that wraps does not come back, a loose wire does. The next steps count."""
    cores = core_of(), core_of()
    for step in range(40):
        now_us, angles = NOW_US + step * 20_000, [0.04 * step, 0.05 * step]
        cores[0].tick(now_us, WheelAngles(*angles, now_us), None)
        angles[side] += jump_rad * (10 <= step < back_at)
        cores[1].tick(now_us, WheelAngles(*angles, now_us), None)
        true, jumped = (core.motion() for core in cores)
        assert jumped.pose == pytest.approx(true.pose, abs=0.015)
        assert jumped.moving == pytest.approx(true.moving)
    assert true.pose[0] > 0.07


@pytest.mark.parametrize("broken", [math.inf, -math.inf, math.nan])
def test_angle_that_is_not_finite_is_an_error_and_no_jump(broken):
    core = core_of()
    for step, angle_rad in enumerate([0.0, 0.04, broken, broken, 0.08]):
        wheels = WheelAngles(angle_rad, 0.04, NOW_US + step * 20_000)
        if math.isfinite(angle_rad):
            core.tick(wheels.t_us, wheels, None)
        else:
            with pytest.raises(ValueError, match="not finite"):
                core.tick(wheels.t_us, wheels, None)
        assert core.doubtful_wheel == ""
    core.tick(wheels.t_us + 20_000, WheelAngles(50.0, 0.04, wheels.t_us + 20_000), None)
    assert "left wheel jumped" in core.doubtful_wheel


def test_tick_reads_the_wheels_and_the_motion_is_bounded():
    core = core_of()
    assert core.motion() == RobotMotion() and core.at_rest
    for t_us, angle in ((0, 0.0), (50_000, 0.5)):
        core.tick(NOW_US, WheelAngles(angle, angle * 1.2, t_us), None)
    core.tick(NOW_US, None, None)
    x_m, y_m, yaw_rad = core.motion().pose
    assert (x_m, yaw_rad) == pytest.approx((0.0275, 0.025), abs=1e-4) and 0 < y_m < 0.001
    assert core.motion().moving == pytest.approx((0.55, 0.5))
    core.odometer.update(WheelAngles(-4e9, 4e9, 10_000_000_000))
    core.odometer.update(WheelAngles(-4e9 + 2e8, 4e9 + 2e8, 10_000_050_000))
    assert all(abs(value) <= 1e6 for value in (*core.motion().pose, *core.motion().moving))


@pytest.mark.parametrize(("pose", "moving", "expected"), [
    ((2e6, -3e6, 3.0), (4e6, -5e6), ((1e6, -1e6, 3.0), (1e6, -1e6))),
    ((-2e6, 3e6, -3.0), (-4e6, 5e6), ((-1e6, 1e6, -3.0), (-1e6, 1e6))),
    ((1e6, -1e6, 0.5), (0.25, -0.5), ((1e6, -1e6, 0.5), (0.25, -0.5))),
])  # fmt: skip
def test_motion_stays_within_the_numbers_of_the_wire(pose, moving, expected):
    class Odometer:
        pass

    core = armed(core_of(**AUTO))
    core.tick(NOW_US, None, None)
    core.odometer = Odometer()
    core.odometer.pose, core.odometer.moving = pose, moving
    core.on_issued(9, NOW_US - 84_000, 9)
    core.on_twist(twist(number=9, seq=9, t_us=NOW_US - 84_000), NOW_US)
    assert core.motion() == RobotMotion(*expected, (0.0, 0.0), 84_000)


# --- requests ----------------------------------------------------------------------------------------------------


def reply_of(core, message, now_us=NOW_US):
    core.on_request(message, now_us)
    (reply,) = sent(core, now_us, REPLY)
    return reply, decode(Reply, reply.payload)


def test_request_is_carried_out_and_replied_to():
    core = core_of()
    message, reply = reply_of(core, request(Verb.STOP, number=4))
    assert reply == Reply(to=session_digest("operator", "0000000c"), id=4, ok=True, state="STOPPED", detail="STOPPED")
    assert message == Message(REPLY, "", encode(Stamp(session=ROBOT, seq=0, t_us=NOW_US)), encode(reply))
    assert core.gate.state is State.STOPPED
    assert decode(Stamp, reply_of(core, request(Verb.STOP, number=5))[0].header).seq == 1


def test_rejected_request_is_counted_and_its_reply_names_the_reason():
    core = core_of()
    _, reply = reply_of(core, request(Verb.ARM))
    assert not reply.ok and reply.state == "DISARMED"
    assert reply.detail == "MALFORMED: a request that permits motion must cite a status"
    assert core.gate.counters == {"MALFORMED": 1}

    def reject(*_arguments):
        raise WireError(RejectReason.NOT_ALLOWED, "x" * 300)

    core.gate.request = reject
    assert reply_of(core, request(Verb.ARM))[1].detail == "NOT_ALLOWED: " + "x" * 187


def test_request_under_the_key_of_another_source_is_rejected():
    core = core_of()
    _, reply = reply_of(core, request(Verb.STOP, key="teleop"))
    assert not reply.ok and reply.detail.startswith("UNKNOWN_SOURCE") and core.gate.state is State.DISARMED
    assert core.gate.last_rejection.source == "teleop"


@pytest.mark.parametrize("message", [
    Message(REQUEST, "operator", b"{}", encode(Request(id=1, verb=Verb.STOP))), request(Verb.STOP, payload=b"{}"),
])  # fmt: skip
def test_invalid_request_has_no_reply(message):
    core = core_of()
    core.on_request(message, NOW_US)
    assert sent(core, NOW_US, REPLY) == [] and core.gate.counters == {"MALFORMED": 1}
    assert core.gate.last_rejection.source == "operator"


def test_request_may_cite_a_status_of_this_robot():
    core = core_of()
    for after_us in (0, 50_000, 100_000):  # odometry is counted beside it
        statuses = sent(core, NOW_US + after_us, STATUS)
    stamp = decode(Stamp, statuses[0].header)
    _, reply = reply_of(core, request(Verb.ARM, echo=Echo.of(stamp)), NOW_US + 100_001)
    assert reply.detail.startswith("NOT_ALLOWED: no valid commands yet")


# --- messages at their rates -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("channel", "period_us"), [(STATUS, 100_000), (ODOMETRY, 50_000)])
def test_status_and_odometry_leave_at_once_and_then_at_their_periods(channel, period_us):
    core, times_us = core_of(), []
    offsets_us = [0, period_us - 1, period_us, 2 * period_us + 9_000, 3 * period_us - 1, 3 * period_us,
                  9 * period_us + 5, 10 * period_us + 4, 10 * period_us + 5]
    for offset_us in offsets_us:
        for message in sent(core, NOW_US + offset_us, channel):
            times_us.append(offset_us)
            assert decode(Stamp, message.header) == Stamp(
                session=ROBOT, seq=len(times_us) - 1, t_us=NOW_US + offset_us
            )  # fmt: skip
            assert message.source == ""
    assert times_us == [offsets_us[number] for number in (0, 2, 3, 5, 6, 7, 8)], "after a stall one more at once"


@pytest.mark.parametrize(("ahead_us", "named"), [(0, ""), (1_000_000, ""), (1_000_001, "1"), (3_000_000_000, "3e+03")])
def test_wheel_angles_of_another_clock_are_named(ahead_us, named):
    core = core_of()
    wrong = re.escape(f"WheelAngles.t_us is {named} s ahead")
    with pytest.raises(ValueError, match=wrong) if named else nullcontext():
        core.tick(NOW_US, WheelAngles(0.0, 0.0, NOW_US + ahead_us), None)
    for step in range(2):
        core.tick(NOW_US + 2_000_000, WheelAngles(step, step, NOW_US + 1_500_000 + step), None)
    assert core.motion().pose[0] > 0


def test_odometry_is_the_motion():
    core = core_of()
    for t_us, angle in ((0, 0.0), (50_000, 0.5)):
        core.tick(NOW_US, WheelAngles(angle, angle, t_us), None)
    (message,) = sent(core, NOW_US, ODOMETRY)
    assert decode(Odometry, message.payload) == Odometry(pose=core.motion().pose, moving=core.motion().moving)


def test_status_shows_everything():
    core = armed(core_of(**AUTO))
    core.tick(NOW_US, None, None)
    core.on_issued(9, NOW_US - 30_000, 9)
    core.on_twist(twist(number=9, seq=9, t_us=NOW_US - 30_000), NOW_US)
    core.tick(NOW_US, None, None)
    core.stream = StreamStatus(sent=12)
    core.tick_late_max_us, core.network_restarts = 700, 2
    core.rejected_by_transport.update({"MALFORMED": 3, "DISARMED": 1})
    before = core.gate.counters["DISARMED"]
    status = status_of(core, NOW_US + 10_000)
    assert (status.state, status.reason) == (core.gate.state, core.gate.reason)
    assert status.holder == LeaseHolder.of("vision", VISION) and status.applied == core.motion().applied
    assert (status.frame_age_us, status.latency_us, status.accepted) == (40_000, 30_000, 1)
    assert status.refused == {"DISARMED": before + 1, "MALFORMED": 3}
    assert status.last_refusal.reason == "DISARMED" and status.stream == StreamStatus(sent=12)
    assert (status.auto_arm, status.tick_late_max_us, status.network_restarts) == (True, 700, 2)
    assert status.battery_v is None
    safety = core.config.safety
    assert (status.max_linear_mps, status.max_angular_rad_s) == (safety.max_linear_mps, safety.max_angular_rad_s)


def test_status_at_the_start_has_no_counts():
    status = status_of(core_of(), NOW_US)
    assert (status.tick_late_max_us, status.network_restarts, status.refused) == (0, 0, {})
    assert status.last_refusal is None and status.stream == StreamStatus() and status.auto_arm is False


@pytest.mark.parametrize(("reason", "why", "shown"), [
    ("STOP", "", "STOP"), ("STOP", "No space", "STOP; not stored for a restart: No space"),
    ("x" * 201, "", "x" * 200), ("x" * 201, "No space", "x" * 164 + "; not stored for a restart: No space"),
    ("STOP", "y" * 300, ("; not stored for a restart: " + "y" * 300)[:200]),
])
def test_reason_shows_a_latch_that_is_not_on_disk(reason, why, shown):
    core = core_of()
    core.gate.reason, core.latch_failed = reason, why
    assert status_of(core, NOW_US).reason == shown


@pytest.mark.parametrize("state", [State.STOPPED, State.FAULT])
def test_robot_whose_drive_takes_no_speeds_is_not_shown_as_stopped(state):
    """Its wheels may turn since an earlier process, which `applied` does not show."""
    core = core_of()
    core.gate.stop("STOP") if state is State.STOPPED else core.gate.fault("broken")
    reason, core.latch_failed = core.gate.reason, "No space"
    why = "; the drive takes no speeds" if state is State.STOPPED else ""
    for is_taken, shown, more in ((False, State.FAULT, why), (True, state, "")):
        core.gate.note_drive(STILL, is_taken=is_taken)
        status = status_of(core, NOW_US + 10**6 * is_taken)
        assert (status.state, status.reason) == (shown, f"{reason}{more}; not stored for a restart: No space")
        assert core.gate.state is state


def test_status_shows_the_faults():
    core = core_of()
    assert status_of(core, NOW_US).faults == {}
    core.faults = Counter(drive=2, camera=1)
    assert status_of(core, NOW_US + 10**6).faults == {"drive": 2, "camera": 1}


def test_long_reason_is_cut_to_what_the_wire_holds():
    core = core_of()
    core.gate.reason = "x" * 300
    core.gate.last_rejection = LastRejection(source="vision", reason="STALE", detail="old")
    assert status_of(core, NOW_US).reason == "x" * 200


@pytest.mark.parametrize(("stopped", "state"), [(True, "STOPPED"), (False, "DISARMED")])
def test_stop_of_before_the_restart_is_still_set(stopped, state):
    assert status_of(core_of(stopped=stopped), NOW_US).state == state


def test_default_is_not_stopped():
    assert DriverCore(RobotConfig(**LOG), ROBOT).gate.state is State.DISARMED


# --- the battery -------------------------------------------------------------------------------------------------


def test_battery_is_shown_and_limits_the_speed():
    core = core_of(battery=PluginChoice(kind="any"), **AUTO)
    assert status_of(core, NOW_US).battery_v is None, "no reading yet"
    core.on_battery(1.0, NOW_US)
    assert status_of(core, NOW_US + 100_000).battery_v == 1.0
    core.on_battery(2e6, NOW_US)
    assert status_of(core, NOW_US + 200_000).battery_v == 1e6
    core.on_battery(1.0, NOW_US)
    armed(core)
    core.tick(NOW_US, None, None)
    assert core.gate.reason == "the battery is empty"


def test_robot_without_a_battery_ignores_a_voltage():
    core = core_of()
    core.on_battery(1.0, NOW_US)
    assert core.battery is None and status_of(core, NOW_US).battery_v is None


# --- scans -------------------------------------------------------------------------------------------------------

RANGES = Ranges(NOW_US - 5_000, -1.5, 0.5, 0.05, math.inf, array.array("f", [1.0, 2.0, 0.5]))


def scan(core, ranges=RANGES):
    core.tick(NOW_US, None, ranges)
    return sent(core, NOW_US, SCAN)


def test_scan_is_published_with_the_time_of_its_capture():
    core = core_of()
    (message,) = scan(core)
    assert decode(ScanHeader, message.header) == ScanHeader(
        session=ROBOT, seq=0, t_us=NOW_US - 5_000, angle_min_rad=-1.5, angle_increment_rad=0.5, range_min_m=0.05,
        range_max_m=1e6,
    )  # fmt: skip
    assert list(decode_ranges(message.payload)) == [1.0, 2.0, 0.5] and message.source == ""
    nearer = Ranges(NOW_US, -1.5, 0.5, 0.05, 12.0, RANGES.ranges_m)
    header = decode(ScanHeader, scan(core, nearer)[0].header)
    assert (header.seq, header.range_max_m) == (1, 12.0)


@pytest.mark.parametrize(("rays", "leaves"), [(4_096, True), (4_097, False)])
def test_scan_of_more_rays_than_the_wire_holds_is_not_published(rays, leaves):
    ranges = Ranges(NOW_US, 0.0, 0.001, 0.05, 12.0, array.array("f", [1.0]) * rays)
    assert (scan(core_of(), ranges) != []) == leaves


@pytest.mark.parametrize("sensor", [True, False])
def test_range_sensor_limits_the_speed_toward_an_obstacle(sensor):
    core = armed(core_of(range_sensor=PluginChoice(kind="any" if sensor else "none"), **AUTO))
    core.tick(NOW_US, None, Ranges(NOW_US, 0.0, 0.01, 0.01, 12.0, array.array("f", [0.05, 0.05])))
    core.on_issued(9, NOW_US, 9)
    core.on_twist(twist(b"0.2|0", number=9, seq=9), NOW_US)
    for step in range(1, 10):
        core.tick(NOW_US + step * 20_000, None, None)
    assert (core.gate.applied.linear_mps == 0.0) == sensor
    assert ("an obstacle is near" in core.gate.reason) == sensor
