"""Cases on the STOP latch and its reset: what ends motion, and what alone may permit it again. Pure."""

from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.robot.arming import expect_arm_rejected, is_soon
from sightline.conformance.robot.fixture import CRAWL, GOOD, Robot, Sender, arm, armed
from sightline.protocol.messages import State, Status

SUITE: Final = Suite("R")
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
