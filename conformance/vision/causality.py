"""Cases about answers: the cited frame, the order, the sender: causality, sequence, proof. Pure."""

import itertools
import re
from collections.abc import Callable
from functools import partial
from statistics import median
from typing import Any, Final

from sightline.conformance.case import Bench, Level, Received, Suite, itself
from sightline.conformance.vision.fixture import (
    ANSWER_US,
    ARMED,
    FRAME_US,
    RobotPlayed,
    Sent,
    VisionAnswer,
    met,
    read_answer,
)
from sightline.conformance.vision.images import CAMERA as LENS
from sightline.conformance.vision.images import LARGE_CAMERA, commented, gray, picture, png
from sightline.protocol.channels import SCAN, STATUS, TWIST, Channel
from sightline.protocol.codec import encode
from sightline.protocol.messages import MAX_INTEGER, CameraModel
from sightline.protocol.proof import MAX_LOST, Proof, continues
from sightline.protocol.spec.message_cases import packed

SUITE = Suite("V")
_BURST = 20
_RECOVERS_US = 1_000_000
_STARTING: Final = 10
_LOST: Final = 30
_HOUR_US: Final = 3_600_000_000
_SECONDS_US: Final = 10_000_000
_SEQ_LEAP: Final = 100_000
"""Less than an hour and than the largest `seq`, and still far above what 2.6 allows: 500 ms, and 1000 in `seq`."""
_OTHER_SESSION: Final = "fffffff0"
_MAX_FIRST_SEQ: Final = 2**32
_MAX_SEQ_STEP: Final = 2**20
_MEASURED: Final = 5
_TRIES: Final = 3
"""A load that begins between the two measurements delays the large image alone."""
_MEASURABLE_US: Final = 10_000
"""A smaller difference between two medians may come from the machine."""
_COMMENTS: Final = 3
_RAYS: Final[dict[str, Any]] = {
    "angle_min_rad": -1.0, "angle_increment_rad": 0.5, "range_min_m": 0.1, "range_max_m": 8.0,
}  # fmt: skip


def _cited(bench: Bench) -> list[tuple[Sent, VisionAnswer]]:
    """Return six frames with their twists, and an invalid image with its ack, if there is one (3.3)."""
    robot = RobotPlayed(bench)
    sent = [*robot.film("left", 6, 100_000), robot.frame(jpeg=png())]
    robot.is_answered(sent[-1])
    pairs = [(one, answer) for one in sent for answer in robot.answers_to(one)]
    if not pairs:
        robot.need_nothing_dropped()
    bench.need(pairs, "its answers cite no frame")
    return pairs


def _echoes(bench: Bench, field: str, right: Callable[[Sent], Any]) -> None:
    for sent, answer in _cited(bench):
        got = answer.echo.get(field, right(sent))
        bench.expect(got == right(sent) and type(got) is type(right(sent)), f"{field} was {right(sent)!r}, not {got!r}")


SUITE.must_all(itself, {
    "V-CAUS-01": ("2.7 Echo", "An echo's channel is that of frames.",
                  lambda it: _echoes(it, "channel", lambda _: "frame")),
    "V-CAUS-02": ("2.7 Echo", "An echo's session is the frame's.",
                  lambda it: _echoes(it, "session", lambda sent: sent.session)),
    "V-CAUS-03": ("2.7 Echo", "An echo's `seq` is the frame's, as an integer.",
                  lambda it: _echoes(it, "seq", lambda sent: sent.seq)),
    "V-CAUS-04": ("2.7 Echo", "An echo's `t_us` is the frame's, to the microsecond.",
                  lambda it: _echoes(it, "t_us", lambda sent: sent.t_us)),
})


@SUITE.must("V-CAUS-05", "4.5 Echo", RobotPlayed)
def nothing_before_a_frame(bench: Bench, robot: RobotPlayed) -> None:
    """Before a frame came there is nothing to answer: camera and status alone drive nothing."""
    bench.rest(ANSWER_US)  # the last answer to the earlier start may be late
    mark = bench.mark()
    bench.rest(1_500_000)
    bench.expect(not robot.answers(mark), "it answered before it was sent a frame")


@SUITE.should("V-CAUS-06", "7.1 Answers", met)
def no_frame_twice(bench: Bench, robot: RobotPlayed) -> None:
    """No frame is cited by two twists."""
    sent = robot.film("left", 5, 100_000)
    bench.rest(700_000)
    for one in sent:
        twists = robot.twists_to(one)
        bench.expect(len(twists) < 2, f"frame {one.seq} is cited by {len(twists)} twists")


@SUITE.must("V-CAUS-07", "1.5 Delivery", met)
def newest_wins(bench: Bench, robot: RobotPlayed) -> None:
    """In a burst of 20 frames no older frame is answered after a newer one."""
    mark = bench.mark()
    burst = [robot.frame("left").seq for _ in range(_BURST)]
    bench.rest(1_000_000)
    answers = [one for one in robot.answers(mark) if one.echo.get("seq") in burst]
    twists, acks = ([one.echo["seq"] for one in answers if one.is_twist is kind] for kind in (True, False))
    # A twist may cite a frame again that was acknowledged before (7.1), so only the first answer to a frame counts.
    firsts = [*dict.fromkeys(one.echo["seq"] for one in answers)]
    for cited in (twists, acks, firsts):
        bench.expect(cited == sorted(cited), f"it answered in the order {cited}")


def _no_twist_for(bench: Bench, robot: RobotPlayed, sent: Sent, what: str) -> None:
    """Check that no twist cites `sent`, whose seq and time are unique, within the time of an answer."""
    bench.rest(ANSWER_US)
    bench.expect(not robot.twists_to(sent), f"it drove by {what}")


@SUITE.must("V-CAUS-08", "1.5 Delivery", met)
def older_frame(bench: Bench, robot: RobotPlayed) -> None:
    """A frame that arrives after a newer one drives nothing."""
    first = robot.next_fields()
    bench.rest(FRAME_US)
    robot.answer_to(robot.frame())
    late = robot.frame("left", seq=first["seq"], t_us=first["t_us"])
    _no_twist_for(bench, robot, late, "a frame older than the last")


@SUITE.should("V-CAUS-09", "7.1 Answers", met)
def repeated_frame(bench: Bench, robot: RobotPlayed) -> None:
    """A frame that arrives a second time gets no second twist."""
    sent = robot.frame()
    robot.answer_to(sent)
    robot.is_driven(sent)
    before = len(robot.twists_to(sent))
    for _ in range(3):
        robot.frame(seq=sent.seq, t_us=sent.t_us)
        bench.rest(100_000)
    twists = robot.twists_to(sent)
    bench.expect(len(twists) <= before, f"one frame got {len(twists)} twists")


def _no_twist_later(robot: RobotPlayed, later_us: int, what: str) -> None:
    """Fail the case if a frame of a higher `seq` drives whose time is `later_us` after that of the last one."""
    sent = robot.frame()
    robot.answer_to(sent)
    robot.frame("left", seq=sent.seq + 50, t_us=sent.t_us + later_us)
    robot.bench.rest(ANSWER_US)
    robot.bench.expect(not any(one.echo.get("seq") == sent.seq + 50 for one in robot.twists()), f"it drove by {what}")


SUITE.must_all(met, {
    "V-CAUS-10": ("2.6 Clock", "A frame whose `seq` rises and whose time goes back drives nothing.",
                  lambda it: _no_twist_later(it, -3_000, "a frame from before the last")),
    "V-CAUS-11": ("2.6 Clock", "A frame whose time does not advance drives nothing: that camera is frozen.",
                  lambda it: _no_twist_later(it, 0, "a frame of the same time as the last")),
}, level=Level.SHOULD)


@SUITE.must("V-CAUS-12", "7.4 Window")
def compute_time_is_true(bench: Bench) -> None:
    """`compute_us` is at most the time from sending a frame to receiving its answer."""
    for sent, answer in _cited(bench):
        compute_us = answer.fields.get("compute_us", 0)
        took_us = answer.received.at_us - sent.at_us
        bench.expect(not isinstance(compute_us, int) or compute_us <= took_us,
                     f"it reports {compute_us} us, and its answer took {took_us} us in all")


@SUITE.must("V-CAUS-22", "2.8 Fields", met)
def compute_time_is_in_microseconds(bench: Bench, _robot: RobotPlayed) -> None:
    """`compute_us` includes at least half of the time by which a large image is answered later than a small one."""
    large = gray(LARGE_CAMERA)
    small = picture("absent")
    padded = commented(small, _COMMENTS, (len(large) - len(small)) // _COMMENTS)  # as long on the link as the large one
    wrong = ""
    for _ in range(_TRIES):
        (took_us, computed_us), (longer_us, more_us) = (
            _times_us(bench, *one) for one in ((LENS, padded), (LARGE_CAMERA, large)))
        later_us = longer_us - took_us
        if later_us < _MEASURABLE_US or more_us - computed_us >= later_us / 2:
            return
        wrong = (f"a large image is answered {later_us:.0f} us later than a small one, and `compute_us` rises from "
                 f"{computed_us:.0f} to {more_us:.0f}")
    bench.expect(False, wrong)


def _times_us(bench: Bench, camera: CameraModel, jpeg: bytes) -> tuple[float, float]:
    """Return the median time until an answer, and its median `compute_us`. The first images are not measured."""
    robot = RobotPlayed(bench, camera=camera)
    pairs: list[tuple[int, int]] = []
    for _ in range(2 * _MEASURED):
        sent = robot.frame(jpeg=jpeg)
        if robot.is_answered(sent):
            answer = robot.answers_to(sent)[0]
            pairs.append((answer.received.at_us - sent.at_us, answer.fields.get("compute_us", 0)))
    robot.stop()
    bench.need(len(pairs) >= _MEASURED, f"it does not answer images of {camera.width_px}x{camera.height_px} in time")
    bench.need(all(isinstance(one, int) and one for _, one in pairs), "it states no computing time (V-HEAD-09)")
    took_us, computed_us = (median(column) for column in zip(*pairs[-_MEASURED:], strict=True))
    return took_us, computed_us


@SUITE.must("V-CAUS-13", "2.5 Session and sequence", met)
def gaps_are_fine(_bench: Bench, robot: RobotPlayed) -> None:
    """`seq` may leap by some hundreds: frames that were never sent are not missed."""
    for leap in (10, 100, 900):
        fields = robot.next_fields()
        robot.answer_to(robot.frame(seq=fields["seq"] + leap, t_us=fields["t_us"]))


def _forged_frame(robot: RobotPlayed, **changes: Any) -> None:
    """Send a frame with these changes to the robot's next one; `ahead_us` and `seq_ahead` are added to its fields."""
    fields = robot.next_fields()
    t_us = min(fields["t_us"] + changes.pop("ahead_us", 0), MAX_INTEGER)
    robot.frame("left", **{"seq": fields["seq"] + changes.pop("seq_ahead", 0), "t_us": t_us, **changes})


def _forged_stamps(robot: RobotPlayed, channel: Channel, payload: bytes, **fields: Any) -> None:
    """Send a message of the channel that is an hour ahead, and one of another session."""
    stamp = robot.stamp().model_dump(mode="json") | fields
    for changes in ({"t_us": stamp["t_us"] + _HOUR_US}, {"session": _OTHER_SESSION}):
        robot.publish(channel, payload, packed(stamp | changes))


def _drives_on(forge: Callable[[RobotPlayed], None], robot: RobotPlayed) -> None:
    """Fail the case if messages by `forge` keep the robot's own frames from driving for a second."""
    bench = robot.bench
    forge(robot)
    bench.rest(FRAME_US)
    began_us = bench.now_us
    sent: list[Sent] = []
    while not any(map(robot.twists_to, sent)):
        bench.expect(bench.now_us - began_us < _RECOVERS_US, "no twist within a second after a forged message")
        sent.append(robot.frame("left"))
        bench.rest(FRAME_US)


_FORGED: Final[dict[str, tuple[str, Callable[[RobotPlayed], None]]]] = {
    "V-CAUS-14": ("A frame of an hour ahead", partial(_forged_frame, ahead_us=_HOUR_US)),
    "V-CAUS-15": ("A frame of the largest time", partial(_forged_frame, ahead_us=MAX_INTEGER)),
    "V-CAUS-16": ("A frame of the largest `seq`", partial(_forged_frame, seq=MAX_INTEGER)),
    "V-CAUS-17": ("A frame of a session that is made up", partial(_forged_frame, session=_OTHER_SESSION)),
    "V-CAUS-18": ("A `status` of another session or an hour ahead",
                  partial(_forged_stamps, channel=STATUS, payload=encode(ARMED))),
    "V-CAUS-19": ("A `scan` of another session or an hour ahead",
                  partial(_forged_stamps, channel=SCAN, payload=bytes(16), **_RAYS)),
    "V-CAUS-20": ("A frame of ten seconds ahead", partial(_forged_frame, ahead_us=_SECONDS_US)),
    "V-CAUS-21": ("A frame whose `seq` is a hundred thousand ahead", partial(_forged_frame, seq_ahead=_SEQ_LEAP)),
}
"""Forged messages that must not stop the service: title, function that sends them."""
SUITE.must_all(met, {
    number: ("2.6 Clock", f"{title} is forged: the robot's own frames drive within a second.",
             partial(_drives_on, forge))
    for number, (title, forge) in _FORGED.items()
})


# --- the service's sequence ------------------------------------------------------------------------------------------


def _rises(bench: Bench, answers: list[VisionAnswer], what: str) -> None:
    numbers = [one.fields.get("seq") for one in answers]
    reported = [number for number in numbers if isinstance(number, int)]
    bench.expect(all(one < other for one, other in itertools.pairwise(reported)), f"{what} came as {reported}")


@SUITE.must("V-SEQ-01", "2.5 Session and sequence", met)
def session_stays(bench: Bench, robot: RobotPlayed) -> None:
    """Its session is one and the same from answer to answer, be it a twist or an ack."""
    robot.film("left", 40)
    robot.is_answered(robot.frame(jpeg=png()))
    sessions = {str(one.fields.get("session")) for one in robot.answers() if one.fields}
    bench.expect(len(sessions) < 2, f"it answered as {', '.join(sorted(sessions)[:4])}")


@SUITE.must("V-SEQ-02", "2.5 Session and sequence", met)
def twists_count_up(bench: Bench, robot: RobotPlayed) -> None:
    """The `seq` of its twists rises by at least one each, also where it sends each twice since frames are lost."""
    robot.film("left", 40)
    for _ in range(_LOST):
        robot.next_fields()  # a frame that does not arrive
        robot.is_answered(robot.frame("left"))
        bench.rest(FRAME_US)
    _rises(bench, robot.twists(), "twists")


@SUITE.must("V-SEQ-07", "2.5 Session and sequence", met)
def counts_within_reach(bench: Bench, robot: RobotPlayed) -> None:
    """The first `seq` of its twists is at most 2^32, and steps are at most 2^20: else a robot rejects them."""
    robot.film("left", 10)
    numbers = [number for one in robot.twists() if isinstance(number := one.fields.get("seq"), int)]
    largest, step = max(numbers, default=0), max((after - one for one, after in itertools.pairwise(numbers)), default=0)
    bench.expect(largest <= _MAX_FIRST_SEQ, f"its twists count {numbers[:3]} ...")
    bench.expect(step <= _MAX_SEQ_STEP, f"its twists count {numbers[:3]} ..., with steps up to {step}")


@SUITE.must("V-SEQ-03", "2.5 Session and sequence", met)
def acks_count_up(bench: Bench, robot: RobotPlayed) -> None:
    """The `seq` of its acks rises by at least one each, with twists between them."""
    for _ in range(6):
        robot.frame(jpeg=png())
        bench.rest(50_000)
        robot.frame("left")
        bench.rest(50_000)
    acks = [one for one in robot.answers() if not one.is_twist]
    bench.need(len(acks) > 1, "it acknowledges nothing")
    _rises(bench, acks, "acks")


@SUITE.must("V-SEQ-04", "2.5 Session and sequence")
def own_session_outlives_the_robot(bench: Bench) -> None:
    """Within a session of its own, its `seq` goes on when the robot starts again."""
    first = RobotPlayed(bench).met()
    before = first.twists()[-1]
    first.stop()
    second = RobotPlayed(bench).met()
    after = second.twists()[0]
    if before.fields.get("session") == after.fields.get("session"):
        _rises(bench, [before, after], "twists before and after the robot's start")


@SUITE.must("V-SEQ-05", "2.5 Session and sequence")
def robot_starts_again(bench: Bench) -> None:
    """A robot that starts again, from a lower `seq` and an earlier time, is answered at once, and driven in a second.

    The service forgets what it learned, so acknowledgements come until it has taken in the camera model.
    """
    old = RobotPlayed(bench, first_seq=5_000).met()
    old.stop()
    new = RobotPlayed(bench, first_seq=3, first_t_us=1_000)
    sent = new.film("left", _STARTING, 100_000)
    for one in sent:
        bench.expect(new.answers_to(one), f"no answer to the new frame {one.seq}")
    new.expect_any_twist(sent)


@SUITE.should("V-SEQ-06", "2.5 Session and sequence")
def old_session_is_over(bench: Bench) -> None:
    """A frame of the robot's last session that arrives after one of the new session was answered drives nothing."""
    old = RobotPlayed(bench).met()
    late = old.next_fields()
    old.stop()
    new = RobotPlayed(bench).met()
    sent = new.frame("left", **{name: late[name] for name in ("session", "seq", "t_us")})
    _no_twist_for(bench, new, sent, "a frame of a session that is over")
    new.expect_driven("a frame of a session that is over")


# --- proof of identity -----------------------------------------------------------------------------------------------


_ELEMENT: Final = re.compile(r"[0-9a-f]{32}")
_MOST_TWISTS: Final = 1_100
_MOST_US: Final = 60_000_000
_FEW: Final = 20


class _Chain:
    """Validates the proof of each later twist, as a robot does whose lease this driver holds."""

    def __init__(self, robot: RobotPlayed) -> None:
        self.fault = ""
        """Error of the first proof that does not continue the earlier ones."""
        self.twists = 0
        self.announcing: int | None = None
        """Number of twists in a row that announced the next chain; None before a chain ended."""
        self._robot, self._bench, self._announced = robot, robot.bench, 0
        self._session: Any = None
        self._last = Proof(None)
        self._bench.on(TWIST, self._read)

    def _read(self, received: Received) -> None:
        """Read a twist. It raises nothing, because a link would log it."""
        self.twists += 1
        fields = read_answer(received).fields
        proof, following = (self._element(fields.get(name)) for name in ("proof", "next_proof"))
        before, is_same = Proof(self._last.proof), fields.get("session") == self._session
        if before.proof is not None and is_same and not continues(proof, before):
            if not continues(proof, self._last):
                self.fault = self.fault or (f"the proof of twist {self.twists}, {proof}, hashed 1 to {MAX_LOST} times, "
                                            "gives neither the last one nor the announced one")
            self.announcing = self._announced
        if following != self._last.next_proof:
            # An element that the first twist announces may have been announced before.
            self._announced = MAX_LOST if self.twists == 1 else 0
        self._announced += following is not None
        self._last, self._session = Proof(proof, following), fields.get("session")

    def _element(self, value: Any) -> str | None:
        if value is None or (isinstance(value, str) and _ELEMENT.fullmatch(value)):
            return value
        self.fault = self.fault or f"a proof is 32 lower-case hex digits, not {value!r}"
        return None

    def follow(self, frames: int) -> None:
        """Show that many frames, each after a twist answers the last, until a proof is wrong or the chain has ended."""
        deadline_us = self._bench.now_us + _MOST_US
        for _ in range(frames):
            self._robot.is_driven(self._robot.frame("left"))
            if self.fault or self.announcing is not None or self._bench.now_us > deadline_us:
                break
        self._bench.need(self.fault or self._last.proof, "its twists have no proof, which a link without keys permits")


@SUITE.must("V-PROOF-01", "6.6 Proof", met)
def proofs_continue(bench: Bench, robot: RobotPlayed) -> None:
    """The proof of each twist, hashed 1 to 64 times, gives that of the last one: else a robot rejects it."""
    chain = _Chain(robot)
    chain.follow(_FEW)
    bench.expect(not chain.fault, chain.fault)


@SUITE.must("V-PROOF-02", "6.6 Proof", met)
def next_chain_is_announced(bench: Bench, robot: RobotPlayed) -> None:
    """A chain of proofs that ends continues in the next one, which its last 64 twists have announced."""
    chain = _Chain(robot)
    chain.follow(_FEW)
    bench.need(not chain.fault, "its proofs do not continue (V-PROOF-01)")
    chain.follow(_MOST_TWISTS)
    bench.expect(not chain.fault, chain.fault)
    bench.need(chain.announcing is not None, f"its chain did not end in {chain.twists} twists")
    bench.expect((chain.announcing or 0) >= MAX_LOST, f"only {chain.announcing} twists announced the next chain")


@SUITE.must("V-PROOF-03", "6.6 Proof", met)
def proof_behind_keys(bench: Bench, robot: RobotPlayed) -> None:
    """Each twist has a proof where peers show keys."""
    bench.need(bench.access.is_guarded, "no keys were named (--secure, --token)")
    robot.film("left", _FEW)
    bench.expect(all(one.fields.get("proof") for one in robot.twists() if one.fields), "a twist has no proof")
