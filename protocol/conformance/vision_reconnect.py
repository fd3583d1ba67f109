"""Cases about a robot that goes away and comes back. Pure."""

from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.vision.fixture import RobotPlayed

SUITE = Suite("V")
_BACK_US: Final = 5_000_000
"""A second at most between two tries, two seconds until a silent peer is given up, and time to say hello."""


def _answered_again(bench: Bench, robot: RobotPlayed, what: str) -> None:
    """Within the time of a reconnection some frame is answered."""
    deadline_us = bench.now_us + _BACK_US
    mark = bench.mark()
    while bench.now_us < deadline_us and not robot.answers(mark):
        robot.frame()
        bench.rest(50_000)
    if not robot.answers(mark):
        robot.need_nothing_dropped()
    bench.expect(robot.answers(mark), f"no frame was answered within {_BACK_US / 1e6:g} s {what}")


@SUITE.must("V-RECO-01", "14.8 Liveness")
def connection_lost(bench: Bench) -> None:
    """When the connection is lost and comes back, the same robot is answered again within five seconds."""
    robot = RobotPlayed(bench).met()
    bench.leave()
    bench.rest(300_000)
    bench.join()
    _answered_again(bench, robot, "after the connection came back")


@SUITE.must("V-RECO-02", "2.5 Session and sequence")
def robot_restarted(bench: Bench) -> None:
    """When the robot is gone for a second and starts anew, it is answered within five seconds."""
    RobotPlayed(bench).met().stop()
    bench.leave()
    bench.rest(1_000_000)
    bench.join()
    _answered_again(bench, RobotPlayed(bench, first_seq=0, first_t_us=500), "after the robot started anew")


@SUITE.must("V-RECO-03", "14.8 Liveness")
def connection_flaps(bench: Bench) -> None:
    """A connection lost three times in a row, in the middle of frames, is no reason to give up."""
    robot = RobotPlayed(bench).met()
    for _ in range(3):
        robot.frame()
        bench.leave()
        bench.rest(100_000)
        bench.join()
        _answered_again(bench, robot, "after the connection came back")


@SUITE.must("V-RECO-04", "2.5 Session and sequence")
def counts_on(bench: Bench) -> None:
    """Within a session of its own, its `seq` goes on over a reconnection."""
    robot = RobotPlayed(bench).met()
    before = robot.answers()[-1]
    bench.leave()
    bench.rest(300_000)
    bench.join()
    mark = bench.mark()
    for _ in range(60):
        robot.frame()
        bench.rest(50_000)
        if robot.twists(mark):
            break
    bench.need(robot.twists(mark), "it does not come back")
    after = robot.twists(mark)[0]
    numbers = before.fields.get("seq"), after.fields.get("seq")
    same = before.fields.get("session") == after.fields.get("session")
    told = isinstance(numbers[0], int) and isinstance(numbers[1], int)
    bench.expect(not same or not told or numbers[0] < numbers[1],  # type: ignore[operator]
                 f"`seq` was {numbers[0]} before and {numbers[1]} after, in one session")


@SUITE.must("V-RECO-05", "1.5 Delivery")
def nothing_kept_back(bench: Bench) -> None:
    """What it could not say while the robot was gone is not said later."""
    robot = RobotPlayed(bench).met()
    sent = robot.film("left", 3, 0)
    bench.leave()
    bench.rest(1_000_000)
    bench.join()
    mark = bench.mark()
    bench.rest(1_500_000)
    late = [one for one in robot.answers(mark) if any(one.cites(frame) for frame in sent)]
    bench.expect(not late, f"{len(late)} answers to frames from before came after the reconnection")
