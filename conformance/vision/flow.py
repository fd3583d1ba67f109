"""Cases on credit, silence, status and a robot that reconnects. Pure."""

from functools import partial
from typing import Final

from sightline.conformance.case import Bench, Level, Suite
from sightline.conformance.vision.fixture import ANSWER_US, FRAME_US, RobotPlayed, met
from sightline.conformance.vision.images import CAMERA as LENS
from sightline.conformance.vision.images import HALF_CAMERA
from sightline.protocol.channels import REQUEST
from sightline.protocol.messages import LastRejection, LeaseHolder, State, Status
from sightline.protocol.spec.message_cases import packed

SUITE = Suite("V")
_BURST: Final = 20
_FLOOD: Final = 1_000
_CATCH_UP_US: Final = 1_000_000
_STEADY: Final = 60
_STEADY_IN_TIME: Final = 0.9
"""Share of the frames, one at a time: a scheduler may delay some."""
_PATIENCE_US: Final = 5_000_000


SUITE.must_all(met, {
    "V-FLOW-01": ("3.3 A rejected image", "An invalid image is acknowledged, so that its credit comes back.",
                  lambda it: it.bench.expect(it.answer_to(it.frame(jpeg=b"no picture at all")), "no answer")),
}, level=Level.SHOULD)


@SUITE.must("V-FLOW-02", "7.1 Answers", met)
def burst(_bench: Bench, robot: RobotPlayed) -> None:
    """The newest of a burst of 20 frames is answered within a second."""
    sent = [robot.frame("left") for _ in range(_BURST)]
    robot.answer_to(sent[-1], _CATCH_UP_US)


@SUITE.must("V-FLOW-03", "1.5 Delivery", met)
def flood(bench: Bench, robot: RobotPlayed) -> None:
    """After a thousand frames without a pause, a plain frame is answered within a second: nothing queued up."""
    for number in range(_FLOOD):
        robot.frame(jpeg=b"flood")
        if number % 50 == 49:
            bench.rest(5_000)
    robot.answer_to(robot.frame(), _CATCH_UP_US)


@SUITE.must("V-FLOW-04", "7.1 Answers", met)
def slow_robot(bench: Bench, robot: RobotPlayed) -> None:
    """A robot that sends a frame every second and a half is answered each time."""
    for _ in range(3):
        bench.rest(1_500_000)
        robot.answer_to(robot.frame())


@SUITE.must("V-FLOW-05", "7.1 Answers", met)
def steady(bench: Bench, robot: RobotPlayed) -> None:
    """Sixty frames, each after the answer to the last, are all answered, and nine of ten within half a second."""
    in_time = 0
    for number in range(1, _STEADY + 1):
        sent = robot.frame("left")
        bench.rest(FRAME_US)
        # A later frame would replace one that waits for a service without a processor, which need not answer it (7.1).
        bench.expect(robot.is_answered(sent, _PATIENCE_US), f"frame {number} of {_STEADY} got no answer")
        in_time += robot.answers_to(sent)[0].received.at_us - sent.at_us <= ANSWER_US
    bench.expect(in_time >= _STEADY_IN_TIME * _STEADY, f"{in_time} of {_STEADY} frames were answered in time")


@SUITE.must("V-FLOW-06", "10.1 Camera, odometry, scan")
def no_camera_model(bench: Bench) -> None:
    """Frames of a robot that names no camera are answered, if only by acks."""
    robot = RobotPlayed(bench, camera=None)
    bench.rest(100_000)
    for _ in range(3):
        robot.answer_to(robot.frame())


@SUITE.should("V-FLOW-07", "10.1 Camera, odometry, scan")
def late_camera_model(bench: Bench) -> None:
    """A camera model that comes two seconds late is used: twists follow within a second."""
    robot = RobotPlayed(bench, camera=None)
    robot.film("left", 40, 50_000)
    robot.show(LENS)
    sent = robot.film("left", 20, 50_000)
    robot.need_nothing_dropped()
    robot.expect_any_twist(sent)


@SUITE.should("V-FLOW-08", "10.1 Camera, odometry, scan", met)
def other_camera_model(bench: Bench, robot: RobotPlayed) -> None:
    """A camera that changes its image size is followed: twists within a second."""
    robot.show(HALF_CAMERA)
    bench.rest(50_000)
    sent = robot.film("left_half", 20, 50_000)
    robot.expect_any_twist(sent)


@SUITE.should("V-FLOW-09", "7.1 Answers", met)
def replaced_frames(bench: Bench, robot: RobotPlayed) -> None:
    """Frames that a newer one replaced are not answered: of 20 at once, at most half."""
    sent = [robot.frame("left") for _ in range(_BURST)]
    bench.rest(_CATCH_UP_US)
    answered = sum(bool(robot.answers_to(one)) for one in sent)
    bench.expect(answered <= _BURST // 2, f"{answered} of {_BURST} frames sent at once were answered")


# --- silence ---------------------------------------------------------------------------------------------------------


@SUITE.should("V-SIL-01", "7.1 Answers", met)
def silent_without_frames(bench: Bench, robot: RobotPlayed) -> None:
    """When frames cease, so do twists: nothing is sent twice to keep a robot going."""
    robot.film("left", 10)
    bench.rest(_CATCH_UP_US)
    mark = bench.mark()
    bench.rest(2_000_000)
    bench.expect(not robot.answers(mark), f"{len(robot.answers(mark))} answers came without a frame")


@SUITE.must("V-SIL-02", "7.1 Answers", met)
def back_after_silence(bench: Bench, robot: RobotPlayed) -> None:
    """After five seconds without a frame, the next one is answered."""
    bench.rest(5_000_000)
    robot.answer_to(robot.frame())


@SUITE.must("V-SIL-03", "3.3 A rejected image", met)
def silent_about_no_pictures(bench: Bench, robot: RobotPlayed) -> None:
    """When images are invalid, twists cease."""
    robot.film("left", 5)
    bench.rest(_CATCH_UP_US)
    mark = bench.mark()
    for _ in range(10):
        robot.frame(jpeg=b"\xff\xd8\xff\xd9")
        bench.rest(FRAME_US)
    bench.expect(not robot.twists(mark), f"{len(robot.twists(mark))} twists answered invalid images")


# --- reports of the robot ---------------------------------------------------------------------------------------------


def _goes_on(status: Status | bytes, what: str, robot: RobotPlayed, *, twists: bool = True) -> None:
    """Check that frames are still answered while `status` is published at 10 Hz."""
    bench = robot.bench
    robot.status = status
    bench.rest(250_000)
    for _ in range(8):
        sent = robot.frame("left")
        good = robot.is_driven(sent, within_us=_PATIENCE_US) if twists else robot.is_answered(sent, _PATIENCE_US)
        if not robot.answers_to(sent):
            robot.need_nothing_dropped()
        bench.expect(good, f"no {'twist' if twists else 'answer'} for frame {sent.seq} {what}")
        bench.rest(100_000)


_OTHER_HOLDER: Final = Status(state=State.ACTIVE, reason="teleop drives",
                              holder=LeaseHolder.of("teleop", "99999999"))
_REJECTING: Final = Status(state=State.HOLD, reason="no command", refused={"STALE": 99},
                           last_refusal=LastRejection(source="vision", reason="STALE", detail="frame is 900 ms old"))
_NEWER: Final = packed({"state": "HOLD", "reason": "x", "refused": {"TOO_PURPLE": 3}, "battery": {"volts": 11.1}})
SUITE.must_all(met, {
    "V-STAT-01": ("6.4 Arming", "A disarmed robot is driven all the same: arming needs five good commands in a row.",
                  partial(_goes_on, Status(state=State.DISARMED, reason="not armed"), "while disarmed")),
    "V-STAT-02": ("7.1 Answers", "Frames of a stopped robot are answered: what people see through it needs credit.",
                  partial(_goes_on, Status(state=State.STOPPED, reason="stop was requested"), "while stopped",
                          twists=False)),
    "V-STAT-03": ("7.1 Answers", "A robot that rejects every twist is answered on.",
                  partial(_goes_on, _REJECTING, "while rejected")),
    "V-STAT-04": ("7.1 Answers", "While another source drives, frames are answered.",
                  partial(_goes_on, _OTHER_HOLDER, "while teleop drives", twists=False)),
    "V-STAT-05": ("11. Versions", "Unknown fields and unknown reasons in `status` change nothing.",
                  partial(_goes_on, _NEWER, "after a status with unknown fields")),
})


@SUITE.must("V-STAT-06", "1.2 Messages")
def no_status(bench: Bench) -> None:
    """A robot that reports no `status` at all is answered."""
    robot = RobotPlayed(bench, status=None).met()
    for sent in robot.film("left", 5, 100_000):
        bench.expect(robot.answers_to(sent), f"no answer to frame {sent.seq}")


BROKEN_STATUS: Final = {
    "V-STAT-11": ("A `status` that is not JSON ends nothing.", b"{state"),
    "V-STAT-12": ("A `status` with an unknown state ends nothing.", packed({"state": "FLYING", "reason": "x"})),
    "V-STAT-13": ("Control characters and markup in `status` end nothing.",
                  packed({"state": "HOLD", "reason": "\x1b[2J\x00<script>alert(1)</script>\u202e"})),
    "V-STAT-14": ("A `status` of 4096 bytes ends nothing.", packed({"state": "HOLD", "reason": "x"}).ljust(4096)),
    "V-STAT-15": ("A `status` that is a list ends nothing.", b"[1,2,3]"),
}


SUITE.must_all(met, {
    number: ("13.2 Bounds", title, partial(_goes_on, payload, f"after the status {payload[:40]!r}"))
    for number, (title, payload) in BROKEN_STATUS.items()
})


@SUITE.should("V-REQ-01", "6.4 Arming")
def requests_nothing(bench: Bench) -> None:
    """It requests nothing from a disarmed or stopped robot: arming and reset are an operator's."""
    for state in (State.DISARMED, State.STOPPED):
        robot = RobotPlayed(bench, status=Status(state=state, reason="an operator did this"))
        robot.film("left", 20, 100_000)
        robot.stop()
    requests = bench.received(REQUEST)
    bench.expect(not requests, f"it requested: {[one.message.payload for one in requests][:3]}")


# Cases about a robot that disconnects and returns. Pure.


_BACK_US: Final = 5_000_000
"""At most a second between two tries, two seconds until a silent peer is given up, and time to send hello."""


def _answered_again(bench: Bench, robot: RobotPlayed, what: str) -> None:
    """Check that a frame is answered within the time of a reconnection."""
    deadline_us = bench.now_us + _BACK_US
    mark = bench.mark()
    while bench.now_us < deadline_us and not robot.answers(mark):
        robot.frame()
        bench.rest(50_000)
    if not robot.answers(mark):
        robot.need_nothing_dropped()
    bench.expect(robot.answers(mark), f"no frame was answered within {_BACK_US / 1e6:g} s {what}")


@SUITE.must("V-RECO-01", "14.8 Liveness", met)
def connection_lost(bench: Bench, robot: RobotPlayed) -> None:
    """When the connection is lost and comes back, the same robot is answered again within five seconds."""
    bench.leave()
    bench.rest(300_000)
    bench.join()
    _answered_again(bench, robot, "after the connection came back")


@SUITE.must("V-RECO-02", "2.5 Session and sequence")
def robot_restarted(bench: Bench) -> None:
    """When the robot is gone for a second and starts again, it is answered within five seconds."""
    RobotPlayed(bench).met().stop()
    bench.leave()
    bench.rest(1_000_000)
    bench.join()
    _answered_again(bench, RobotPlayed(bench, first_seq=0, first_t_us=500), "after the robot started again")


@SUITE.must("V-RECO-03", "14.8 Liveness", met)
def connection_flaps(bench: Bench, robot: RobotPlayed) -> None:
    """A connection lost three times in a row, in the middle of frames, is not a reason to give up."""
    for _ in range(3):
        robot.frame()
        bench.leave()
        bench.rest(100_000)
        bench.join()
        _answered_again(bench, robot, "after the connection came back")


@SUITE.must("V-RECO-04", "2.5 Session and sequence", met)
def counts_on(bench: Bench, robot: RobotPlayed) -> None:
    """Within a session of its own, its `seq` goes on over a reconnection."""
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
    reported = isinstance(numbers[0], int) and isinstance(numbers[1], int)
    bench.expect(not same or not reported or numbers[0] < numbers[1],  # type: ignore[operator]
                 f"`seq` was {numbers[0]} before and {numbers[1]} after, in one session")


@SUITE.must("V-RECO-05", "1.5 Delivery", met)
def nothing_kept_back(bench: Bench, robot: RobotPlayed) -> None:
    """A message that it could not send while the robot was gone is not sent later."""
    sent = [robot.frame("left") for _ in range(3)]
    bench.leave()
    bench.rest(1_000_000)
    bench.join()
    mark = bench.mark()
    bench.rest(1_500_000)
    late = [one for one in robot.answers(mark) if any(one.cites(frame) for frame in sent)]
    bench.expect(not late, f"{len(late)} answers to frames from before came after the reconnection")
