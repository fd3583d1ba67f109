"""Cases on wheel motion: limits, ramps, silence and ageing frames, in `applied` and measured motion. Pure.

A stop is timed between two arrivals at the kit, so that the link's delay affects both.
"""

import math
from typing import Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.measured import mean_moving, mean_travel
from sightline.conformance.robot.fixture import CRAWL, DRIVEN, FAST_LINK_US, SETTLES_US, Robot, Sender, armed
from sightline.protocol.channels import STATUS
from sightline.protocol.errors import CLAMPED
from sightline.protocol.messages import FrameHeader, Planar, State, Status

SUITE: Final = Suite("R")
_STOPS_WITHIN_US: Final = 700_000
_RESOLUTION_US: Final = 100_000
"""Between two status."""
_TOLERANCE: Final = 0.01
_ZERO: Final = (0.0, 0.0)
_OFF_MPS: Final = 0.04
_OFF_RAD_S: Final = 0.15
"""Error limit of measured motion in addition to a share: a wheel slips, an encoder has steps."""
_OVERSHOOT: Final = 1.15
_MEASURED_US: Final = 600_000
_AGED_US: Final = 250_000
_FRESH_US: Final = 150_000
"""Age of a frame at which a robot begins to slow down (5.3)."""


def _settled(robot: Robot) -> Planar:
    """Return the applied twist after the ramps."""
    robot.bench.rest(1_200_000)
    reported = [robot.next_status(2).applied, *(header.applied for _, header in robot.frames()[-1:])]
    return max(reported, key=lambda pair: abs(pair[0]) + abs(pair[1]))


def _driven(bench: Bench, text: bytes) -> tuple[Status, Planar]:
    robot = armed(bench, text=text).robot
    applied = _settled(robot)
    return robot.status(), applied


def _within_limits(status: Status, most: Planar) -> tuple[bytes, Planar]:
    """Return a twist with these signs, as text and as numbers, limited to `most` and to half the robot's maximum."""
    linear, angular = (math.copysign(min(abs(speed), limit / 2), speed)
                       for speed, limit in zip(most, _limits(status), strict=True))
    return f"{linear:.4f}|{angular:.4f}".encode(), (linear, angular)


@SUITE.must("R-LIM-01", "2.8 Fields")
def reaches_the_command(bench: Bench) -> None:
    """A twist within the limits is applied as it was sent: linear first, angular second, with their signs."""
    for most in ((0.1, 0.3), (-0.05, -0.2)):
        text, wanted = _within_limits(Robot(bench).status(), most)
        _status, applied = _driven(bench, text)
        near = math.isclose(applied[0], wanted[0], abs_tol=0.005) and math.isclose(applied[1], wanted[1], abs_tol=0.02)
        Robot(bench).expect_at_speed(near, f"{text.decode()} is applied as {applied}")
        bench.rest(1_000_000 if Sender(Robot(bench), "operator").granted("disarm") else 0)
        bench.forget()


@SUITE.must("R-LIM-08", "2.8 Fields")
def measures_what_it_applies(bench: Bench) -> None:
    """Measured motion, if the robot has it in `moving` or `pose`, agrees with `applied` in each axis and sign."""
    for text in (b"0.1000|0.4000", b"-0.1000|-0.4000"):
        robot, (_status, applied) = Robot(bench), _driven(bench, text)
        began_us = robot.clock_us()
        bench.rest(800_000)
        found = {f"{field} of {name}": mean({name: series}) for name, series in robot.readings(began_us).items()
                 for field, mean in (("moving", mean_moving), ("pose", mean_travel))}
        bench.need(any(found.values()), "this robot publishes no measured motion")
        travels = {name: found[f"pose of {name}"] for name in ("odometry", "frame")
                   if f"pose of {name}" in found and (name == "odometry" or robot.frames_give_a_pose())}
        alike = len({travel is None for travel in travels.values()}) < 2
        bench.expect(alike, f"`pose` moves on one channel and stands still on the other: {travels}")
        for name, measured in found.items():
            near = measured is None or all(map(_agrees, measured, applied, (_OFF_MPS, _OFF_RAD_S)))
            bench.expect(near, f"{text.decode()} is applied as {applied}, by {name} it moves at {measured}")
        bench.rest(1_000_000 if Sender(robot, "operator").granted("disarm") else 0)
        bench.forget()


def _agrees(measured: float, applied: float, least: float) -> bool:
    return abs(measured - applied) <= max(abs(applied) / 2, least)


@SUITE.must("R-LIM-02", "9. Status")
def limits_are_reported(bench: Bench) -> None:
    """`status` reports the robot's limits, both above zero."""
    status = Robot(bench).status()
    reported = (status.max_linear_mps, status.max_angular_rad_s)
    bench.expect(min(reported) > 0, f"max_linear_mps and max_angular_rad_s are {reported}")


def _limits(status: Status) -> Planar:
    return status.max_linear_mps or math.inf, status.max_angular_rad_s or math.inf


@SUITE.must("R-LIM-03", "4.3 Limits")
def linear_is_clamped(bench: Bench) -> None:
    """A linear speed beyond the limit is accepted and cut to the limit."""
    status, applied = _driven(bench, b"48.0000|0.0000")
    bench.need(status.max_linear_mps > 0, "the robot reports no limit (R-LIM-02)")
    bench.expect(applied[0] <= status.max_linear_mps + _TOLERANCE, f"{applied[0]} m/s of {status.max_linear_mps}")
    _measured_within(Robot(bench), status)


@SUITE.must("R-LIM-04", "4.3 Limits")
def angular_is_clamped(bench: Bench) -> None:
    """A turn rate beyond the limit is accepted and cut to the limit."""
    status, applied = _driven(bench, b"0.0000|-48.0000")
    bench.need(status.max_angular_rad_s > 0, "the robot reports no limit (R-LIM-02)")
    least = -status.max_angular_rad_s - _TOLERANCE
    bench.expect(applied[1] >= least, f"{applied[1]} rad/s of {status.max_angular_rad_s}")
    _measured_within(Robot(bench), status)


def _measured_within(robot: Robot, status: Status) -> None:
    """Fail the case if the motion that the robot measured last is beyond its limits."""
    readings = robot.readings(robot.clock_us() - _MEASURED_US)
    for name, measured in (("moving", mean_moving(readings)), ("pose", mean_travel(readings))):
        linear, angular = measured or _ZERO
        within = (abs(linear) <= _OVERSHOOT * status.max_linear_mps + _OFF_MPS
                  and abs(angular) <= _OVERSHOOT * status.max_angular_rad_s + _OFF_RAD_S)
        limits = f"{status.max_linear_mps} m/s, {status.max_angular_rad_s} rad/s"
        robot.bench.expect(within, f"by `{name}` it moves at {linear:.2f} m/s, {angular:.2f} rad/s; limits {limits}")


@SUITE.must("R-LIM-05", "4.3 Limits", armed)
def clamped_is_counted(bench: Bench, driver: Sender) -> None:
    """A value beyond the limits is counted as CLAMPED, one within them is not; `last_refusal` never names it."""
    before = driver.robot.next_status().refused.get(CLAMPED, 0)
    within = driver.robot.next_status(2).refused.get(CLAMPED, 0)
    bench.expect(within == before, f"{within - before} twists within the limits were counted as CLAMPED")
    driver.drive(b"48.0000|0.0000")
    grows = driver.robot.counts(CLAMPED, within, 600_000)
    bench.expect(grows, f"48 m/s was not counted as CLAMPED: {driver.robot.status().refused}")
    last = driver.robot.next_status().last_refusal
    bench.expect(last is None or last.reason != CLAMPED, f"last_refusal is {last}, but the command was accepted")


@SUITE.should("R-LIM-06", "4.3 Limits", Robot)
def the_curve_stays(bench: Bench, robot: Robot) -> None:
    """Both axes are cut by one factor, so that the robot drives the curve it was commanded."""
    reported = robot.status()
    bench.need(min(reported.max_linear_mps, reported.max_angular_rad_s) > 0, "the robot reports no limits (R-LIM-02)")
    requested = 4 * reported.max_linear_mps, reported.max_angular_rad_s
    _status, applied = _driven(bench, f"{requested[0]:.4f}|{requested[1]:.4f}".encode())
    bench.need(applied[0] > 0, "it does not drive (R-LIM-01)")
    wanted, seen = requested[1] / requested[0], applied[1] / applied[0]
    reason = f"curvature {seen:.2f} instead of {wanted:.2f} 1/m"
    robot.expect_at_speed(math.isclose(wanted, seen, rel_tol=0.1), reason)


@SUITE.should("R-LIM-07", "6.4 Arming", Robot)
def ramps_up(bench: Bench, robot: Robot) -> None:
    """Speed builds up in a ramp: frames and `status` show values on the way to the limit."""
    goal = _limits(robot.status())[0]
    bench.need(goal < math.inf, "the robot reports no limit (R-LIM-02)")
    mark = bench.mark()
    armed(bench, text=f"{goal:.4f}|0".encode())
    bench.rest(1_000_000)
    speeds = {header.applied[0] for _, header in robot.frames(mark)}
    speeds |= {status.applied[0] for one in bench.received(STATUS, mark) if (status := one.payload(Status))}
    bench.need(max(speeds, default=0.0) > 0.9 * goal, "it does not reach its limit (R-LIM-03)")
    between = [speed for speed in speeds if 0.02 * goal < speed < 0.9 * goal]
    bench.expect(len(between) >= 2, f"from 0 to {goal} m/s in one step: {between}")


# --- silence ---------------------------------------------------------------------------------------------------------


def _reports(bench: Bench, since: int) -> list[tuple[int, Planar, State]]:
    """Return (time of arrival, applied, state) of each status since a mark."""
    read = ((one.at_us, one.payload(Status)) for one in bench.received(STATUS, since))
    return [(at_us, status.applied, status.state) for at_us, status in read if status]


def _zero_us(bench: Bench, since: int) -> int | None:
    """Return when a status first reports that the wheels are at zero, if they stay there."""
    reported = [(at_us, applied) for at_us, applied, _ in _reports(bench, since)]
    last_moving = max((number for number, one in enumerate(reported) if one[1] != _ZERO), default=-1)
    return reported[last_moving + 1][0] if last_moving + 1 < len(reported) else None


def _driving(bench: Bench, source: str = "vision", way: Planar = (1.0, 0.0)) -> Sender:
    """Return the driver of a robot at full speed in this direction, in shares of its limits."""
    limits = _limits(Robot(bench).status())
    linear, angular = (share * min(limit, 10.0) for share, limit in zip(way, limits, strict=True))
    driver = armed(bench, source, f"{linear:.4f}|{angular:.4f}".encode())
    bench.rest(700_000)
    axis = _axis_of(way)
    bench.need(driver.robot.next_status().applied[axis] * way[axis] > 0, "it does not drive (R-LIM-01)")
    return driver


def _axis_of(way: Planar) -> int:
    return 0 if way[0] else 1


def _stopping(bench: Bench) -> Sender:
    """Return the driver of a robot at its full speed that has stopped once after silence."""
    driver = _driving(bench)
    robot = driver.robot
    text, driver.driving, driver.acks = driver.driving, None, False
    rests = robot.reaches(lambda status: status.applied == _ZERO and status.state is State.HOLD, 1_000_000)
    bench.need(rests, "silence alone does not stop it (R-SIL-01)")
    driver.acks, driver.driving = True, text
    again = robot.becomes(*DRIVEN, within_us=1_500_000)
    bench.need(again, "it does not go on from HOLD (R-SIL-08)")
    bench.rest(700_000)
    return driver


def _silent(driver: Sender) -> tuple[int, FrameHeader]:
    """Silence the driver. Returns a mark at the first unanswered frame, and that frame."""
    driver.fall_silent()
    cited = driver.robot.frame()
    return driver.bench.mark(), cited


def _expect_stop(bench: Bench, mark: int, what: str) -> None:
    robot = Robot(bench)
    began_us, began_t_us = bench.now_us, robot.clock_us()
    bench.rest(1_500_000)
    zero_us = _zero_us(bench, mark)
    bench.expect(zero_us is not None, f"{what}: the wheels still turn after 1.5 s")
    assert zero_us is not None
    took_us = zero_us - began_us
    reported = f"{what}: at zero {took_us / 1e3:.0f} ms after the first frame not answered"
    bench.expect(took_us <= _STOPS_WITHIN_US + _RESOLUTION_US, reported)
    robot.expect_unmoved(f"{what}: 0.9 s later", began_t_us + _STOPS_WITHIN_US + SETTLES_US)


@SUITE.must("R-SIL-01", "5.4 Silence", _driving)
def silence_stops(bench: Bench, driver: Sender) -> None:
    """When twists cease the robot holds, with the wheels at zero within 700 ms."""
    _expect_stop(bench, _silent(driver)[0], "silence")


@SUITE.must("R-SIL-02", "5.4 Silence")
def rejected_twists_keep_nothing_alive(bench: Bench) -> None:
    """Rejected twists do not keep the wheels turning."""
    Sender(Robot(bench)).need_unknown()
    driver = _stopping(bench)
    mark, cited = _silent(driver)
    for number in range(10):
        bench.after(number * 90_000, lambda: driver.twist(cited, echo_seq=cited.seq + 5000))
    _expect_stop(bench, mark, "rejected twists")


@SUITE.must("R-SIL-03", "5.4 Silence", _stopping)
def others_keep_nothing_alive(bench: Bench, driver: Sender) -> None:
    """Good twists of a source that does not hold the lease do not keep the wheels turning."""
    other = Sender(driver.robot, acks=False)
    rejected = driver.robot.status().refused.get("NOT_HOLDER", 0)
    other.drive()
    kept_out = driver.robot.counts("NOT_HOLDER", rejected, 1_000_000)
    bench.need(kept_out, "a second driver is not rejected (R-LEASE-02)")
    mark, _cited = _silent(driver)
    for number in range(20):  # until just before the lease of the first could end
        bench.after(number * 20_000, lambda: other.twist(driver.robot.frames()[-1][1]))
    other.fall_silent()
    _expect_stop(bench, mark, "another's twists")


@SUITE.must("R-SIL-04", "5.3 Age", _stopping)
def old_frame_stops(bench: Bench, driver: Sender) -> None:
    """Twists that go on citing one old frame do not keep the wheels turning: age is validated at every tick."""
    _expect_stop_on_one_frame(bench, driver)


def _expect_stop_on_one_frame(bench: Bench, driver: Sender) -> None:
    mark, cited = _silent(driver)
    for number in range(38):
        bench.after(number * 10_000, lambda: driver.twist(cited, b"10.0000|0.0000"))
    _expect_stop(bench, mark, "twists on one frame")


@SUITE.must("R-SIL-05", "5.3 Age", armed)
def ageing_frame_slows(bench: Bench, driver: Sender) -> None:
    """On frames between 150 and 400 ms old the robot drives, DEGRADED, at a lower speed."""
    _expect_slower(bench, driver, 0, "m/s")


@SUITE.must("R-SIL-14", "5.3 Age", armed)
def ageing_frame_slows_a_turn(bench: Bench, driver: Sender) -> None:
    """On frames between 150 and 400 ms old the robot turns on the spot, DEGRADED, at a lower rate."""
    _expect_slower(bench, driver, 1, "rad/s")


def _expect_slower(bench: Bench, driver: Sender, axis: int, unit: str) -> None:
    limit = _limits(driver.robot.status())[axis]
    bench.need(limit < math.inf, "the robot reports no limit (R-LIM-02)")
    aged_by_link_us = driver.robot.link_us()
    bench.need(aged_by_link_us + FAST_LINK_US < _FRESH_US, "over this link, it slows down by the age of every frame")
    driver.drive("|".join(f"{limit if one == axis else 0.0:.4f}" for one in (0, 1)).encode())
    bench.rest(1_000_000)
    full = driver.robot.next_status().applied[axis]
    slowed_us = driver.robot.clock_us()
    driver.delay_us = driver.compute_us = _AGED_US - aged_by_link_us
    bench.rest(1_500_000)
    measured = mean_moving(driver.robot.readings(slowed_us - _MEASURED_US, slowed_us))
    mark, accepted, settled_us = bench.mark(), driver.robot.status(), driver.robot.clock_us()
    bench.rest(1_000_000)
    seen = _reports(bench, mark)
    bench.need(full > 0, "it does not drive (R-LIM-01)")
    bench.need(driver.robot.status().accepted > accepted.accepted, "answers 250 ms late are not accepted (R-CAUS-10)")
    states, fastest = {state for _, _, state in seen}, max(applied[axis] for _, applied, _ in seen)
    bench.expect(State.DEGRADED in states, f"answers 250 ms late leave it {sorted(state.value for state in states)}")
    bench.expect(fastest < 0.9 * full, f"it still drives at {fastest} of {full} {unit}")
    slower = mean_moving(driver.robot.readings(settled_us))
    if measured is not None and slower is not None:
        by_moving = f"by `moving` it is at {slower[axis]:.2f} of {measured[axis]:.2f} {unit}"
        bench.expect(slower[axis] < 0.95 * measured[axis], by_moving)


@SUITE.must("R-SIL-06", "5.4 Silence", armed)
def hold_is_reported(_bench: Bench, driver: Sender) -> None:
    """HOLD is reported within 300 ms of the last good twist, give or take a status."""
    driver.fall_silent()
    driver.robot.expect_state(State.HOLD, within_us=600_000, what="600 ms after the last twist")


@SUITE.must("R-SIL-07", "6.3 States", armed)
def long_hold_disarms(bench: Bench, driver: Sender) -> None:
    """Ten seconds of HOLD disarm."""
    driver.fall_silent()
    bench.need(driver.robot.becomes(State.HOLD, within_us=2_000_000), "it does not hold (R-SIL-06)")
    early = driver.robot.becomes(State.DISARMED, within_us=8_500_000)
    bench.expect(not early, "it disarmed before ten seconds were over")
    driver.robot.expect_unmoved("in HOLD", driver.robot.clock_us() - 7_000_000)
    driver.robot.expect_state(State.DISARMED, within_us=2_500_000, what="after 11 s")


@SUITE.must("R-SIL-08", "6.3 States", armed)
def hold_goes_on(bench: Bench, driver: Sender) -> None:
    """From HOLD the same driver's next twists drive on without arming again."""
    driver.fall_silent()
    bench.need(driver.robot.becomes(State.HOLD, within_us=2_000_000), "it does not hold (R-SIL-06)")
    bench.rest(700_000)
    driver.acks = True
    driver.drive(CRAWL)
    driver.robot.expect_state(*DRIVEN, within_us=1_000_000)


@SUITE.must("R-SIL-09", "5.4 Silence", _stopping)
def acks_keep_nothing_alive(bench: Bench, driver: Sender) -> None:
    """Many acks of the driver do not keep the wheels turning."""
    _expect_stop_beside_acks(bench, driver)


def _expect_stop_beside_acks(bench: Bench, driver: Sender) -> None:
    mark, cited = _silent(driver)
    for number in range(100):
        bench.after(number * 10_000, lambda: driver.ack(cited))
    _expect_stop(bench, mark, "acks")


# --- a human drives --------------------------------------------------------------------------------------------------


def _human_driving(bench: Bench) -> Sender:
    return _driving(bench, "teleop")


@SUITE.must("R-SIL-12", "5.4 Silence", _human_driving)
def silence_of_a_human_stops(bench: Bench, human: Sender) -> None:
    """When the twists of a human cease, the wheels are at zero within 700 ms, also while acks come."""
    _expect_stop_beside_acks(bench, human)


@SUITE.must("R-SIL-13", "5.3 Age", _human_driving)
def old_frame_stops_a_human(bench: Bench, human: Sender) -> None:
    """Twists of a human that go on citing one old frame do not keep the wheels turning."""
    _expect_stop_on_one_frame(bench, human)


# --- backwards, and turns on the spot --------------------------------------------------------------------------------
# One axis at a time: where both turn, the stop of one may hide that the other goes on.


def _backing(bench: Bench) -> Sender:
    return _driving(bench, way=(-1.0, 0.0))


def _turning(bench: Bench) -> Sender:
    return _driving(bench, way=(0.0, 1.0))


def _falls_silent(driver: Sender) -> None:
    _expect_stop(driver.bench, _silent(driver)[0], "silence")


def _is_stopped(driver: Sender) -> None:
    Sender(driver.robot, "operator").send_request("stop")
    driver.robot.expect_state(State.STOPPED)
    _expect_stop(driver.bench, driver.bench.mark(), "STOP")


def _is_disarmed(driver: Sender) -> None:
    Sender(driver.robot, "operator").send_request("disarm")
    driver.robot.expect_state(State.DISARMED)
    _expect_stop(driver.bench, driver.bench.mark(), "disarm")


SUITE.must_all(_backing, {
    "R-SIL-10": ("5.4 Silence", "When twists cease while the robot drives backwards, the wheels are at zero within "
                 "700 ms.", _falls_silent),
    "R-STOP-18": ("6.5 STOP", "STOP while the robot drives backwards: the wheels are at zero.", _is_stopped),
    "R-ARM-20": ("8.2 Requests and replies", "`disarm` while the robot drives backwards: the wheels are at zero.",
                 _is_disarmed),
})
SUITE.must_all(_turning, {
    "R-SIL-11": ("5.4 Silence", "When twists cease while the robot turns on the spot, the wheels are at zero within "
                 "700 ms.", _falls_silent),
    "R-STOP-19": ("6.5 STOP", "STOP while the robot turns on the spot: the wheels are at zero.", _is_stopped),
    "R-ARM-21": ("8.2 Requests and replies", "`disarm` while the robot turns on the spot: the wheels are at zero.",
                 _is_disarmed),
})
