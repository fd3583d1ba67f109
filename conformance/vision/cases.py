"""All cases for vision services in the order of the report, and the initial state of each. Pure."""

from typing import Final

from sightline.conformance.case import Bench, Case
from sightline.conformance.vision import answers, causality, flow, hostile, reports, websocket
from sightline.conformance.vision.fixture import ANSWER_US, RobotPlayed

_FIRST_US: Final = 20_000_000
"""A vision service may still be starting."""
_AGAIN_US: Final = 3_000_000
"""A vision service that lost its robot in the last case tries again every second."""
_EVERY_US: Final = 100_000
_FRAMES_FOR_TWO: Final = 5
_PARTS: Final = (answers, causality, flow, reports, hostile, websocket)

CASES: Final[tuple[Case, ...]] = tuple(case for part in _PARTS for case in part.SUITE.cases)


def is_there(bench: Bench) -> bool:
    """Return True if a vision service answers. It may be starting. Raises LinkError if two answer."""
    prepare(bench)
    robot = RobotPlayed(bench, camera=None)
    if bench.mark():
        robot.film("absent", _FRAMES_FOR_TWO)
        robot.answers()
    robot.stop()
    return bool(bench.mark() or bench.dropped_here.total())


def prepare(bench: Bench) -> None:
    """Wait until the vision service answers the kit's robot, even if this end rejects the answer.

    The robot publishes no camera model; a case tests that. A slow vision service may still compute for the last
    frame. This waits for its answer, so that the service takes the first frame of the case next.
    """
    robot = RobotPlayed(bench, camera=None)
    before = bench.dropped_here.total()
    deadline_us = bench.now_us + (_AGAIN_US if bench.mark() else _FIRST_US)
    while bench.now_us < deadline_us:
        sent = robot.frame("absent")
        if bench.wait(lambda: robot.answers() or bench.dropped_here.total() > before, _EVERY_US):
            robot.is_answered(sent, sent.at_us + ANSWER_US - bench.now_us)
            break
    robot.stop()
