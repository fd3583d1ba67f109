"""Cases about missions, reports and detections: rate, target, result for each image, boxes of another peer. Pure."""

import math
from functools import partial
from typing import Any, Final

from sightline.conformance.case import NOT_DRIVING, Bench, Model, Received, Suite
from sightline.conformance.vision.fixture import ANSWER_US, ARMED, RobotPlayed, Sent, VisionAnswer, met
from sightline.conformance.vision.images import CAMERA as LENS
from sightline.protocol.channels import DETECTIONS, MISSION, REPORT, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.messages import (
    MAX_INTEGER,
    DetectedBox,
    Detections,
    DetectionsHeader,
    Echo,
    MissionReport,
    MissionRequest,
    ReportedTarget,
    RequestHeader,
    RequestId,
)

SUITE = Suite("V")
_EVERY_US: Final = 50_000
_SECOND: Final = 20
_PERIOD_US: Final = 750_000
"""Two per second, and the time of a slow image."""
_MOST_PER_S: Final = 12
"""Ten, and two for jitter of the link."""
_TARGETS_PER_S: Final = 5
"""Of ten: each comes with an answer, so a service at 20 images per second may wait for the next one."""
_AT_ONCE_US: Final = 300_000
_TARGET_RADIUS_PX: Final = 20.0
_NEAR_PX: Final = 8.0
_NEAR_RAD: Final = 0.05
_PLACES_PX: Final = (("left", 104, 112), ("right", 216, 112))
"""Images, and the center of their ball."""
_OLD_US: Final = 3_000_000
_REST_US: Final = 800_000
"""Below the second for which a service waits for the wheels."""


def _parsed(bench: Bench, received: list[Received], model: type[Model]) -> list[tuple[Received, Model]]:
    """Return each message with its payload. An invalid one fails the case."""
    parsed = [(one, one.payload(model)) for one in received]
    for one, payload in parsed:
        bench.expect(payload is not None, f"an invalid {one.message.channel.name}: {one.message.payload[:160]!r}")
    return [(one, payload) for one, payload in parsed if payload is not None]


def _reports(bench: Bench, since: int) -> list[tuple[Received, MissionReport]]:
    found = _parsed(bench, bench.received(REPORT, since), MissionReport)
    bench.need(found or bench.newest(REPORT), "it publishes no reports")
    return found


def _cites(received: Received, sent: Sent) -> bool:
    header = received.header(DetectionsHeader)
    if header is None or header.echo is None:
        return False
    echo = header.echo
    return (echo.session, echo.seq, echo.t_us) == (sent.session, sent.seq, sent.t_us)


@SUITE.should("V-REP-01", "18.4 Report", met)
def rate(bench: Bench, robot: RobotPlayed) -> None:
    """While frames come, reports come twice a second, and at most ten times."""
    mark, began_us = bench.mark(), bench.now_us
    robot.film("absent", 3 * _SECOND, _EVERY_US)
    robot.film("centre", 2 * _SECOND, _EVERY_US)
    times_us = [one.at_us for one, _ in _reports(bench, mark)]
    gap_us = max(after - before for before, after in zip([began_us, *times_us], [*times_us, bench.now_us], strict=True))
    bench.expect(gap_us <= _PERIOD_US, f"{gap_us / 1e6:.2f} s passed between two reports")
    most = max(sum(0 <= other - one < 1_000_000 for other in times_us) for one in times_us)
    bench.expect(most <= _MOST_PER_S, f"{most} reports came within a second")


@SUITE.should("V-REP-02", "18.4 Report", met)
def at_once(bench: Bench, robot: RobotPlayed) -> None:
    """A change of the phase is reported at once, also right after another report."""
    robot.film("absent", 2 * _SECOND, _EVERY_US)
    mark = bench.mark()
    for _ in range(_SECOND):
        if _reports(bench, mark):
            break
        robot.film("absent", 1, _EVERY_US)
    bench.expect(_reports(bench, mark), "no report came for a second")
    phase = _reports(bench, mark)[-1][1].phase
    robot.answer_to(robot.frame("centre"))
    shown_us, mark = bench.now_us, bench.mark()
    robot.film("centre", _SECOND, _EVERY_US)
    changed = [one.at_us for one, report in _reports(bench, mark) if report.phase != phase]
    bench.need(changed, "its phase does not depend on whether a yellow ball is there")
    took_us = changed[0] - shown_us
    bench.expect(took_us <= _AT_ONCE_US, f"the change was reported after {took_us / 1e6:.2f} s")


def _film_target(bench: Bench, name: str, side: int) -> tuple[RobotPlayed, list[Sent]]:
    """Return a new robot and its frames of a target. Not applicable to a service that does not turn to it."""
    robot = RobotPlayed(bench)
    sent = robot.film(name, 2 * _SECOND, _EVERY_US)
    robot.is_driven(sent[-1])
    robot.stop()
    twists = robot.twists()
    bench.need(twists and twists[-1].speeds[1] * side > 0, "it does not follow the yellow ball")
    return robot, sent


@SUITE.should("V-REP-03", "18.4 Report")
def target(bench: Bench) -> None:
    """While it follows the ball, it names it ten times a second: what and where it is in the image of the echo."""
    for name, x_px in (("left", 104), ("right", 216)):
        mark = bench.mark()
        side = 1 if x_px < LENS.cx_px else -1
        _robot, sent = _film_target(bench, name, side)
        newer = [(one, report) for one, report in _reports(bench, mark) if any(_cites(one, frame) for frame in sent)]
        named = [report.target for _, report in newer if report.target is not None]
        least = _TARGETS_PER_S * (sent[-1].at_us - sent[0].at_us) / 1e6 - 1
        bench.expect(len(named) >= least, f"{len(named)} of {len(newer)} reports in {len(sent)} images name the target")
        bench.expect(len({one.track for one in named}) == 1, "`track` changes while it follows one ball")
        for one in named:
            _expect_place(bench, one, x_px)


def _expect_place(bench: Bench, one: ReportedTarget, x_px: int) -> None:
    size = one.width_px, one.height_px
    bench.expect(size == (LENS.width_px, LENS.height_px), f"the image is {size[0]}x{size[1]} in the report")
    bench.expect(abs(one.cx_px - x_px) <= _NEAR_PX, f"the center is at {one.cx_px:g} px, not at {x_px} px")
    radius_px, bearing_rad = one.radius_px, one.bearing_rad
    bench.expect(radius_px is None or abs(radius_px - _TARGET_RADIUS_PX) <= _NEAR_PX, f"the radius is {radius_px} px")
    expected_rad = math.atan((LENS.cx_px - x_px) / LENS.fx_px)
    bench.expect(bearing_rad is None or abs(bearing_rad - expected_rad) <= _NEAR_RAD,
                 f"the bearing is {bearing_rad} rad, not {expected_rad:.2f} rad")


@SUITE.should("V-REP-04", "18.4 Report", met)
def detections(bench: Bench, robot: RobotPlayed) -> None:
    """The detections of each image that it drives by come once while the kit subscribes, no `track` twice in one."""
    mark = bench.mark()
    sent = robot.film("left", _SECOND, _EVERY_US)
    robot.is_driven(sent[-1])
    driven = [one for one in sent if robot.twists_to(one)]
    bench.need(driven, NOT_DRIVING)
    bench.wait(lambda: any(_cites(one, driven[-1]) for one in bench.received(DETECTIONS, mark)), ANSWER_US)
    found = _parsed(bench, bench.received(DETECTIONS, mark), Detections)
    bench.need(found or bench.newest(DETECTIONS), "it publishes no detections")
    for frame in driven:
        count = sum(_cites(one, frame) for one, _ in found)
        bench.expect(count == 1, f"{count} messages with detections cite frame {frame.seq}")
    for _, one in found:
        tracks = [box.track for box in one.boxes if box.track is not None]
        bench.expect(len(tracks) == len(set(tracks)), f"two boxes of one image have one `track`: {tracks}")


@SUITE.should("V-REP-05", "12.1 Detections")
def boxes(bench: Bench) -> None:
    """Each image of the ball that it drives by has a box around the ball, in pixels of that image."""
    for name, *center_px in _PLACES_PX:
        mark = bench.mark()
        _robot, sent = _film_target(bench, name, 1 if center_px[0] < LENS.cx_px else -1)
        found = [payload for one, payload in _parsed(bench, bench.received(DETECTIONS, mark), Detections)
                 if any(_cites(one, frame) for frame in sent)]
        bench.need(found, "it publishes no detections")
        newest = found[-1]
        size = newest.width_px, newest.height_px
        bench.expect(size == (LENS.width_px, LENS.height_px), f"the image is {size[0]}x{size[1]} in the detections")
        edges = [edge for sign in (-1, 1) for edge in (one + sign * _TARGET_RADIUS_PX for one in center_px)]
        near = any(all(abs(one - other) <= _NEAR_PX for one, other in zip(_edges(box), edges, strict=True))
                   for box in newest.boxes)
        bench.expect(near, f"no box is near {edges}; there are {[_edges(box) for box in newest.boxes]}")


def _edges(box: DetectedBox) -> list[float]:
    return [round(one, 1) for one in (box.x1_px, box.y1_px, box.x2_px, box.y2_px)]


@SUITE.should("V-REP-06", "18.4 Report")
def label(bench: Bench) -> None:
    """The label of the target is the label of a box in the detections of the same image."""
    mark = bench.mark()
    _robot, sent = _film_target(bench, "left", 1)
    found = _parsed(bench, bench.received(DETECTIONS, mark), Detections)
    pairs = [(report.target.label, [box.label for box in one.boxes])
             for at, report in _reports(bench, mark) if report.target is not None
             for frame in sent if _cites(at, frame) for by, one in found if _cites(by, frame)]
    bench.need(pairs, "it publishes no target and detections of one image")
    for name, labels in pairs:
        bench.expect(name in labels, f"the target is {name!r}, the boxes are {labels}")


# --- detections of another peer ---------------------------------------------------------------------------------------

_DETECTOR: Final = "detector"
_LEFT_PX: Final = 60.0
_RIGHT_PX: Final = 260.0
_TURN_RAD_S: Final = 0.01


class _Detector:
    """A detector that the kit plays: its boxes are at places where the images of the robot show nothing."""

    def __init__(self, robot: RobotPlayed) -> None:
        self.robot, self.bench, self._session = robot, robot.bench, f"{robot.bench.number():08x}"

    def look(self) -> Sent:
        """Send an image without a target, and return it once it is answered."""
        sent = self.robot.frame("absent")
        self.robot.is_answered(sent)
        return sent

    def find(self, x_px: float, sent: Sent | None, **changes: Any) -> None:
        """Publish a box with this center in the image `sent`; `changes` replace fields of its echo."""
        echo = None
        if sent is not None:
            echo = Echo.model_construct(channel="frame", session=sent.session, seq=sent.seq, t_us=sent.t_us)
            echo = echo.model_copy(update=changes)
        number = self.bench.number()
        box = DetectedBox(label="ball", score=0.9, x1_px=x_px - _TARGET_RADIUS_PX, y1_px=100.0,
                          x2_px=x_px + _TARGET_RADIUS_PX, y2_px=140.0)
        header = DetectionsHeader(source=_DETECTOR, session=self._session, seq=number, echo=echo)
        found = Detections(width_px=LENS.width_px, height_px=LENS.height_px, boxes=(box,))
        self.bench.publish(DETECTIONS, header, found, _DETECTOR)

    def turns(self, x_px: float) -> float:
        """Return the angular velocity of the last twist to a row of images with a box at this place."""
        for _ in range(_SECOND // 2):
            sent = self.look()
            self.find(x_px, sent)
            self.bench.rest(_EVERY_US)
        return self.robot.twists_to(sent)[-1].speeds[1] if self.robot.is_driven(sent) else 0.0

    def twists(self, since: int) -> list[VisionAnswer]:
        """Return the twists since a mark, after the time of an answer."""
        self.bench.rest(ANSWER_US)
        return self.robot.twists(since)

    def expect_no_twist(self, since: int, what: str) -> None:
        """Fail the case if a twist came since a mark."""
        self.bench.expect(not self.twists(since), f"it steered by boxes {what}")


def _steers_by_boxes(bench: Bench) -> _Detector:
    """Begin the cases about boxes of another peer. Not applicable unless the service drives by them alone."""
    for x_px, side in ((_LEFT_PX, 1), (_RIGHT_PX, -1)):
        detector = _Detector(RobotPlayed(bench))
        bench.need(detector.turns(x_px) * side > _TURN_RAD_S, f"it does not steer by the boxes of `{_DETECTOR}`")
        detector.robot.stop()
    mark = bench.mark()
    detector.look()
    bench.need(not detector.twists(mark), f"it also drives without boxes of `{_DETECTOR}`")
    return detector


@SUITE.must("V-STEER-13", "12.4 Steering by them", _steers_by_boxes)
def cites_the_frame_of_the_boxes(bench: Bench, detector: _Detector) -> None:
    """A twist by the boxes of another peer cites the frame of the boxes, also after newer frames."""
    mark = bench.mark()
    looked_at = detector.look()
    for _ in range(2):
        bench.rest(_EVERY_US)
        detector.look()
    detector.find(_RIGHT_PX, looked_at)
    twists = detector.twists(mark)
    bench.need(twists, "it does not steer by boxes that come late")
    bench.expect(all(one.cites(looked_at) for one in twists),
                 f"boxes of frame {looked_at.seq}: it sent {twists[0].words()}")


def _steers_by_none(what: str, changes: dict[str, Any] | None, detector: _Detector) -> None:
    """Fail the case if boxes steer whose echo has these changes, or which have none."""
    mark, sent = detector.bench.mark(), detector.look()
    detector.find(_RIGHT_PX, None if changes is None else sent, **changes or {})
    detector.expect_no_twist(mark, what)


def _steers_by_no_older(detector: _Detector) -> None:
    """Fail the case if boxes of a frame steer that is older than that of the last boxes."""
    older, newer = detector.look(), detector.look()
    detector.find(_RIGHT_PX, newer)
    detector.robot.is_driven(newer)
    mark = detector.bench.mark()
    detector.find(_RIGHT_PX, older)
    detector.expect_no_twist(mark, "of an older frame")


SUITE.must_all(_steers_by_boxes, {
    "V-STEER-14": ("12.4 Steering by them", "Boxes of another peer without an `echo` steer nothing.",
                   partial(_steers_by_none, "without an echo", None)),
    "V-STEER-15": ("12.4 Steering by them", "Boxes of another peer steer nothing if they cite a frame never sent.",
                   partial(_steers_by_none, "of a frame that was never sent", {"seq": MAX_INTEGER})),
    "V-STEER-16": ("12.4 Steering by them", "Boxes of another peer steer nothing after those of a newer frame.",
                   _steers_by_no_older),
})


# --- missions --------------------------------------------------------------------------------------------------------


def _request(
    bench: Bench, robot: RobotPlayed, source: str = "operator", old_us: int = 0, session: str = ""
) -> RequestId:
    """Request the reported mission again. The request cites a status as old as `old_us`, of this robot or `session`."""
    mark = bench.mark()
    robot.film("absent", _SECOND, _EVERY_US)
    name = _reports(bench, mark)[-1][1].mission
    stamp = robot.stamp()
    robot.publish(STATUS, encode(ARMED), encode(stamp))
    echo = Echo.of(stamp).model_copy(update={"session": session or robot.session, "t_us": stamp.t_us - old_us})
    number = bench.number()
    header = RequestHeader(source=source, session=f"{number:08x}", seq=1, echo=echo)
    bench.publish(MISSION, header, MissionRequest(id=number, name=name), source)
    return RequestId(digest=header.digest, id=number)


def _starts(bench: Bench, robot: RobotPlayed, asked: RequestId, name: str = "absent") -> bool:
    """Return True if a report of the next second states that the requested mission was started."""
    mark = bench.mark()
    robot.film(name, _SECOND, _EVERY_US)
    return any(one.asked == asked and not one.refused for _, one in _reports(bench, mark))


def _knows_missions(bench: Bench) -> RobotPlayed:
    """Begin the cases about missions. Not applicable unless an operator's request starts one."""
    robot = met(bench)
    bench.need(_starts(bench, robot, _request(bench, robot)), "it does not start its mission on request")
    return robot


SUITE.must_all(_knows_missions, {
    "V-REQ-02": ("18.1 Request", "A mission that a detector requests is not started.",
                 lambda robot: _not_started(robot, "a detector's request", source="detector")),
    "V-REQ-03": ("18.2 Freshness", "A mission that cites a status 3 s older than the frame is not started.",
                 lambda robot: _not_started(robot, "an old request", old_us=_OLD_US)),
    "V-REQ-04": ("18.2 Freshness", "A mission that cites another session of the robot is not started.",
                 lambda robot: _not_started(robot, "a request of another session", session="0badf00d")),
})


def _not_started(robot: RobotPlayed, what: str, **how: Any) -> None:
    asked = _request(robot.bench, robot, **how)
    robot.bench.expect(not _starts(robot.bench, robot, asked), f"it started the mission of {what}")


@SUITE.must("V-REQ-05", "18.3 Switching", _knows_missions)
def begins_from_rest(bench: Bench, robot: RobotPlayed) -> None:
    """While frames show that the wheels turn, a mission that was started sends 0|0, for a second at most."""
    fast = (0.3, 0.0)
    robot.film("far", _SECOND, _EVERY_US)
    bench.need(robot.twists()[-1].speeds != (0, 0), "it does not drive to the yellow ball")
    asked = _request(bench, robot)
    bench.rest(2 * _EVERY_US)
    sent, deadline_us = [], bench.now_us + _REST_US
    while bench.now_us < deadline_us:
        sent.append(robot.frame("far", moving=fast, applied=fast))
        robot.is_answered(sent[-1])
        bench.rest(_EVERY_US)
    twists = [twist for frame in sent for twist in robot.twists_to(frame)]
    bench.need(twists and _starts(bench, robot, asked, "far"), "it does not start its mission on request")
    moving = [one.text for one in twists if one.speeds != (0, 0)]
    bench.expect(not moving, f"it sent {moving[:3]} while the wheels turned")
