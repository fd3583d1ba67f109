"""Cases on arming and disarming: what lets a robot move. Pure."""

from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.robot.fixture import Robot, Sender, armed
from sightline.protocol.messages import State

SUITE: Final = Suite("R")


def _driven(bench: Bench, twists: int = 8) -> Sender:
    """A driver whose last twists were all good; the robot is not armed."""
    driver = Sender(Robot(bench))
    driver.need_good()
    driver.drive()
    target = driver.seq + twists
    bench.need(bench.wait(lambda: driver.seq >= target, 3_000_000), "too few frames")
    driver.robot.next_status()
    return driver


def expect_arm_rejected(bench: Bench, sender: Sender, reason: str, what: str, **changes: object) -> None:
    """Fail the case unless `arm` is refused, and that counted under `reason`."""
    before = sender.robot.next_status().refused.get(reason, 0)
    reply = sender.ask("arm", **changes)  # type: ignore[arg-type]
    bench.need(reply is not None, "no reply to arm (R-REQ-01)")
    assert reply is not None
    bench.expect(not reply.ok, f"{what} armed the robot")
    counted = sender.robot.reaches(lambda status: status.refused.get(reason, 0) > before, 400_000)
    bench.expect(counted, f"{what}: refused with {reply.detail!r}, expected {reason}")


def is_soon(robot: Robot, state: State, within_us: int = 500_000) -> bool:
    """Whether a status says `state` in time."""
    return robot.reaches(lambda status: status.state is state, within_us)


@SUITE.must("R-ARM-01", "8.2 Requests and replies")
def nobody_drives(bench: Bench) -> None:
    """`arm` is refused as NOT_ALLOWED while nobody sends good twists."""
    expect_arm_rejected(bench, Sender(Robot(bench), "operator"), "NOT_ALLOWED", "a request without any twist")


@SUITE.must("R-ARM-02", "6.4 Arming")
def too_few(bench: Bench) -> None:
    """`arm` is refused as NOT_ALLOWED after two good twists."""
    driver = Sender(Robot(bench))
    driver.need_good()
    driver.need_good()
    expect_arm_rejected(bench, Sender(driver.robot, "operator"), "NOT_ALLOWED", "two twists")


@SUITE.must("R-ARM-03", "6.4 Arming")
def arms(bench: Bench) -> None:
    """`arm` is granted while good twists flow, and the robot obeys them."""
    driver = _driven(bench)
    reply = Sender(driver.robot, "operator").ask("arm")
    bench.expect(reply is not None and reply.ok, f"after 8 good twists: {reply}")
    reached = driver.robot.reaches(lambda status: status.state in (State.ACTIVE, State.DEGRADED), 1_000_000)
    bench.expect(reached, f"then it is {driver.robot.status().state}: {driver.robot.status().reason}")


@SUITE.must("R-ARM-04", "5.1 Order")
def unarmed_does_not_move(bench: Bench) -> None:
    """A robot that is not armed counts good twists as DISARMED, accepts none and does not move."""
    driver = _driven(bench)
    before = driver.robot.status()
    after = driver.robot.next_status(3)
    bench.expect(after.accepted == before.accepted, f"{after.accepted - before.accepted} twists were accepted")
    grew = after.refused.get("DISARMED", 0) > before.refused.get("DISARMED", 0)
    bench.expect(grew, f"none was counted as DISARMED: {after.refused}")
    bench.expect(after.applied == (0.0, 0.0), f"the wheels move: {after.applied}")


@SUITE.must("R-ARM-05", "8.2 Requests and replies")
def disarms(bench: Bench) -> None:
    """`disarm` is granted to anybody without `echo`: wheels to zero, whatever is commanded."""
    robot, _driver = armed(bench)
    reply = Sender(robot, "operator").ask("disarm", cite=False)
    bench.expect(reply is not None and reply.ok, f"disarm was not granted: {reply}")
    rests = robot.reaches(lambda status: status.state is State.DISARMED and status.applied == (0.0, 0.0), 1_500_000)
    bench.expect(rests, f"1.5 s later it is {robot.status().state} at {robot.status().applied}")


@SUITE.must("R-ARM-06", "8.3 Freshness")
def arming_needs_echo(bench: Bench) -> None:
    """`arm` without `echo` is refused as MALFORMED."""
    driver = _driven(bench)
    expect_arm_rejected(bench, driver, "MALFORMED", "a request without echo", cite=False)


@SUITE.must("R-ARM-07", "8.3 Freshness")
def arming_needs_news(bench: Bench) -> None:
    """`arm` that cites a `status` more than two seconds old is refused as STALE."""
    robot = Robot(bench)
    old = robot.stamp()
    bench.rest(2_300_000)
    expect_arm_rejected(bench, _driven(bench), "STALE", "a request 2.5 s late", cite=old)


@SUITE.must("R-ARM-08", "8.3 Freshness")
def arming_after_disarm(bench: Bench) -> None:
    """`arm` that cites a `status` from before the last disarm is refused as STALE."""
    driver = _driven(bench)
    before = driver.robot.stamp()
    bench.need(driver.granted("disarm"), "disarm is not granted (R-ARM-05)")
    expect_arm_rejected(bench, driver, "STALE", "a request from before the disarm", cite=before)


@SUITE.must("R-ARM-09", "8.2 Requests and replies")
def human_beside(bench: Bench) -> None:
    """While a human drives, nobody else may arm: NOT_ALLOWED."""
    human = Sender(Robot(bench), "teleop")
    human.need_good()
    human.drive()
    bench.need(bench.wait(lambda: human.seq >= 9, 3_000_000), "too few frames")
    expect_arm_rejected(bench, Sender(human.robot, "operator"), "NOT_ALLOWED", "somebody beside the human")


@SUITE.must("R-ARM-10", "8.2 Requests and replies")
def arming_again(bench: Bench) -> None:
    """`arm` may be repeated without harm: the second is granted and the robot drives on."""
    robot, driver = armed(bench)
    reply = driver.ask("arm")
    bench.expect(reply is not None and reply.ok, f"the second arm: {reply}")
    drives = robot.reaches(lambda status: status.state in (State.ACTIVE, State.DEGRADED), 500_000)
    bench.expect(drives, f"then it is {robot.status().state}")


@SUITE.must("R-ARM-11", "6.4 Arming")
def counts_one_driver(bench: Bench) -> None:
    """Good twists of an earlier driver do not count for the next one."""
    driver = _driven(bench, 12)
    driver.fall_silent()
    bench.rest(1_500_000)
    second = Sender(driver.robot)
    second.need_good()
    expect_arm_rejected(bench, second, "NOT_ALLOWED", "one twist after another driver's twelve")


@SUITE.must("R-ARM-12", "6.4 Arming")
def arming_starts_nothing(bench: Bench) -> None:
    """Twists from before arming are not obeyed after it: without new ones the wheels stay at zero."""
    driver = _driven(bench)
    driver.drive(None)
    bench.need(driver.granted("arm"), "arm is not granted (R-ARM-03)")
    mark = bench.mark()
    moved = driver.robot.reaches(lambda status: status.applied != (0.0, 0.0), 500_000)
    moved = moved or any(header.applied != (0.0, 0.0) for _, header in driver.robot.frames(mark))
    bench.expect(not moved, "the wheels moved by a twist from before it was armed")


@SUITE.must("R-ARM-13", "6.4 Arming")
def refused_between(bench: Bench) -> None:
    """Refused twists between the good ones do not break the row: `arm` is granted."""
    robot, driver = armed(bench)
    bench.need(driver.granted("disarm") and is_soon(robot, State.DISARMED), "disarm does not disarm (R-ARM-05)")
    bench.need(robot.reaches(lambda status: status.applied == (0.0, 0.0), 1_500_000), "then it moves on (R-ARM-05)")
    robot.each_frame(lambda frame: driver.twist(frame, b"x"))
    target = driver.seq + 20
    bench.need(bench.wait(lambda: driver.seq >= target, 3_000_000), "too few frames")
    robot.next_status()
    reply = driver.ask("arm")
    bench.expect(reply is not None and reply.ok, f"after ten good twists and ten bad ones in turn: {reply}")


@SUITE.must("R-ARM-14", "6.4 Arming")
def row_ends_with_the_lease(bench: Bench) -> None:
    """A lease that ran out starts the row again: what its driver sent before does not count."""
    driver = _driven(bench, 12)
    driver.drive(None)
    bench.rest(1_500_000)
    bench.need(driver.robot.next_status().holder is None, "the lease does not end by silence (R-LEASE-04, R-LEASE-07)")
    driver.need_good()
    expect_arm_rejected(bench, driver, "NOT_ALLOWED", "one twist, 1.5 s after twelve")
