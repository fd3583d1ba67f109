"""Cases about where a vision steers: towards its target, and nowhere without one. Pure.

Nearly all are SHOULD: what a vision does with what it sees is its own; these are what a person expects of one that
follows a yellow ball, which is what ours do unless told otherwise.
"""

from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.vision.fixture import Answer, RobotPlayed

SUITE = Suite("V")
_SECOND: Final = 20
_EVERY_US: Final = 50_000
_AHEAD_RAD_S: Final = 0.2
"""Less than this is no turn: a target straight ahead."""
_STILL_MPS: Final = 0.001


def _last_twist(bench: Bench, robot: RobotPlayed, name: str, frames: int = _SECOND) -> Answer:
    """What it says after so many pictures of one kind."""
    mark = bench.mark()
    robot.film(name, frames, _EVERY_US)
    twists = robot.twists(mark)
    bench.need(twists, "it sends no twists")
    return twists[-1]


@SUITE.should("V-STEER-01", "4.4 Signs")
def turns_left(bench: Bench) -> None:
    """A target to the left is turned to: angular velocity above zero, counter-clockwise."""
    angular = _last_twist(bench, RobotPlayed(bench).met(), "left").speeds[1]
    bench.expect(angular > 0, f"it turns at {angular:g} rad/s")


@SUITE.should("V-STEER-02", "4.4 Signs")
def turns_right(bench: Bench) -> None:
    """A target to the right is turned to: angular velocity below zero."""
    angular = _last_twist(bench, RobotPlayed(bench).met(), "right").speeds[1]
    bench.expect(angular < 0, f"it turns at {angular:g} rad/s")


@SUITE.should("V-STEER-03", "4.4 Signs")
def goes_straight(bench: Bench) -> None:
    """A target straight ahead is no reason to turn."""
    angular = _last_twist(bench, RobotPlayed(bench).met(), "centre").speeds[1]
    bench.expect(abs(angular) < _AHEAD_RAD_S, f"it turns at {angular:g} rad/s")


@SUITE.should("V-STEER-04", "4.4 Signs")
def stays_without_target(bench: Bench) -> None:
    """Without ever a target it drives nowhere; it may turn to look for one."""
    robot = RobotPlayed(bench)
    mark = bench.mark()
    robot.film("absent", 2 * _SECOND, _EVERY_US)
    fastest = max((abs(one.speeds[0]) for one in robot.twists(mark)), default=0.0)
    bench.expect(fastest < _STILL_MPS, f"it drives at {fastest:g} m/s")


@SUITE.should("V-STEER-05", "12.2 Saw nothing, no answer")
def stops_for_a_lost_target(bench: Bench) -> None:
    """Three seconds after the target was last seen it drives nowhere."""
    robot = RobotPlayed(bench).met()
    robot.film("centre", _SECOND // 2, _EVERY_US)
    linear = _last_twist(bench, robot, "absent", 3 * _SECOND).speeds[0]
    bench.expect(abs(linear) < _STILL_MPS, f"it still drives at {linear:g} m/s")


@SUITE.should("V-STEER-06", "4.4 Signs")
def follows_to_the_other_side(bench: Bench) -> None:
    """A target that was on the left and is on the right now is turned to within two seconds."""
    robot = RobotPlayed(bench).met()
    _last_twist(bench, robot, "left")
    angular = _last_twist(bench, robot, "right", 2 * _SECOND).speeds[1]
    bench.expect(angular < 0, f"it turns at {angular:g} rad/s")


@SUITE.should("V-STEER-07", "4.4 Signs")
def same_frames_same_twists(bench: Bench) -> None:
    """The same frames of two sessions get the same twists, at whatever pace they come: its clock is the frames'."""
    first, second = (_replayed(bench, every_us) for every_us in (30_000, 90_000))
    bench.need(all(first) and all(second), "not every frame got a twist")
    bench.expect(first == second, f"{first} and then {second}")


def _replayed(bench: Bench, every_us: int) -> list[bytes]:
    """The twists for one sequence of frames, as text; empty for a frame without one."""
    robot = RobotPlayed(bench).met()
    robot.stop()
    robot = RobotPlayed(bench)
    names = ["absent", "left", "left", "centre", "right", "absent", "centre", "left"] * 2
    texts = []
    for number, name in enumerate(names):
        sent = robot.frame(name, seq=number + 1, t_us=5_000_000 + number * 40_000)
        robot.is_answered(sent)
        texts.append(next((one.text for one in robot.answers_to(sent) if one.is_twist), b""))
        bench.rest(every_us)
    robot.stop()
    return texts


@SUITE.must("V-STEER-08", "2.5 Session and sequence")
def new_start_new_memory(bench: Bench) -> None:
    """A robot that starts anew is not driven by what its last start saw."""
    robot = RobotPlayed(bench).met()
    robot.film("centre", _SECOND // 2, _EVERY_US)
    robot.stop()
    robot = RobotPlayed(bench)
    mark = bench.mark()
    robot.film("absent", 4, _EVERY_US)
    fastest = max((abs(one.speeds[0]) for one in robot.twists(mark)), default=0.0)
    bench.expect(fastest < _STILL_MPS, f"it drives at {fastest:g} m/s by nothing that this start has shown")
