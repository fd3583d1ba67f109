"""All cases for robots, in the order of the report, and what prepares a robot for each. Shell (some have sockets)."""

from typing import Final

from protocol.conformance import (
    robot_arming,
    robot_asking,
    robot_commands,
    robot_flow,
    robot_framing,
    robot_hostile,
    robot_lease,
    robot_messages,
    robot_motion,
    robot_older,
    robot_sockets,
    robot_stop,
)
from protocol.conformance.case import GROUPS, Case
from protocol.conformance.robot_rig import prepare

__all__ = ["CASES", "prepare"]

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
)
_ORDER: Final = tuple(GROUPS)

CASES: Final[tuple[Case, ...]] = tuple(
    sorted(
        (case for suite in _SUITES for case in suite.cases),
        key=lambda case: (_ORDER.index(case.id.split("-")[1]), case.id),
    )
)
