"""The kit as a peer of a robot: received and sent messages. Pure.

Headers towards the robot are plain dicts, so that a case can also send invalid ones.
"""

import json
from collections import Counter
from collections.abc import Callable
from functools import partial
from hashlib import sha256
from itertools import pairwise
from typing import Any, Final

from sightline.conformance.case import Bench, Received
from sightline.conformance.measured import Evidence, MeasuredMotion, evidence_in_log, evidence_of
from sightline.protocol.channels import ACK, CAMERA, FRAME, ODOMETRY, REPLY, REQUEST, STATUS, TWIST
from sightline.protocol.errors import CLAMPED, RejectReason
from sightline.protocol.messages import MAX_INTEGER, CameraModel, FrameHeader, Odometry, Reply, Stamp, State, Status
from sightline.protocol.proof import ProofChain, session_digest

GOOD: Final = "GOOD"
"""The result of a command that the robot accepted: applied, or counted as DISARMED."""
NOT_COUNTED: Final = "not counted"
"""The result of a command that the robot did not count."""
CRAWL: Final = b"0.1000|0.0000"
"""Command of the kit if the speed does not matter."""
ANSWER_US: Final = 1_000_000
"""Time until a received `status` (10 Hz) shows the effect of a command, with a margin for a slow machine."""
FRAME_US: Final = 1_500_000
"""Time until a peer that answers receives a frame; without an answer credit returns within 500 ms."""
FAST_LINK_US: Final = 50_000
"""Time from a request to its reply over a link that delays nothing: all cases have room for that."""
REPLY_US: Final = 1_000_000
"""Time after which a peer may request again."""
DRIVEN: Final = (State.ACTIVE, State.DEGRADED)
SETTLES_US: Final = 200_000
"""Time from a zero command until a motor and its measurement are at rest."""
WATCHED_AT_REST_US: Final = 500_000
"""Long enough for several poses that are apart (measured.py)."""
_STEADY_US: Final = 225_000
"""Longest time between two frames at which a robot hardly slows down by their age (5.3) or by silence (5.4)."""
_STAMPED: Final = (STATUS, ODOMETRY, FRAME)
_SENT_AGAIN: Final = 2


class Robot:
    """The messages from the robot under test."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench

    def status(self) -> Status:
        """Return the newest valid status. Raises ConformanceError after two seconds without one."""
        self.bench.expect_within(lambda: self._newest_status() is not None, 2_000_000, "no readable status came")
        status = self._newest_status()
        assert status is not None
        return status

    def _newest_status(self) -> Status | None:
        readable = (one.payload(Status) for one in reversed(self.bench.received(STATUS)))
        return next((status for status in readable if status is not None), None)

    def next_status(self, count: int = 1) -> Status:
        """Return the newest status after `count` more have left the robot, so that it includes earlier events."""
        self.bench.rest(self.link_us())
        return self.newer_status(count)

    def newer_status(self, count: int = 1) -> Status:
        """Return the newest status after `count` more have arrived."""
        mark = self.bench.mark()
        came = self.bench.wait(lambda: len(self.bench.received(STATUS, mark)) >= count, 1_000_000 * count)
        self.bench.expect(came, f"no {count} status within {count} s")
        return self.status()

    def reaches(self, holds: Callable[[Status], object], within_us: int) -> bool:
        """Return True if a status that satisfies `holds` arrives within `within_us` and the delay of the link."""
        looked_at = [self.bench.mark()]

        def seen() -> bool:
            newest = self.bench.newest(STATUS)
            if newest is None or newest.number <= looked_at[0]:
                return False
            looked_at[0] = newest.number
            status = newest.payload(Status)
            return status is not None and bool(holds(status))

        return self.bench.wait(seen, within_us + self.link_us())

    def becomes(self, *states: State, within_us: int = 500_000) -> bool:
        """Return True if a status with one of `states` arrives in time."""
        return self.reaches(lambda status: status.state in states, within_us)

    def expect_state(self, *states: State, within_us: int = 500_000, what: str = "then") -> None:
        """Fail the case unless a status with one of `states` comes in time."""
        reached = self.becomes(*states, within_us=within_us)
        self.bench.expect(reached, f"{what} it is {self.status().state}: {self.status().reason}")

    def stops(self, within_us: int) -> bool:
        """Return True if a status with the wheels at zero arrives in time."""
        return self.reaches(lambda status: status.applied == (0.0, 0.0), within_us)

    def link_us(self) -> int:
        """Return the time by which the link delays a message and what it causes; 0 over a fast link."""
        return self.bench.link_us or 0

    # --- measured motion ---------------------------------------------------------------------------------------------

    def clock_us(self) -> int:
        """Return the robot's clock now, at most the delay of the link behind it."""
        self.status()
        stamps = ((one.at_us, one.header(Stamp)) for channel in _STAMPED for one in self.bench.received(channel))
        return self.bench.now_us - min(at_us - stamp.t_us for at_us, stamp in stamps if stamp is not None)

    def readings(self, since_us: int = 0, until_us: int = MAX_INTEGER) -> dict[str, list[MeasuredMotion]]:
        """Return the published motion by channel, between two times of its clock. Channels without any are left out."""
        found: dict[str, list[MeasuredMotion]] = {ODOMETRY.name: [], FRAME.name: []}
        for one in self.bench.received(ODOMETRY):
            stamp, odometry = one.header(Stamp), one.payload(Odometry)
            if stamp is not None and odometry is not None:
                found[ODOMETRY.name].append(MeasuredMotion(stamp.t_us, odometry.moving, odometry.pose))
        for _, header in self.frames():
            if header.model_fields_set & {"moving", "pose"}:
                found[FRAME.name].append(MeasuredMotion(header.t_us, header.moving, header.pose))
        recent = {name: [one for one in series if since_us <= one.t_us <= until_us] for name, series in found.items()}
        return {name: series for name, series in recent.items() if series}

    def frames_give_a_pose(self) -> bool:
        """Return True if the newest frame states `pose`."""
        frames = self.frames()
        return bool(frames) and "pose" in frames[-1][1].model_fields_set

    def evidence_of_motion(self, since_us: int = 0) -> Evidence | None:
        """Return the newest evidence from odometry, frames or motor log that it moved after this time of its clock."""
        rows = self.bench.motor_rows()
        found = [*evidence_of(self.readings(since_us)), *(evidence_in_log(rows, self.clock_us()) if rows else ())]
        return max((one for one in found if one.t_us >= since_us), key=lambda one: one.t_us, default=None)

    def expect_unmoved(self, what: str, since_us: int = 0) -> None:
        """Fail the case if the robot measured motion since this time of its clock, or since the start of the case."""
        moved = self.evidence_of_motion(since_us or self._first_t_us())
        self.bench.expect(moved is None, f"{what} the wheels turn: {moved.words if moved else ''}")

    def expect_rest(self, what: str) -> None:
        """Fail the case unless wheels with the command zero come to rest, and stay there for a while."""
        rests_us = self.clock_us() + SETTLES_US
        self.bench.rest(SETTLES_US + WATCHED_AT_REST_US)
        self.expect_unmoved(what, rests_us)

    def expect_at_speed(self, holds: bool, reason: str) -> None:
        """Fail the case unless `holds`. Not applicable if frames are so rare or so old that a robot slows down."""
        times_us = [one.at_us for one, _ in self.frames()[-5:]]
        steady = all(then - was + self.link_us() <= _STEADY_US for was, then in pairwise(times_us))
        self.bench.need(holds or steady, "too few frames, or too long a link, for a steady speed")
        self.bench.expect(holds, reason)

    def _first_t_us(self) -> int:
        """Return the robot's clock at the first message of the case, because a motor log begins earlier."""
        stamps = [stamp for channel in _STAMPED for one in self.bench.received(channel)[:1]
                  if (stamp := one.header(Stamp))]
        return min((stamp.t_us for stamp in stamps), default=0)

    # --- the rest ----------------------------------------------------------------------------------------------------

    def counts(self, reason: str, before: int, within_us: int = 400_000) -> bool:
        """Return True if more than `before` rejections for `reason` are counted in time."""
        return self.reaches(lambda status: status.refused.get(reason, 0) > before, within_us)

    def stamp(self) -> Stamp:
        """Return the header of the newest valid status. Raises ConformanceError as `status` does."""
        self.status()
        stamps = (one.header(Stamp) for one in reversed(self.bench.received(STATUS)))
        stamp = next((stamp for stamp in stamps if stamp is not None), None)
        self.bench.expect(stamp is not None, "no status has a header that can be read")
        assert stamp is not None
        return stamp

    def frame(self, within_us: int = FRAME_US) -> FrameHeader:
        """Return the header of the next frame. Raises NotApplicableError without one."""
        mark = self.bench.mark()
        self.bench.wait(lambda: self.frames(mark), within_us)
        frames = self.frames(mark)
        self.bench.need(frames, f"no frame within {within_us / 1e6:g} s")
        return frames[0][1]

    def frames(self, since: int = 0) -> list[tuple[Received, FrameHeader]]:
        """Return the frames since a mark that have a valid header."""
        return [
            (one, header) for one in self.bench.received(FRAME, since) if (header := one.header(FrameHeader))
        ]

    def each_frame(self, react: Callable[[FrameHeader], None]) -> None:
        """Call `react` for every later frame with a valid header."""

        def read(received: Received) -> None:
            header = received.header(FrameHeader)
            if header is not None:
                react(header)

        self.bench.on(FRAME, read)

    def camera(self) -> CameraModel | None:
        """Return the newest camera model."""
        received = self.bench.newest(CAMERA)
        return received.payload(CameraModel) if received else None


class Sender:
    """A peer of the robot that the kit plays: one source and session, with a count of its messages."""

    def __init__(self, robot: Robot, source: str = "vision", *, acks: bool = True) -> None:
        """Create the session. `acks`: immediately acknowledge every frame without a twist, so that frames continue."""
        self.robot, self.bench, self.source = robot, robot.bench, source
        # A robot remembers sessions of earlier runs of the kit, so theirs must differ: by the kit's clock.
        draw = (self.bench.now_us + 7919 * self.bench.number() + id_of(source)) * 2_654_435_761
        self.session = f"{draw & 0xFFFFFFFF:08x}"
        self._draws = 0
        self.proofs = ProofChain(self._draw)
        self.bench.played[session_digest(source, self.session)] = self
        self.seq = 0
        self.ack_seq = 0
        self.request_id = 0
        self.acks = acks
        self.driving: bytes | None = None
        self.sent_us = 0
        """When it sent its last twist."""
        self.delay_us = self.compute_us = 0
        robot.each_frame(self._on_frame)

    def _draw(self, count: int) -> bytes:
        """Draw bytes for a chain of proofs. They are not random, because a kit in virtual time must repeat its runs."""
        self._draws += 1
        return sha256(f"{self.session}/{self._draws}".encode()).digest()[:count]

    # --- headers -------------------------------------------------------------------------------------------------

    def header(self, frame: FrameHeader, **changes: Any) -> dict[str, Any]:
        """Return the header of an answer to `frame`. `changes` replace fields, `echo_...` in the echo; None removes."""
        echo = {"channel": "frame", "session": frame.session, "seq": frame.seq, "t_us": frame.t_us}
        echo.update({name[5:]: changes.pop(name) for name in list(changes) if name.startswith("echo_")})
        fields = {"v": 1, "source": self.source, "session": self.session, "seq": self.seq, "echo": echo}
        proof = {} if "proof" in changes else self.proofs.next()._asdict()
        fields.update(compute_us=self.compute_us, **proof, **changes)
        return {name: value for name, value in fields.items() if value is not None}

    # --- twists and acks -----------------------------------------------------------------------------------------

    def twist(self, frame: FrameHeader, text: bytes = CRAWL, **changes: Any) -> None:
        """Send a twist that cites `frame`. Its `seq` is the next one unless `changes` replace it."""
        self.seq += 1
        self.sent_us = self.bench.now_us
        self.bench.publish(TWIST, as_json(self.header(frame, **changes)), text, self.source)

    def ack(self, frame: FrameHeader, **changes: Any) -> None:
        """Acknowledge `frame`."""
        self.ack_seq += 1
        fields = {"seq": self.ack_seq, "proof": None, **changes}
        self.bench.publish(ACK, as_json(self.header(frame, **fields)), b"", self.source)

    def declare(self) -> Callable[[], None]:
        """Declare the token of this session; it ends with the returned function. Not applicable without tokens."""
        return self.bench.declare_token(self.proofs.token)

    def drive(self, text: bytes | None = CRAWL) -> None:
        """Answer every later frame with this twist; None: acknowledge again."""
        self.driving = text

    def fall_silent(self) -> None:
        """Stop answering."""
        self.driving, self.acks = None, False

    def _on_frame(self, frame: FrameHeader) -> None:
        if not (self.acks or self.driving):
            return
        if self.delay_us:
            self.bench.after(self.delay_us, lambda: self._answer(frame))
        else:
            self._answer(frame)

    def _answer(self, frame: FrameHeader) -> None:
        if self.driving is not None:
            self.twist(frame, self.driving)
        elif self.acks:
            self.ack(frame)

    def result_of(self, send: Callable[[], None]) -> str:
        """Return the result of the one command that `send` sends: GOOD, a rejection's reason, or NOT_COUNTED."""
        before = self.robot.status()
        send()
        self.robot.reaches(lambda status: _counts(status) != _counts(before), ANSWER_US)
        after = self.robot.status()
        news = _counts(after) - _counts(before)
        del news[CLAMPED]
        names = [GOOD if name in (RejectReason.DISARMED, GOOD) else name for name in news]
        return "+".join(sorted(names)) or NOT_COUNTED

    def expect_result(self, expected: str, send: Callable[[], None], what: str = "it") -> None:
        """Fail the case unless the one command that `send` sends gets the result `expected`."""
        self._compare(expected, self.result_of(send), what)

    def expect(self, expected: str, text: bytes = CRAWL, what: str = "the twist", **changes: Any) -> None:
        """Fail the case unless a twist that answers the next frame gets the result `expected`."""
        self._compare(expected, self.twist_result(text, **changes), what)

    def _compare(self, expected: str, result: str, what: str) -> None:
        self.bench.expect(result == expected, f"{what}: {result}, expected {expected}")

    def twist_result(self, text: bytes = CRAWL, **changes: Any) -> str:
        """Return the result of a twist that answers the next frame."""
        return self.result_on_next(lambda frame: self.twist(frame, text, **changes))

    def result_on_next(self, send: Callable[[FrameHeader], None]) -> str:
        """Return the result of a message by `send` about the next frame. A lost message is sent again."""
        result = NOT_COUNTED
        for _ in range(_SENT_AGAIN):
            self.robot.status()  # waits, if necessary, before the frame
            result = self.result_of(partial(send, self._frame_to_answer()))
            if result != NOT_COUNTED:
                break
        return result

    def _frame_to_answer(self) -> FrameHeader:
        """Return the next frame. It is not acknowledged, because an answer follows."""
        acks, self.acks = self.acks, False
        try:
            return self.robot.frame()
        finally:
            self.acks = acks

    def need_good(self) -> None:
        """Leave the case unless an ordinary twist is accepted; R-CAUS-01 tests that."""
        result = self.twist_result()
        self.bench.need(result == GOOD, f"an ordinary twist is not accepted here, but {result}")

    def need_unknown(self) -> None:
        """Leave the case unless a twist on a frame never issued is rejected as such; R-CAUS-02 tests that."""
        self.robot.status()
        frame = self.robot.frame()
        result = self.result_of(lambda: self.twist(frame, echo_seq=frame.seq + 5000))
        self.bench.need(result == "UNKNOWN_FRAME", f"an unknown frame is {result} (R-CAUS-02)")

    # --- requests ------------------------------------------------------------------------------------------------

    def request(self, verb: str, *, cite: Stamp | bool = True, **changes: Any) -> Reply | None:
        """Send a request and return the next reply, to any requester; None after a second.

        `cite` is the status to cite: True the newest, False none. `changes` replace fields of the header.
        """
        mark = self.bench.mark()
        self.send_request(verb, cite=cite, **changes)
        self.bench.wait(lambda: self.bench.received(REPLY, mark), REPLY_US)
        replies = [reply for one in self.bench.received(REPLY, mark) if (reply := one.payload(Reply)) is not None]
        return replies[0] if replies else None

    def send_request(self, verb: str, *, cite: Stamp | bool = True, **changes: Any) -> None:
        """Send a request without waiting. If keys forbid this source to request, an operator does it."""
        if not self.bench.access.may_request(self.source):
            self.bench.need(verb not in ("acquire", "release"), f"with its keys {self.source} may request nothing")
            Sender(self.robot, "operator", acks=False).send_request(verb, cite=cite, **changes)
            return
        self.request_id += 1
        stamp = self.robot.stamp() if cite is True else cite
        fields: dict[str, Any] = {"v": 1, "source": self.source, "session": self.session, "seq": self.request_id}
        if isinstance(stamp, Stamp):
            fields["echo"] = {"channel": "status", "session": stamp.session, "seq": stamp.seq, "t_us": stamp.t_us}
        fields.update((name, value) for name, value in self.proofs.next()._asdict().items() if value)
        payload = {"id": changes.pop("id", self.request_id), "verb": verb, **changes.pop("extra", {})}
        self.bench.publish(REQUEST, as_json({**fields, **changes}), as_json(payload), self.source)

    def reply(self, verb: str, **changes: Any) -> Reply:
        """Send a request and return its reply. Not applicable without a reply; R-REQ-01 tests that."""
        reply = self.request(verb, **changes)
        self.bench.need(reply is not None, f"no reply to {verb} (R-REQ-01)")
        assert reply is not None
        return reply

    def expect_granted(self, verb: str, what: str, **changes: Any) -> None:
        """Fail the case unless the request is granted."""
        reply = self.request(verb, **changes)
        self.bench.expect(reply is not None and reply.ok, f"{what}: {reply}")

    def expect_rejected(self, verb: str, reason: str, what: str, **changes: Any) -> None:
        """Fail the case unless the request is rejected and, unless `reason` is empty, counted under it."""
        before = self.robot.newer_status().refused.get(reason, 0)
        reply = self.reply(verb, **changes)
        self.bench.expect(not reply.ok, f"{verb} was granted: {what}")
        counted = not reason or self.robot.counts(reason, before)
        self.bench.expect(counted, f"{what}: rejected with {reply.detail!r}, expected {reason}")

    def granted(self, verb: str, **changes: Any) -> bool:
        """Send a request. Returns True if it was granted."""
        reply = self.request(verb, **changes)
        return reply is not None and reply.ok


def _counts(status: Status) -> Counter[str]:
    return Counter({**status.refused, GOOD: status.accepted})


def id_of(name: str) -> int:
    """Return a number for a name, the same in every run."""
    return int.from_bytes(name.encode()[:8])


def as_json(fields: dict[str, Any]) -> bytes:
    """Return compact JSON."""
    return json.dumps(fields, separators=(",", ":")).encode()


# --- initial states of cases -----------------------------------------------------------------------------------------


def vision(bench: Bench) -> Sender:
    """Return a sender that acknowledges frames as `vision`."""
    return Sender(Robot(bench))


def ready(bench: Bench) -> Sender:
    """Return a sender whose first twist was good, so that it holds the lease."""
    sender = vision(bench)
    sender.need_good()
    return sender


def operator(bench: Bench) -> Sender:
    """Return an operator that has received a status."""
    operator = Sender(Robot(bench), "operator")
    operator.robot.status()
    return operator


def teleop(bench: Bench) -> Sender:
    """Return a human driver that acknowledges frames."""
    return Sender(Robot(bench), "teleop")


def ready_human(bench: Bench) -> Sender:
    """A human driver whose first twist was good, so that it holds the lease."""
    human = teleop(bench)
    human.need_good()
    return human


def watcher(bench: Bench) -> Sender:
    """Return a peer of a role that may not drive."""
    return Sender(Robot(bench), bench.access.watcher)


def armed(bench: Bench, source: str = "vision", text: bytes = CRAWL) -> Sender:
    """Return a driver that the robot follows, driving with `text`; R-ARM-03 tests that this is possible."""
    driver = Sender(Robot(bench), source)
    driver.drive(text)
    if not bench.wait(lambda: driver.seq >= 8, 3_000_000):
        bench.need(False, "too few frames to arm with")
    arm(driver)
    return driver


def moving(bench: Bench, source: str = "vision") -> Sender:
    """Return a driver of a robot whose wheels turn, for cases that stop it."""
    driver = armed(bench, source)
    driver.robot.reaches(lambda status: status.applied[0] > 0.05, 1_000_000)
    return driver


def is_arm_granted(requester: Sender) -> bool:
    """Return True if one of five requests to arm is granted: the first may be too early after rejected twists."""
    for _ in range(5):
        if requester.granted("arm"):
            return True
        requester.bench.rest(200_000)
    return False


def arm(driver: Sender) -> None:
    """Arm the robot of `driver`. Not applicable if that fails."""
    is_arm_granted(driver)
    reached = driver.robot.becomes(*DRIVEN, within_us=1_500_000)
    driver.bench.need(reached, "the robot could not be armed and driven (R-ARM-03)")
