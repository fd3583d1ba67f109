"""All cases for robots in the order of the report, and the state in which each begins. Pure."""

from typing import Final

from sightline.protocol.channels import STATUS
from sightline.conformance.robot import (
    arming as robot_arming,
    requests as robot_asking,
    twists as robot_commands,
    frames as robot_framing,
    hostile as robot_hostile,
    lease as robot_lease,
    motion as robot_motion,
    legacy as robot_older,
    websocket as robot_sockets,
)
from sightline.conformance.robot import (
    frames as robot_credit,
    websocket as robot_doors,
    frames as robot_flow,
    websocket as robot_messages,
    twists as robot_order,
    requests as robot_requests,
    arming as robot_stop,
    websocket as robot_tokens,
)
from sightline.conformance.case import Bench
from sightline.conformance.case import GROUPS, Case, ConformanceError
from sightline.conformance.robot.fixture import Robot, Sender
from sightline.protocol.messages import State, Status

_SUITES: Final = (
    robot_framing.SUITE,
    robot_commands.SUITE,
    robot_lease.SUITE,
    robot_arming.SUITE,
    robot_stop.SUITE,
    robot_motion.SUITE,
    robot_asking.SUITE,
    robot_flow.SUITE,
    robot_hostile.SUITE,
    robot_older.SUITE,
    robot_sockets.SUITE,
    robot_messages.SUITE,
    robot_tokens.SUITE,
    robot_order.SUITE,
    robot_requests.SUITE,
    robot_doors.SUITE,
    robot_credit.SUITE,
)
_SETTLES_US: Final = 6_000_000
_FIRST_US: Final = 5_000_000
_ORDER: Final = tuple(GROUPS)

CASES: Final[tuple[Case, ...]] = tuple(
    sorted(
        (case for suite in _SUITES for case in suite.cases),
        key=lambda case: (_ORDER.index(case.id.split("-")[1]), case.id),
    )
)


def is_there(bench: Bench) -> bool:
    """Whether a robot of this id says anything: a case can be judged by nothing else."""
    return bench.wait(lambda: bench.newest(STATUS), _FIRST_US)


def prepare(bench: Bench) -> None:
    """Bring the robot to where a case begins: DISARMED, nobody drives, wheels at zero. Raises ConformanceError."""
    robot = Robot(bench)
    robot.status()
    operator = Sender(robot, "operator", acks=False)
    robot.next_status()
    for _ in range(3):
        if robot.status().state in (State.STOPPED, State.FAULT):
            operator.ask("reset")
        elif robot.status().state is not State.DISARMED:
            operator.ask("disarm")
        if robot.reaches(_is_at_rest, _SETTLES_US // 3):
            break
    else:
        raise ConformanceError("before the case the robot could not be brought to DISARMED, without holder, at zero")
    bench.forget()


def _is_at_rest(status: Status) -> bool:
    return status.state is State.DISARMED and status.holder is None and status.applied == (0.0, 0.0)
