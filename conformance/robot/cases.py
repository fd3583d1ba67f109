"""All cases for robots in the order of the report, and the initial state of each. Pure."""

from typing import Final

from sightline.conformance.case import GROUPS, Bench, Case, ConformanceError
from sightline.conformance.robot import (
    arming,
    frames,
    hostile,
    lease,
    motion,
    ports,
    requests,
    twists,
    websocket,
)
from sightline.conformance.robot.fixture import FAST_LINK_US, REPLY_US, Robot, Sender
from sightline.protocol.channels import STATUS
from sightline.protocol.messages import State, Status

_PARTS: Final = (arming, frames, hostile, lease, motion, ports, requests, twists, websocket)
_SETTLES_US: Final = 6_000_000
_FIRST_US: Final = 5_000_000
_COASTS_US: Final = 500_000
"""Wheels with the command zero may turn a little longer. If they continue, the cases about that fail."""
_MEASURED: Final = 3
"""Requests over a slow link: a single one may be late for another reason."""
_MOST_LINK_US: Final = 300_000
"""A robot that is slower than that gets no more time."""
_ORDER: Final = tuple(GROUPS)

CASES: Final[tuple[Case, ...]] = tuple(
    sorted(
        (case for part in _PARTS for case in part.SUITE.cases),
        key=lambda case: (_ORDER.index(case.id.split("-")[1]), case.id),
    )
)


def is_there(bench: Bench) -> bool:
    """Return True if a robot with this id publishes a status, which every case needs."""
    return bench.wait(lambda: bench.newest(STATUS), _FIRST_US)


def prepare(bench: Bench) -> None:
    """Bring the robot to the initial state: DISARMED, no holder, wheels at zero. Raises ConformanceError."""
    robot = Robot(bench)
    is_there(bench)  # a robot that hung in the last case may need time to connect again
    robot.status()
    operator = Sender(robot, "operator", acks=False)
    robot.next_status()
    for _ in range(3):
        if robot.status().state in (State.STOPPED, State.FAULT):
            operator.request("reset")
        elif robot.status().state is not State.DISARMED:
            operator.request("disarm")
        _release(robot)
        if _is_at_rest(robot.status()) or robot.reaches(_is_at_rest, _SETTLES_US // 3):
            break
    else:
        raise ConformanceError("before the case the robot could not be brought to DISARMED, without holder, at zero")
    bench.wait(lambda: robot.evidence_of_motion(robot.clock_us() - _COASTS_US) is None, _COASTS_US)
    if bench.link_us is None:
        bench.link_us = _measured_link_us(operator)
    bench.forget()


def _measured_link_us(operator: Sender) -> int:
    """Return the time above `FAST_LINK_US` until the reply to a request that changes nothing; 0 without a reply."""
    fastest_us = _MOST_LINK_US
    for _ in range(_MEASURED):
        sent_us = operator.bench.now_us
        if operator.request("disarm") is None:
            operator.bench.rest(REPLY_US)  # a later reply must not look like one to the case
            return 0
        fastest_us = min(fastest_us, operator.bench.now_us - sent_us - FAST_LINK_US)
        if fastest_us <= 0:
            return 0
    return fastest_us


def _release(robot: Robot) -> None:
    """Release the lease of the last case, because waiting for its end would cost a second per case."""
    holder = robot.status().holder
    if holder is not None and robot.bench.access.may_request(holder.source):
        driver = robot.bench.played.get(holder.digest)
        if isinstance(driver, Sender):
            driver.request("release")


def _is_at_rest(status: Status) -> bool:
    return status.state is State.DISARMED and status.holder is None and status.applied == (0.0, 0.0)
