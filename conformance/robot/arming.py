"""Cases on arming, disarming, STOP and reset. Pure."""

from typing import Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import CRAWL, GOOD, Robot, Sender, arm, armed
from sightline.protocol.messages import State, Status

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


# Cases on the STOP latch and its reset: what ends motion, and what alone may permit it again. Pure.


_DRIVEN = (State.HOLD, State.ACTIVE, State.DEGRADED)


def _stopped(bench: Bench) -> Sender:
    """An operator whose STOP has worked."""
    operator = Sender(Robot(bench), "operator")
    operator.request("stop")
    bench.need(is_soon(operator.robot, State.STOPPED), "STOP does not stop this robot (R-STOP-01)")
    operator.robot.next_status()
    return operator


def _state(robot: Robot, state: State, what: str) -> Status:
    status = robot.next_status(2)
    robot.bench.expect(status.state is state, f"{what} it is {status.state}: {status.reason}")
    return status


@SUITE.must("R-STOP-01", "6.5 STOP")
def stops(bench: Bench) -> None:
    """STOP while driving: STOPPED is said within 300 ms, the reply says so, wheels at zero within 700 ms."""
    robot, _driver = armed(bench)
    reply = Sender(robot, "operator").ask("stop")
    bench.expect(is_soon(robot, State.STOPPED, 300_000), f"it is {robot.status().state}")
    rests = robot.reaches(lambda status: status.applied == (0.0, 0.0), 700_000)
    bench.expect(rests, f"the wheels still turn: {robot.status().applied}")
    bench.expect(reply is None or reply.ok, f"the reply says {reply}")


@SUITE.must("R-STOP-02", "13.5 Security")
def anybody_stops(bench: Bench) -> None:
    """STOP is granted to a role that may not drive, beside a human who drives."""
    human = Sender(Robot(bench), "teleop")
    human.need_good()
    human.drive()
    Sender(human.robot, bench.access.watcher).request("stop")
    bench.expect(is_soon(human.robot, State.STOPPED), f"it is {human.robot.status().state}")


@SUITE.must("R-STOP-03", "8.2 Requests and replies")
def stop_needs_no_echo(bench: Bench) -> None:
    """STOP without `echo` is obeyed also from a robot at rest."""
    operator = Sender(Robot(bench), "operator")
    operator.robot.status()
    operator.request("stop", cite=False)
    bench.expect(is_soon(operator.robot, State.STOPPED), f"it is {operator.robot.status().state}")


@SUITE.must("R-STOP-04", "5.1 Order")
def latched(bench: Bench) -> None:
    """In STOPPED good twists are refused as STOPPED and change nothing."""
    driver = Sender(Robot(bench))
    driver.need_good()
    operator = _stopped(bench)
    for _ in range(6):
        verdict = driver.judged()
        bench.expect(verdict == "STOPPED", f"a twist is {verdict or 'not counted'}")
    _state(operator.robot, State.STOPPED, "after six twists")


@SUITE.must("R-STOP-05", "8.2 Requests and replies")
def no_arming(bench: Bench) -> None:
    """In STOPPED `arm` is refused as STOPPED."""
    operator = _stopped(bench)
    Sender(operator.robot).drive()
    bench.rest(500_000)
    expect_arm_rejected(bench, operator, "STOPPED", "a request")
    _state(operator.robot, State.STOPPED, "after arm")


@SUITE.must("R-STOP-06", "6.5 STOP")
def reset_starts_nothing(bench: Bench) -> None:
    """`reset` leads to DISARMED and starts no motion, also while twists flow."""
    operator = _stopped(bench)
    Sender(operator.robot).drive()
    bench.expect(operator.granted("reset"), "reset was not granted")
    status = _state(operator.robot, State.DISARMED, "after reset")
    bench.rest(500_000)
    status = _state(operator.robot, State.DISARMED, "half a second after reset")
    bench.expect(status.applied == (0.0, 0.0), f"the wheels move: {status.applied}")


@SUITE.must("R-STOP-07", "8.3 Freshness")
def reset_needs_echo(bench: Bench) -> None:
    """`reset` without `echo` is refused."""
    operator = _stopped(bench)
    operator.ask("reset", cite=False)
    _state(operator.robot, State.STOPPED, "after a reset that cites nothing")


@SUITE.must("R-STOP-08", "8.3 Freshness")
def reset_after_stop(bench: Bench) -> None:
    """`reset` that cites a `status` from before the STOP is refused."""
    robot = Robot(bench)
    before = robot.stamp()
    operator = _stopped(bench)
    operator.ask("reset", cite=before)
    _state(robot, State.STOPPED, "after a reset from before the STOP")


@SUITE.must("R-STOP-09", "6.5 STOP")
def latched_over_reconnect(bench: Bench) -> None:
    """STOPPED holds while nobody is connected and after everybody has come again."""
    operator = _stopped(bench)
    bench.leave()
    bench.rest(1_500_000)
    bench.join()
    mark = bench.mark()
    bench.need(operator.robot.reaches(lambda _status: bench.mark() > mark, 5_000_000), "no status again (R-RECO-01)")
    _state(operator.robot, State.STOPPED, "after a reconnect")


@SUITE.must("R-STOP-10", "6.5 STOP")
def disarm_lifts_nothing(bench: Bench) -> None:
    """`disarm` does not lift STOPPED."""
    operator = _stopped(bench)
    operator.ask("disarm")
    _state(operator.robot, State.STOPPED, "after disarm")


@SUITE.must("R-STOP-11", "8.2 Requests and replies")
def stop_again(bench: Bench) -> None:
    """STOP may be repeated: it is granted again and stays."""
    operator = _stopped(bench)
    reply = operator.ask("stop")
    bench.expect(reply is not None and reply.ok, f"the second STOP: {reply}")
    _state(operator.robot, State.STOPPED, "after the second STOP")


@SUITE.must("R-STOP-12", "8.3 Freshness")
def late_stop(bench: Bench) -> None:
    """A STOP that a link kept back is obeyed, however old the `status` that it cites."""
    robot = Robot(bench)
    old = robot.stamp()
    bench.rest(2_500_000)
    Sender(robot, "operator").request("stop", cite=old)
    bench.expect(is_soon(robot, State.STOPPED), f"it is {robot.status().state}")


@SUITE.must("R-STOP-13", "8.2 Requests and replies")
def reset_of_nothing(bench: Bench) -> None:
    """`reset` where there is nothing to reset changes nothing: an armed robot drives on."""
    robot, driver = armed(bench)
    driver.ask("reset")
    status = robot.next_status(2)
    bench.expect(status.state in _DRIVEN, f"then it is {status.state}")


@SUITE.must("R-STOP-14", "6.5 STOP")
def arms_after_reset(bench: Bench) -> None:
    """After `reset` the robot can be armed and driven again."""
    _robot, first = armed(bench)
    first.fall_silent()
    operator = _stopped(bench)
    operator.robot.reaches(lambda status: status.applied == (0.0, 0.0), 1_500_000)
    bench.rest(1_200_000)
    bench.need(operator.granted("reset"), "reset is not granted (R-STOP-06)")
    driver = Sender(operator.robot)
    bench.need(driver.judged(CRAWL) == GOOD, "twists are not judged good after reset (R-STOP-06)")
    driver.drive()
    bench.rest(500_000)
    bench.expect(driver.granted("arm"), "arm is not granted after reset")
    arm(driver)
