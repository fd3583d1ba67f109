"""Cases on arming, disarming, STOP and reset. Pure."""

from typing import Any, Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import (
    CRAWL,
    DRIVEN,
    GOOD,
    SETTLES_US,
    WATCHED_AT_REST_US,
    Robot,
    Sender,
    arm,
    armed,
    moving,
    operator,
    ready,
    teleop,
)
from sightline.protocol.messages import State, Status

SUITE: Final = Suite("R")
_WHEELS_STOP_US: Final = 700_000 + SETTLES_US
"""From STOP until the wheels are measured at rest."""
_LOST_US: Final = 1_300_000
"""Silence after which a human's lease has ended, while the cited status is younger than two seconds."""
_LEASE_LASTS_US: Final = 850_000
"""Since the last twist of a human, so that a request arrives within the second of the lease."""
_YOUNG_US: Final = 1_800_000
"""Age below which a request that cites a `status`, sent after the next one, is not older than two seconds."""


def _driven(bench: Bench, twists: int = 8) -> Sender:
    """Return a driver with good last twists only. The robot is not armed."""
    driver = Sender(Robot(bench))
    driver.need_good()
    driver.drive()
    _send_more(driver, twists)
    driver.robot.next_status()
    return driver


def _send_more(driver: Sender, twists: int) -> None:
    """Wait until the driver has sent that many more twists. Not applicable with too few frames."""
    target = driver.seq + twists
    driver.bench.need(driver.bench.wait(lambda: driver.seq >= target, 3_000_000), "too few frames")


@SUITE.must("R-ARM-02", "6.4 Arming", ready)
def too_few(_bench: Bench, driver: Sender) -> None:
    """`arm` is rejected as NOT_ALLOWED after four good twists."""
    for _ in range(3):
        driver.need_good()
    Sender(driver.robot, "operator").expect_rejected("arm", "NOT_ALLOWED", "four twists")


@SUITE.must("R-ARM-03", "6.4 Arming", _driven)
def arms(bench: Bench, driver: Sender) -> None:
    """`arm` is granted while good twists flow, and the robot applies them, at any time between two of them."""
    operator = Sender(driver.robot, "operator")
    for number in range(4):
        operator.expect_granted("arm", "after 8 good twists")
        driver.robot.expect_state(*DRIVEN, within_us=1_000_000)
        bench.need(operator.granted("disarm"), "disarm is not granted (R-ARM-05)")
        bench.rest(500_000)
        _send_more(driver, 8)
        bench.rest(9_000 * number)


@SUITE.must("R-ARM-04", "5.1 Order", _driven)
def unarmed_does_not_move(bench: Bench, driver: Sender) -> None:
    """A robot that is not armed counts good twists as DISARMED, accepts none and does not move."""
    before = driver.robot.status()
    _send_more(driver, 2)
    after = driver.robot.next_status(3)
    bench.expect(after.accepted == before.accepted, f"{after.accepted - before.accepted} twists were accepted")
    grew = after.refused.get("DISARMED", 0) > before.refused.get("DISARMED", 0)
    bench.expect(grew, f"none was counted as DISARMED: {after.refused}")
    bench.expect(after.applied == (0.0, 0.0), f"the wheels move: {after.applied}")
    driver.robot.expect_unmoved("though it is not armed")


@SUITE.must("R-ARM-05", "8.2 Requests and replies", moving)
def disarms(bench: Bench, driver: Sender) -> None:
    """`disarm` is granted to any role without `echo`: wheels to zero, whatever is commanded."""
    robot = driver.robot
    Sender(robot, "operator").expect_granted("disarm", "disarm was not granted", cite=False)
    rests = robot.reaches(lambda status: status.state is State.DISARMED and status.applied == (0.0, 0.0), 1_500_000)
    bench.expect(rests, f"1.5 s later it is {robot.status().state} at {robot.status().applied}")
    robot.expect_rest("after disarm")


@SUITE.must("R-ARM-07", "8.3 Freshness", _driven)
def arming_needs_news(bench: Bench, driver: Sender) -> None:
    """`arm` that cites a `status` more than two seconds old is rejected as STALE."""
    old = driver.robot.stamp()
    bench.rest(2_050_000)
    driver.expect_rejected("arm", "STALE", "a request more than 2 s late", cite=old)


@SUITE.must("R-ARM-15", "8.3 Freshness", _driven)
def arming_by_a_status_of_a_second_ago(bench: Bench, driver: Sender) -> None:
    """`arm` that cites a `status` one second old is granted."""
    cited = driver.robot.stamp()
    bench.rest(1_000_000)
    driver.expect_granted("arm", "a request that cites a status one second old", cite=cited)


@SUITE.must("R-ARM-08", "8.3 Freshness", _driven)
def arming_after_disarm(bench: Bench, driver: Sender) -> None:
    """`arm` that cites a `status` from before the last disarm is rejected as STALE."""
    before = driver.robot.stamp()
    bench.need(driver.granted("disarm"), "disarm is not granted (R-ARM-05)")
    driver.expect_rejected("arm", "STALE", "a request from before the disarm", cite=before)


def _human(bench: Bench) -> Sender:
    """Return a human that holds the lease of a robot that is not armed."""
    human = teleop(bench)
    human.need_good()
    return human


@SUITE.must("R-ARM-19", "8.3 Freshness", teleop)
def acquiring_after_disarm(bench: Bench, human: Sender) -> None:
    """`acquire` that cites a `status` from before the last disarm is rejected as STALE."""
    before = human.robot.stamp()
    bench.need(Sender(human.robot, "operator").granted("disarm"), "disarm is not granted (R-ARM-05)")
    human.expect_rejected("acquire", "STALE", "a request from before the disarm", cite=before)


@SUITE.must("R-ARM-16", "8.3 Freshness", _human)
def arming_after_a_human_let_go(bench: Bench, human: Sender) -> None:
    """`arm` that cites a `status` from before a human let go is rejected as STALE."""
    before = human.robot.stamp()
    bench.need(human.granted("release"), "release is not granted (R-LEASE-15)")
    human.fall_silent()
    driver = _driven(bench, twists=5)
    bench.need(driver.robot.clock_us() - before.t_us < _YOUNG_US, "too few frames: `arm` would be too old in any case")
    driver.expect_rejected("arm", "STALE", "a request from before the human let go", cite=before)


@SUITE.must("R-ARM-17", "8.3 Freshness", _human)
def reset_after_a_human_was_lost(bench: Bench, human: Sender) -> None:
    """`reset` that cites a `status` from before a human was lost is rejected as STALE."""
    before = human.robot.stamp()
    human.fall_silent()
    bench.rest(_LOST_US)
    bench.need(human.robot.status().holder is None, "the lease does not end by silence (R-LEASE-04)")
    operator(bench).expect_rejected("reset", "STALE", "a request from before the human was lost", cite=before)


@SUITE.must("R-ARM-09", "8.2 Requests and replies", teleop)
def human_beside(bench: Bench, human: Sender) -> None:
    """While a human drives, no other source may arm: NOT_ALLOWED."""
    human.need_good()
    human.drive()
    bench.need(bench.wait(lambda: human.seq >= 9, 3_000_000), "too few frames")
    Sender(human.robot, "operator").expect_rejected("arm", "NOT_ALLOWED", "a request while a human drives")


@SUITE.must("R-ARM-10", "8.2 Requests and replies", armed)
def arming_again(_bench: Bench, driver: Sender) -> None:
    """`arm` may be repeated without harm: the second is granted and the robot drives on."""
    driver.expect_granted("arm", "the second arm")
    driver.robot.expect_state(*DRIVEN)


@SUITE.must("R-ARM-11", "6.4 Arming")
def counts_one_driver(bench: Bench) -> None:
    """Good twists of an earlier driver do not count for the next one."""
    driver = _driven(bench, 12)
    driver.fall_silent()
    bench.rest(1_500_000)
    second = Sender(driver.robot)
    second.need_good()
    second.expect_rejected("arm", "NOT_ALLOWED", "one twist after another driver's twelve")


@SUITE.must("R-ARM-12", "6.4 Arming", _driven)
def arming_starts_nothing(bench: Bench, driver: Sender) -> None:
    """Twists from before arming are not applied after it: without new ones the wheels stay at zero."""
    driver.drive(None)
    bench.need(driver.granted("arm"), "arm is not granted (R-ARM-03)")
    mark, armed_us = bench.mark(), driver.robot.clock_us()
    moved = driver.robot.reaches(lambda status: status.applied != (0.0, 0.0), 500_000)
    moved = moved or any(header.applied != (0.0, 0.0) for _, header in driver.robot.frames(mark))
    bench.expect(not moved, "the wheels moved by a twist from before it was armed")
    driver.robot.expect_unmoved("without a twist since it was armed", armed_us)


@SUITE.must("R-ARM-13", "6.4 Arming", armed)
def rejected_between(bench: Bench, driver: Sender) -> None:
    """Rejected twists between the good ones do not break the row: `arm` is granted."""
    disarmed = driver.granted("disarm") and driver.robot.becomes(State.DISARMED)
    bench.need(disarmed, "disarm does not disarm (R-ARM-05)")
    bench.need(driver.robot.stops(1_500_000), "then it moves on (R-ARM-05)")
    driver.robot.each_frame(lambda frame: driver.twist(frame, b"x"))
    _send_more(driver, 20)
    driver.robot.next_status()
    driver.expect_granted("arm", "after ten good twists and ten bad ones in turn")


@SUITE.must("R-ARM-14", "6.4 Arming")
def row_ends_with_the_lease(bench: Bench) -> None:
    """A lease that ran out starts the row again: what its driver sent before does not count."""
    driver = _driven(bench, 12)
    driver.drive(None)
    bench.rest(1_500_000)
    bench.need(driver.robot.next_status().holder is None, "the lease does not end by silence (R-LEASE-04, R-LEASE-07)")
    driver.need_good()
    driver.expect_rejected("arm", "NOT_ALLOWED", "one twist, 1.5 s after twelve")


# Cases on the STOP latch and its reset: the end of motion, and the only way to permit it again. Pure.


def _stopped(bench: Bench) -> Sender:
    """Return an operator whose STOP took effect."""
    operator = Sender(Robot(bench), "operator")
    operator.send_request("stop")
    bench.need(operator.robot.becomes(State.STOPPED), "STOP does not stop this robot (R-STOP-01)")
    operator.robot.next_status()
    return operator


def _state(robot: Robot, state: State, what: str) -> Status:
    status = robot.next_status(2)
    robot.bench.expect(status.state is state, f"{what} it is {status.state}: {status.reason}")
    return status


def _lifts_nothing(operator: Sender, verb: str, what: str, **changes: Any) -> None:
    """Fail the case unless the robot is still STOPPED after the request."""
    operator.request(verb, **changes)
    _state(operator.robot, State.STOPPED, f"after {what}")


def _stops_at_rest(operator: Sender) -> None:
    operator.send_request("stop", cite=False)
    operator.robot.expect_state(State.STOPPED)


def _stops_again(operator: Sender) -> None:
    operator.expect_granted("stop", "the second STOP")
    _state(operator.robot, State.STOPPED, "after the second STOP")


SUITE.must_all(operator, {
    "R-ARM-01": ("8.2 Requests and replies", "`arm` is rejected as NOT_ALLOWED while no source sends good twists.",
                 lambda it: it.expect_rejected("arm", "NOT_ALLOWED", "a request without any twist")),
    "R-STOP-03": ("8.2 Requests and replies", "STOP without `echo` is applied also from a robot at rest.",
                  _stops_at_rest),
})
SUITE.must_all(_driven, {
    "R-ARM-06": ("8.3 Freshness", "`arm` without `echo` is rejected as MALFORMED.",
                 lambda it: it.expect_rejected("arm", "MALFORMED", "a request without echo", cite=False)),
})
SUITE.must_all(_stopped, {
    "R-STOP-07": ("8.3 Freshness", "`reset` without `echo` is rejected.",
                  lambda it: _lifts_nothing(it, "reset", "a reset that cites nothing", cite=False)),
    "R-STOP-10": ("6.5 STOP", "`disarm` does not lift STOPPED.", lambda it: _lifts_nothing(it, "disarm", "disarm")),
    "R-STOP-17": ("8.2 Requests and replies", "In STOPPED `disarm` is granted, as always.",
                  lambda it: it.expect_granted("disarm", "disarm in STOPPED", cite=False)),
    "R-STOP-11": ("8.2 Requests and replies", "STOP may be repeated: it is granted again and stays.", _stops_again),
})


@SUITE.must("R-STOP-01", "6.5 STOP", moving)
def stops(bench: Bench, driver: Sender) -> None:
    """STOP while driving: STOPPED is reported within 300 ms, the reply reports it, wheels at zero within 700 ms."""
    requested_us = driver.robot.clock_us()
    reply = Sender(driver.robot, "operator").request("stop")
    driver.robot.expect_state(State.STOPPED, within_us=300_000)
    bench.expect(driver.robot.stops(700_000), f"the wheels still turn: {driver.robot.status().applied}")
    bench.expect(reply is None or reply.ok, f"the reply reports {reply}")
    bench.rest(_WHEELS_STOP_US + WATCHED_AT_REST_US)
    driver.robot.expect_unmoved("a second after STOP", requested_us + _WHEELS_STOP_US)


def _at_full_speed(bench: Bench) -> Sender:
    """Return a driver of a robot at its full speed."""
    limit = Robot(bench).status().max_linear_mps
    bench.need(limit > 0, "the robot reports no limit (R-LIM-02)")
    driver = armed(bench, text=f"{min(limit, 10.0):.4f}|0.0000".encode())
    bench.rest(700_000)
    return driver


@SUITE.must("R-ARM-18", "6.4 Arming", _at_full_speed)
def arming_waits_for_the_wheels(bench: Bench, driver: Sender) -> None:
    """`arm` while the wheels turn is rejected, however many good twists came."""
    operator = Sender(driver.robot, "operator", acks=False)
    operator.send_request("disarm")
    driver.drive(b"0.0000|0.0000")  # so that wheels that turn after a granted `arm` turned before it
    bench.need(driver.robot.becomes(State.DISARMED), "disarm does not disarm (R-ARM-05)")
    turned = False
    while driver.robot.status().applied != (0.0, 0.0):
        reply = operator.reply("arm")
        turns = driver.robot.newer_status().applied != (0.0, 0.0)
        bench.expect(not (reply.ok and turns), "it was granted while the wheels turned")
        turned = turned or turns
    bench.need(turned, "its wheels are at zero before a `status` shows DISARMED")


@SUITE.must("R-STOP-15", "8.2 Requests and replies", _at_full_speed)
def reset_waits_for_the_wheels(bench: Bench, driver: Sender) -> None:
    """`reset` while the wheels turn is rejected as NOT_ALLOWED."""
    operator = Sender(driver.robot, "operator")
    operator.send_request("stop")
    bench.need(driver.robot.becomes(State.STOPPED), "STOP does not stop this robot (R-STOP-01)")
    before, reply = driver.robot.status(), operator.reply("reset")
    after = driver.robot.newer_status()
    bench.need(after.applied != (0.0, 0.0) or not reply.ok, "its wheels are at zero before a `status` shows STOPPED")
    bench.expect(not reply.ok, "it was granted while the wheels turned")
    counted = driver.robot.counts("NOT_ALLOWED", before.refused.get("NOT_ALLOWED", 0))
    bench.expect(counted, f"rejected with {reply.detail!r}, expected NOT_ALLOWED")


@SUITE.must("R-STOP-16", "8.2 Requests and replies", _human)
def reset_beside_a_human(bench: Bench, human: Sender) -> None:
    """While a human holds the lease, no other source may reset: NOT_ALLOWED."""
    operator = _stopped(bench)
    held = human.robot.status().holder is not None and bench.now_us - human.sent_us < _LEASE_LASTS_US
    bench.need(held, "the lease of the human has ended")
    operator.expect_rejected("reset", "NOT_ALLOWED", "a request while a human drives")


@SUITE.must("R-STOP-02", "13.5 Security", teleop)
def any_role_stops(bench: Bench, human: Sender) -> None:
    """STOP is granted to a role that may not drive, while a human drives."""
    human.need_good()
    human.drive()
    Sender(human.robot, bench.access.watcher).send_request("stop")
    human.robot.expect_state(State.STOPPED)


@SUITE.must("R-STOP-04", "5.1 Order", ready)
def latched(bench: Bench, driver: Sender) -> None:
    """In STOPPED good twists are rejected as STOPPED and change nothing."""
    operator = _stopped(bench)
    stopped_us = operator.robot.clock_us()
    for _ in range(6):
        driver.expect("STOPPED")
    _state(operator.robot, State.STOPPED, "after six twists")
    operator.robot.expect_unmoved("in STOPPED", stopped_us)


@SUITE.must("R-STOP-05", "8.2 Requests and replies", _stopped)
def no_arming(bench: Bench, operator: Sender) -> None:
    """In STOPPED `arm` is rejected as STOPPED."""
    Sender(operator.robot).drive()
    bench.rest(500_000)
    operator.expect_rejected("arm", "STOPPED", "a request")
    _state(operator.robot, State.STOPPED, "after arm")


@SUITE.must("R-STOP-06", "6.5 STOP", _stopped)
def reset_starts_nothing(bench: Bench, operator: Sender) -> None:
    """`reset` leads to DISARMED and starts no motion, also while twists flow."""
    before_us = operator.robot.clock_us()
    Sender(operator.robot).drive()
    bench.expect(operator.granted("reset"), "reset was not granted")
    status = _state(operator.robot, State.DISARMED, "after reset")
    bench.rest(500_000)
    status = _state(operator.robot, State.DISARMED, "half a second after reset")
    bench.expect(status.applied == (0.0, 0.0), f"the wheels move: {status.applied}")
    operator.robot.expect_unmoved("after reset", before_us)


@SUITE.must("R-STOP-08", "8.3 Freshness", Robot)
def reset_after_stop(bench: Bench, robot: Robot) -> None:
    """`reset` that cites a `status` from before the STOP is rejected."""
    before = robot.stamp()
    _lifts_nothing(_stopped(bench), "reset", "a reset from before the STOP", cite=before)


@SUITE.must("R-STOP-09", "6.5 STOP", _stopped)
def latched_over_reconnect(bench: Bench, operator: Sender) -> None:
    """STOPPED holds while no client is connected and after every client has come again."""
    bench.leave()
    bench.rest(1_500_000)
    bench.join()
    mark = bench.mark()
    bench.need(operator.robot.reaches(lambda _status: bench.mark() > mark, 5_000_000), "no status again (R-RECO-01)")
    _state(operator.robot, State.STOPPED, "after a reconnect")


@SUITE.must("R-STOP-12", "8.3 Freshness", Robot)
def late_stop(bench: Bench, robot: Robot) -> None:
    """A STOP that a link kept back is applied, however old the `status` that it cites."""
    old = robot.stamp()
    bench.rest(2_500_000)
    Sender(robot, "operator").send_request("stop", cite=old)
    robot.expect_state(State.STOPPED)


@SUITE.must("R-STOP-21", "8.3 Freshness", operator)
def stop_cites_anything(bench: Bench, operator: Sender) -> None:
    """STOP is applied whatever status it cites, of another session or never issued, and whatever its `seq` is."""
    stamp = operator.robot.stamp()
    for what, changes in (("another session", {"session": "fffffff0"}), ("no status", {"seq": stamp.seq + 5000})):
        operator.send_request("stop", cite=stamp.model_copy(update=changes), seq=0)
        operator.robot.expect_state(State.STOPPED, what=f"after a STOP that cites {what}")
        bench.need(operator.granted("reset"), "reset does not reset (R-STOP-06)")
        operator.robot.expect_state(State.DISARMED)


@SUITE.must("R-STOP-20", "6.6 Proof", _driven)
def stop_needs_no_proof(bench: Bench, driver: Sender) -> None:
    """`disarm` and STOP that state the driver's session are granted without its proof."""
    reply = driver.reply("disarm", proof=None)
    bench.expect(reply.ok, f"disarm without a proof: {reply.detail}")
    driver.send_request("stop", proof=None)
    driver.robot.expect_state(State.STOPPED, what="after STOP without a proof")


@SUITE.must("R-ARM-22", "8.2 Requests and replies")
def disarms_beside_a_human(bench: Bench) -> None:
    """`disarm` of another role is granted while a human drives."""
    human = armed(bench, "teleop")
    Sender(human.robot, "operator").send_request("disarm", cite=False)
    human.robot.expect_state(State.DISARMED)


@SUITE.must("R-STOP-13", "8.2 Requests and replies", armed)
def reset_of_nothing(bench: Bench, driver: Sender) -> None:
    """`reset` where there is nothing to reset changes nothing: an armed robot drives on."""
    driver.request("reset")
    status = driver.robot.next_status(2)
    bench.expect(status.state in (State.HOLD, *DRIVEN), f"then it is {status.state}")


@SUITE.must("R-STOP-14", "6.5 STOP", armed)
def arms_after_reset(bench: Bench, first: Sender) -> None:
    """After `reset` the robot can be armed and driven again."""
    first.fall_silent()
    operator = _stopped(bench)
    operator.robot.stops(1_500_000)
    bench.rest(1_200_000)
    bench.need(operator.granted("reset"), "reset is not granted (R-STOP-06)")
    driver = Sender(operator.robot)
    bench.need(driver.twist_result(CRAWL) == GOOD, "twists are not accepted after reset (R-STOP-06)")
    driver.drive()
    _send_more(driver, 8)
    driver.robot.next_status()
    bench.expect(driver.granted("arm"), "arm is not granted after reset")
    arm(driver)
