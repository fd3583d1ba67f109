"""Cases on a vision service's answers: framing, headers, grammar, and steering. Pure."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from sightline.conformance.case import Bench, Suite, itself
from sightline.conformance.vision.fixture import RobotPlayed, VisionAnswer, met
from sightline.conformance.vision.images import CAMERA as LENS
from sightline.conformance.vision.images import HALF_CAMERA, png
from sightline.protocol.channels import MAX_HEADER_BYTES
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import MAX_INTEGER, Planar
from sightline.protocol.spec.message_cases import packed
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import INEXACT_KEY, OVERSIZE
from sightline.protocol.transports.websocket.framing import BAD_FRAMING

SUITE = Suite("V")
_SESSION: Final = re.compile(r"[0-9a-f]{8}")
_ECHO: Final = {"channel", "session", "seq", "t_us"}
_LAST_US: Final = 200_000
"""Lead of a frame over the robot's other messages; from 500 ms on it is forged (2.6)."""
_FOUR_DECIMALS: Final = re.compile(rb"[+-]?[0-9]+\.[0-9]{4}\|[+-]?[0-9]+\.[0-9]{4}")


def _sample(bench: Bench, junk: int = 1) -> list[VisionAnswer]:
    """Return the answers to six views, with a target at the side, ahead and absent, and acks of invalid images."""
    robot = RobotPlayed(bench)
    for name in ("left", "left", "centre", "centre", "right", "absent"):
        robot.is_driven(robot.frame(name))
    for _ in range(junk):
        robot.frame(jpeg=png())
        bench.rest(100_000)
    answers = robot.answers()
    if not answers:
        robot.need_nothing_dropped()
    bench.need(answers, "it answers nothing")
    return answers


def _every(bench: Bench, good: Callable[[dict[str, Any]], object], reason: str) -> None:
    """Check the header of every answer."""
    for answer in _sample(bench):
        bench.expect(good(answer.fields), f"{reason}: {answer.received.message.header[:200]!r}")


def _integer(value: object, least: int = 0) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= MAX_INTEGER


# --- framing ---------------------------------------------------------------------------------------------------------


@SUITE.must("V-FRAM-01", "7.1 Answers", RobotPlayed)
def every_frame_is_answered(_bench: Bench, robot: RobotPlayed) -> None:
    """A frame that nothing replaces is answered, by a twist or an ack, within half a second."""
    for name in ("centre", "left", "absent", "right", "centre"):
        robot.answer_to(robot.frame(name))


@SUITE.should("V-FRAM-02", "7.1 Answers", met)
def one_answer(bench: Bench, robot: RobotPlayed) -> None:
    """A frame that a twist answered is not acknowledged as well."""
    for sent in robot.film("centre", 5, 100_000):
        # An ack before its twist means that a peer steers by this frame later.
        kinds = [one.is_twist for one in robot.answers_to(sent)]
        bench.expect(kinds == sorted(kinds), f"frame {sent.seq} got an ack after its twist")


@SUITE.must("V-FRAM-03", "7.1 Answers")
def empty_ack(bench: Bench) -> None:
    """An ack has no payload."""
    before = bench.dropped_here[OVERSIZE]
    _sample(bench, junk=0)
    bench.need(bench.dropped_here[OVERSIZE] == before, "its twists are too large already")
    _sample(bench, junk=3)
    bench.expect(bench.dropped_here[OVERSIZE] == before, "an answer to an invalid image was over its channel's size")


@SUITE.must("V-FRAM-04", "1.3 Keys")
def exact_keys(bench: Bench) -> None:
    """It publishes under exact keys: channel and role, nothing more."""
    before = bench.dropped_here[INEXACT_KEY]
    robot = RobotPlayed(bench)
    robot.film("left", 5, 100_000)
    bench.expect(bench.dropped_here[INEXACT_KEY] == before, "something came under an invalid key")


@SUITE.must("V-FRAM-05", "1.3 Keys")
def same_role(bench: Bench) -> None:
    """The role in an answer's header is the one in its key."""
    for answer in _sample(bench):
        source, key = answer.fields.get("source"), answer.received.message.source
        bench.need(isinstance(source, str), "its headers name no role")
        bench.expect(source == key, f"the header reports {source!r}, the key {key!r}")


@SUITE.must("V-FRAM-06", "1.1 Peers")
def drives_as_vision(bench: Bench) -> None:
    """It drives as `vision`: teleop is a human's rank, and guests carry no header."""
    for answer in _sample(bench):
        bench.expect(answer.received.message.source == "vision", f"it came as {answer.received.message.source!r}")


# --- headers of frames, as a robot may write them --------------------------------------------------------------------

_READS: Final[dict[str, tuple[str, str, Callable[[dict[str, Any]], bytes]]]] = {
    "V-FRAM-11": ("2.8 Fields", "A frame with nothing but its stamp is read: the rest has defaults.",
                  lambda it: packed({name: it[name] for name in ("v", "session", "seq", "t_us")})),
    "V-FRAM-12": ("1.4 Sizes", "A header of 512 bytes is read.", lambda it: packed(it).ljust(MAX_HEADER_BYTES)),
    "V-FRAM-13": ("2.1 JSON", "`latency_us` may be null.", lambda it: packed(it | {"latency_us": None})),
    "V-FRAM-14": ("2.1 JSON", "Unknown fields of a header are ignored.",
                  lambda it: packed(it | {"weather": {"rain": [1, None, "x"]}, "camera": "front"})),
    "V-FRAM-15": ("2.4 Version", "A header without a version is of version 1.",
                  lambda it: packed({name: value for name, value in it.items() if name != "v"})),
    "V-FRAM-16": ("2.1 JSON", "Of a field given twice the last counts.",
                  lambda it: b'{"v":1,"session":"ffffffff","seq":3,"t_us":5,' + packed(it)[1:]),
    "V-FRAM-17": ("2.1 JSON", "Blanks and line ends between a header's fields are JSON, and read.",
                  lambda it: b"{" + json.dumps(it, indent=2).encode()[1:].lstrip()),
    "V-FRAM-18": ("2.1 JSON", "Characters of a header may be escaped.",
                  lambda it: packed(it).replace(b'"seq"', b'"\\u0073eq"')),
}


def _reads(write: Callable[[dict[str, Any]], bytes], robot: RobotPlayed) -> None:
    for _ in range(2):
        fields = robot.next_fields()
        stamp = {name: fields[name] for name in ("session", "seq", "t_us")}
        robot.expect_twist(robot.frame(header=write(fields), **stamp))


SUITE.must_all(met, {
    number: (clause, title, partial(_reads, write)) for number, (clause, title, write) in _READS.items()
})


@SUITE.must("V-FRAM-19", "2.2 Numbers")
def largest_integers(bench: Bench) -> None:
    """`seq` and `t_us` up to 2^53 - 1 come back as they were."""
    robot = RobotPlayed(bench, first_seq=MAX_INTEGER - 40, first_t_us=MAX_INTEGER - _LAST_US)
    robot.stop()  # its clock is near its end
    answer = robot.answer_to(robot.frame(seq=MAX_INTEGER, t_us=MAX_INTEGER))
    got = (answer.echo.get("seq"), answer.echo.get("t_us"))
    bench.expect(got == (MAX_INTEGER, MAX_INTEGER), f"it cites seq {got[0]} and t_us {got[1]}")


@SUITE.must("V-FRAM-20", "2.2 Numbers")
def zeros(bench: Bench) -> None:
    """A session may begin with `seq` 0 at `t_us` 0."""
    robot = RobotPlayed(bench, first_seq=0, first_t_us=0)
    answer = robot.answer_to(robot.frame(seq=0, t_us=0))
    bench.expect(answer.echo.get("seq") == 0, f"it came to {answer.words()}")


# --- headers of answers ----------------------------------------------------------------------------------------------


@SUITE.must("V-HEAD-01", "2.1 JSON")
def header_is_an_object(bench: Bench) -> None:
    """An answer's header is one JSON object in UTF-8, without a byte order mark."""
    for answer in _sample(bench):
        header = answer.received.message.header
        bench.expect(answer.fields and header[:1] not in b"\xef\xfe\xff", f"no JSON object in UTF-8: {header[:80]!r}")


@SUITE.must("V-HEAD-02", "1.4 Sizes")
def header_size(bench: Bench) -> None:
    """Nothing it sends is over its channel's size: headers at most 512 bytes, a twist at most 64."""
    def dropped() -> int:  # the block of a longer header ends the connection of a WebSocket (14.9)
        return bench.dropped_here[OVERSIZE] + bench.dropped_here[BAD_FRAMING]

    before = dropped()
    RobotPlayed(bench).film("left", 5, 100_000)
    bench.expect(dropped() == before, "a header or a payload was over its bound, or its block was broken")


SUITE.must_all(itself, {
    "V-HEAD-03": ("2.4 Version", "`v` is 1, or absent.",
                  lambda bench: _every(bench, lambda it: _integer(it.get("v", 1)) and it.get("v", 1) == 1,
                                       "`v` is not 1")),
    "V-HEAD-04": ("2.5 Session and sequence", "`session` is 8 lower-case hex digits.",
                  lambda bench: _every(bench, lambda it: not it or _SESSION.fullmatch(str(it.get("session"))),
                                       "no 8 lower-case hex digits")),
    "V-HEAD-05": ("2.2 Numbers", "`seq` is an integer from 0 to 2^53 - 1.",
                  lambda bench: _every(bench, lambda it: not it or _integer(it.get("seq")),
                                       "`seq` is not an integer within bounds")),
    "V-HEAD-06": ("2.8 Fields", "`source` is given.",
                  lambda bench: _every(bench, lambda it: not it or isinstance(it.get("source"), str), "no `source`")),
    "V-HEAD-07": ("2.7 Echo", "`echo` has all of its four fields.",
                  lambda bench: _every(bench, lambda it: not it or set(it.get("echo") or ()) >= _ECHO,
                                       "the echo is not complete")),
    "V-HEAD-08": ("2.2 Numbers", "`compute_us` is an integer from 0 on, or absent.",
                  lambda bench: _every(bench, lambda it: _integer(it.get("compute_us", 0)),
                                       "`compute_us` is not an integer within bounds")),
})


@SUITE.should("V-HEAD-09", "7.4 Window")
def compute_given(bench: Bench) -> None:
    """`compute_us` is given: without it a slow detector looks like a slow link, and the window widens."""
    answers = _sample(bench)
    bench.expect(any(one.fields.get("compute_us") for one in answers if one.fields) or not answers[0].fields,
                 "it is 0 or absent in every answer")


@SUITE.must("V-HEAD-10", "2.2 Numbers")
def no_infinite_numbers(bench: Bench) -> None:
    """No NaN and no Infinity in a header: JSON has none."""
    for answer in _sample(bench):
        header = answer.received.message.header
        bench.expect(b"NaN" not in header and b"Infinity" not in header, f"{header[:200]!r}")


@SUITE.must("V-HEAD-11", "18.6 What an answer went by")
def names_what_came(bench: Bench) -> None:
    """An answer names a `scan` and a `mission` only of this session of the robot: here none came."""
    for answer in _sample(bench):
        named = {name: value for name in ("scan", "mission") if (value := answer.fields.get(name)) is not None}
        bench.expect(not named, f"it names {named}")


# --- grammar of twists -----------------------------------------------------------------------------------------------


def _twists(bench: Bench) -> list[VisionAnswer]:
    twists = [one for one in _sample(bench) if one.is_twist]
    bench.need(twists, "it sends no twists")
    return twists


@SUITE.must("V-GRAM-01", "4.1 Grammar")
def grammar(bench: Bench) -> None:
    """A twist's payload is `linear|angular` in the grammar, and nothing else."""
    for twist in _twists(bench):
        try:
            parse_twist(twist.text)
        except WireError as error:
            bench.expect(error.reason is not RejectReason.MALFORMED, error.detail)


@SUITE.must("V-GRAM-02", "4.1 Grammar")
def finite(bench: Bench) -> None:
    """Both numbers of a twist are finite."""
    for twist in _twists(bench):
        bench.expect(all(map(math.isfinite, twist.speeds)), f"{twist.text!r}")


@SUITE.should("V-GRAM-03", "4.2 Writing")
def four_decimals(bench: Bench) -> None:
    """A twist is written with four decimals."""
    for twist in _twists(bench):
        bench.expect(not _is_number_pair(twist) or _FOUR_DECIMALS.fullmatch(twist.text), f"{twist.text!r}")


def _is_number_pair(twist: VisionAnswer) -> bool:
    try:
        parse_twist(twist.text)
    except WireError:
        return False
    return True


@SUITE.should("V-GRAM-04", "4.2 Writing")
def no_minus_zero(bench: Bench) -> None:
    """Zero has no sign."""
    for twist in _twists(bench):
        bench.expect(not any(number == 0 and math.copysign(1, number) < 0 for number in twist.speeds),
                     f"{twist.text!r}")


# Cases about steering: towards the target, and no motion without one. Pure.
#
# The choice of the target is free. Order and signs of the axes are not: they are MUST for each service whose
# twists depend on the kit's yellow ball, as those of our services do by default.


_SECOND: Final = 20
_LOOKS: Final = 12
_EVERY_US: Final = 50_000
_AHEAD_RAD_S: Final = 0.2
"""Smaller rates are not a turn, for a target straight ahead."""
_STILL_MPS: Final = 0.001
_SAME: Final = 0.01
"""Speeds with a smaller difference, in m/s or rad/s, are the same."""


@dataclass(frozen=True, slots=True)
class _Steering:
    """The twists toward a far target straight ahead, and toward a near one at each side: (m/s, rad/s)."""

    bench: Bench
    ahead: Planar
    left: Planar
    right: Planar

    def expect_turn(self, toward: Planar, side: int) -> None:
        """Fail the case unless `toward` turns to `side`, 1 for left, and drives no faster than straight ahead."""
        linear, angular = toward
        self.bench.expect(side * angular > _SAME, f"linear, angular are {linear:g}, {angular:g}: it turns away from it")
        slower = f"it drives at {linear:g} m/s to a near one at the side, at {self.ahead[0]:g} m/s to a far one ahead"
        self.bench.expect(linear <= self.ahead[0] + _SAME, slower)

    def expect_straight(self) -> None:
        """Fail the case if a target straight ahead makes it turn."""
        self.bench.expect(abs(self.ahead[1]) < _AHEAD_RAD_S, f"it turns at {self.ahead[1]:g} rad/s")

    def expect_forward(self) -> None:
        """Fail the case unless a far target makes it drive forward; not applicable to a service that only turns."""
        self.bench.need(any(abs(one[0]) > _SAME for one in (self.ahead, self.left, self.right)), "it only turns")
        self.bench.expect(self.ahead[0] > _SAME, f"it drives at {self.ahead[0]:g} m/s")


def _steering(bench: Bench) -> _Steering:
    """Return the answers to three places of the target. Not applicable to a service that follows another object."""
    found = _Steering(bench, *(_toward(bench, name) for name in ("far", "near_left", "near_right")))
    apart = max(abs(one - other) for side in (found.left, found.right)
                for one, other in zip(side, found.ahead, strict=True))
    bench.need(apart > _SAME, "its twists do not depend on where a yellow ball is (V-STEER-10)")
    return found


def _toward(bench: Bench, name: str) -> Planar:
    """Return (m/s, rad/s) of its last answer to a new robot that shows one image only."""
    robot = RobotPlayed(bench)
    robot.is_driven(robot.film(name, _LOOKS, _EVERY_US)[-1])
    robot.stop()
    twists = robot.twists()
    bench.need(twists, "it sends no twists")
    bench.need(all(map(math.isfinite, twists[-1].speeds)), "its twists are not finite (V-GRAM-02)")
    return twists[-1].speeds


SUITE.must_all(_steering, {
    "V-STEER-01": ("4.4 Signs", "A near target to the left is turned to: angular velocity, the second number, above "
                   "zero, and no faster than to a far one ahead.", lambda it: it.expect_turn(it.left, 1)),
    "V-STEER-02": ("4.4 Signs", "A near target to the right is turned to: angular velocity below zero, and no faster "
                   "than to a far one ahead.", lambda it: it.expect_turn(it.right, -1)),
    "V-STEER-03": ("4.4 Signs", "A target straight ahead is not a reason to turn.", _Steering.expect_straight),
    "V-STEER-09": ("4.4 Signs", "A far target straight ahead is driven to: linear velocity, the first number, above "
                   "zero.", _Steering.expect_forward),
})


@SUITE.should("V-STEER-10", "4.4 Signs")
def steers_by_the_target(bench: Bench) -> None:
    """A target to the left and one to the right get different twists."""
    left, right = _toward(bench, "near_left"), _toward(bench, "near_right")
    apart = max(abs(one - other) for one, other in zip(left, right, strict=True))
    bench.expect(apart > _SAME, f"both get linear, angular {left[0]:g}, {left[1]:g}")


def _last_twist(bench: Bench, robot: RobotPlayed, name: str, frames: int = _SECOND) -> VisionAnswer:
    """Return its answer after a number of images of one kind."""
    mark = bench.mark()
    robot.is_driven(robot.film(name, frames, _EVERY_US)[-1])
    twists = robot.twists(mark)
    bench.need(twists, "it sends no twists")
    return twists[-1]


@SUITE.should("V-STEER-04", "4.4 Signs", RobotPlayed)
def stays_without_target(bench: Bench, robot: RobotPlayed) -> None:
    """Without ever a target it drives nowhere; it may turn to look for one."""
    mark = bench.mark()
    robot.film("absent", 2 * _SECOND, _EVERY_US)
    fastest = max((abs(one.speeds[0]) for one in robot.twists(mark)), default=0.0)
    bench.expect(fastest < _STILL_MPS, f"it drives at {fastest:g} m/s")


@SUITE.should("V-STEER-05", "12.2 Saw nothing, no answer", met)
def stops_for_a_lost_target(bench: Bench, robot: RobotPlayed) -> None:
    """Three seconds after the target was last seen it drives nowhere."""
    robot.film("centre", _SECOND // 2, _EVERY_US)
    linear = _last_twist(bench, robot, "absent", 3 * _SECOND).speeds[0]
    bench.expect(abs(linear) < _STILL_MPS, f"it still drives at {linear:g} m/s")


@SUITE.should("V-STEER-06", "4.4 Signs", met)
def follows_to_the_other_side(bench: Bench, robot: RobotPlayed) -> None:
    """A target that was on the left and is on the right now is turned to within two seconds."""
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
    """Return the twists for one sequence of frames, as text; empty for a frame without one."""
    robot = RobotPlayed(bench).met()
    robot.stop()
    robot = RobotPlayed(bench)
    names = ["absent", "left", "left", "centre", "right", "absent", "centre", "left"] * 2
    texts = []
    for number, name in enumerate(names):
        sent = robot.frame(name, seq=number + 1, t_us=5_000_000 + number * 40_000)
        robot.is_driven(sent)
        texts.append(next((one.text for one in robot.answers_to(sent) if one.is_twist), b""))
        bench.rest(every_us)
    robot.stop()
    return texts


@SUITE.must("V-STEER-08", "2.5 Session and sequence", met)
def new_start_new_memory(bench: Bench, robot: RobotPlayed) -> None:
    """A robot that starts again is not driven by what its last start saw."""
    robot.film("centre", _SECOND // 2, _EVERY_US)
    robot.stop()
    robot = RobotPlayed(bench)
    sent = robot.film("absent", 4, _EVERY_US)
    robot.is_driven(sent[-1])
    fastest = max((abs(one.speeds[0]) for frame in sent for one in robot.twists_to(frame)), default=0.0)
    bench.expect(fastest < _STILL_MPS, f"it drives at {fastest:g} m/s by nothing that this start has shown")


_NOT_FOLLOWING: Final = "it does not follow the yellow ball"


@SUITE.must("V-STEER-11", "4.4 Signs", met)
def turns_by_the_new_size(bench: Bench, robot: RobotPlayed) -> None:
    """After a change of the image size, a target right of the new middle is turned to."""
    bench.need(_last_twist(bench, robot, "right").speeds[1] < 0, _NOT_FOLLOWING)
    robot.show(HALF_CAMERA)
    angular = _last_twist(bench, robot, "right_half").speeds[1]
    bench.expect(angular < 0, f"it turns at {angular:g} rad/s")


@SUITE.should("V-STEER-12", "10.1 Camera, odometry, scan", met)
def turns_by_the_new_model(bench: Bench, robot: RobotPlayed) -> None:
    """A camera model of the same image size, with its middle elsewhere, is steered by within a second."""
    bench.need(_last_twist(bench, robot, "left").speeds[1] > 0, _NOT_FOLLOWING)
    robot.show(LENS.model_copy(update={"cx_px": 40.0}))
    angular = _last_twist(bench, robot, "left").speeds[1]
    bench.expect(angular < 0, f"it turns at {angular:g} rad/s to a target that is right of the new middle")
