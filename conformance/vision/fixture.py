"""The robot that the kit plays for a vision service, and the answers of the service. Pure.

    robot = RobotPlayed(bench).met()
    sent = robot.frame("left")
    answer = robot.answer_to(sent)

An answer belongs to a frame if its echo has the `seq` or the `t_us` of that frame. One wrong field then fails only the
case about that field. The kit's link only counts rejected answers; a case that misses such an answer is not
applicable, since another case reports its fault.
"""

import itertools
import json
import math
import zlib
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from typing import Any, Final, Self

from sightline.conformance.case import KEPT_MESSAGES, NOT_DRIVING, Bench, Received
from sightline.conformance.vision.images import CAMERA as LENS
from sightline.conformance.vision.images import picture
from sightline.protocol.channels import ACK, CAMERA, FRAME, STATUS, TWIST, Channel
from sightline.protocol.codec import encode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import CameraModel, FrameHeader, Stamp, State, Status

ANSWER_US: Final = 500_000
"""Credit that is not returned times out within this; later answers are useless."""
FRAME_US: Final = 33_333
_CAMERA_US: Final = 500_000
_STATUS_US: Final = 100_000
_FIRST_T_US: Final = 7_000_000_123
"""A robot's clock differs from the kit's: each start has another one."""
_SEQ_APART: Final = 10_000
_MEETING_FRAMES: Final = 30
ARMED: Final = Status(state=State.ACTIVE, reason="driving")
_STARTS = itertools.count(1)


@dataclass(frozen=True, slots=True)
class Sent:
    """A sent frame, with its time on the robot's clock and on the kit's."""

    session: str
    seq: int
    t_us: int
    at_us: int


@dataclass(frozen=True, slots=True)
class VisionAnswer:
    """A twist or an ack. `fields` is its header as JSON, empty if it is invalid."""

    received: Received
    fields: dict[str, Any]

    @property
    def is_twist(self) -> bool:
        """Return True for a twist."""
        return self.received.message.channel is TWIST

    @property
    def echo(self) -> dict[str, Any]:
        """Return its echo, or an empty object."""
        echo = self.fields.get("echo")
        return echo if isinstance(echo, dict) else {}

    @property
    def text(self) -> bytes:
        """Return the payload."""
        return self.received.message.payload

    @property
    def speeds(self) -> tuple[float, float]:
        """Return (linear_mps, angular_rad_s) in any notation; zeros for an invalid text."""
        try:
            linear, angular = (float(part) for part in self.text.split(b"|"))
        except ValueError:
            return 0.0, 0.0
        return linear, angular

    def cites(self, sent: Sent) -> bool:
        """Return True if it cites `sent`, with one wrong field permitted."""
        return self.echo.get("seq") == sent.seq or self.echo.get("t_us") == sent.t_us

    def words(self) -> str:
        """Describe it for a report."""
        return f"a {self.received.message.channel.name} that cites {json.dumps(self.echo)[:160]}"


def read_answer(received: Received) -> VisionAnswer:
    """Return the answer in `received`, its header read as any JSON object."""
    try:
        fields = json.loads(received.message.header)
    except (ValueError, RecursionError):
        fields = {}
    return VisionAnswer(received, fields if isinstance(fields, dict) else {})


def met(bench: Bench) -> "RobotPlayed":
    """Start most cases with a robot that the vision service drives."""
    return RobotPlayed(bench).met()


class RobotPlayed:
    """One start of a robot: session, clock, count. It publishes camera and status until the case ends or `stop`."""

    def __init__(
        self, bench: Bench, *, camera: CameraModel | None = LENS, status: Status | bytes | None = ARMED,
        first_seq: int | None = None, first_t_us: int | None = None,
    ) -> None:
        """Start the robot. `camera` and `status` are published at their rates; None: not at all.

        The first `seq` and `t_us` differ from those of every other start unless given.
        """
        self.bench, self.camera, self.status = bench, camera, status
        start = next(_STARTS)
        self.session = f"{zlib.crc32(f'{start} {bench.robot} {bench.now_us}'.encode()):08x}"
        first_seq = start * _SEQ_APART if first_seq is None else first_seq
        first_t_us = start * _FIRST_T_US if first_t_us is None else first_t_us
        self._began_us, self._mark, self._dropped = bench.now_us, bench.mark(), bench.dropped_here.total()
        self._first_t_us, self._last_t_us, self._next_seq = first_t_us, first_t_us - 1, first_seq
        self._stamps, self._stopped = itertools.count(1), False
        self._answers: list[VisionAnswer] = []
        self._sessions: list[str] = []
        self._plain: list[Sent] = []
        self._announce_camera()
        self._announce_status()

    # --- sending ------------------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stop sending."""
        self._stopped = True

    def stamp(self) -> Stamp:
        """Return the header of any message but a frame."""
        return Stamp(session=self.session, seq=next(self._stamps), t_us=self._clock_us())

    def show(self, camera: CameraModel | None) -> None:
        """Use another camera from now on."""
        self.camera = camera
        if camera is not None:
            self.bench.publish(CAMERA, self.stamp(), camera)

    def publish(self, channel: Channel, payload: bytes, header: bytes | None = None) -> None:
        """Publish bytes on a channel of the robot, by default with a valid header."""
        self.bench.publish(channel, encode(self.stamp()) if header is None else header, payload)

    def frame(self, name: str = "centre", *, jpeg: bytes | None = None, header: bytes | None = None,
              **fields: Any) -> Sent:
        """Send an image now; `fields` replace those of its header, `header` all of it."""
        t_us = max(self._clock_us(), self._last_t_us + 1)
        known = FrameHeader(session=self.session, seq=self._next_seq, t_us=t_us).model_copy(update=fields)
        if not fields.keys() & {"seq", "t_us", "session"}:
            self._next_seq, self._last_t_us = known.seq + 1, known.t_us
        # The time before sending, because sending takes time and a fast peer answers meanwhile.
        sent = Sent(known.session, known.seq, known.t_us, self.bench.now_us)
        if header is None:
            self._plain.append(sent)
        self.bench.publish(FRAME, encode(known) if header is None else header, picture(name) if jpeg is None else jpeg)
        return sent

    def next_fields(self) -> dict[str, Any]:
        """Return the header fields of the next frame as a dictionary, without sending it."""
        self._last_t_us = max(self._clock_us(), self._last_t_us + 1)
        self._next_seq += 1
        known = FrameHeader(session=self.session, seq=self._next_seq - 1, t_us=self._last_t_us)
        return known.model_dump(mode="json", exclude_none=True)

    def film(self, name: str, frames: int, every_us: int = FRAME_US) -> list[Sent]:
        """Send that many images at a steady rate, or each when its credit has returned (7.2), whichever is later."""
        sent = []
        for _ in range(frames):
            sent.append(self.frame(name))
            self.bench.rest(every_us)
            self.is_answered(sent[-1], sent[-1].at_us + ANSWER_US - self.bench.now_us)
        return sent

    def _clock_us(self) -> int:
        return self.bench.now_us - self._began_us + self._first_t_us

    def _announce_camera(self) -> None:
        if not self._stopped:
            if self.camera is not None:
                self.bench.publish(CAMERA, self.stamp(), self.camera)
            self.bench.after(_CAMERA_US, self._announce_camera)

    def _announce_status(self) -> None:
        if not self._stopped:
            if self.status is not None:
                self.bench.publish(STATUS, self.stamp(), self.status)
            self.bench.after(_STATUS_US, self._announce_status)

    # --- receiving ----------------------------------------------------------------------------------------------------

    def answers(self, since: int | None = None) -> list[VisionAnswer]:
        """Return twists and acks since the start of this robot, or since a mark, in order of arrival."""
        newest = self._answers[-1].received.number if self._answers else 0
        new = [*self.bench.received(TWIST, newest), *self.bench.received(ACK, newest)]
        read = [read_answer(one) for one in sorted(new, key=lambda one: one.number)]
        self._check_one_peer(read)
        self._answers += read
        del self._answers[: -2 * KEPT_MESSAGES]
        first = bisect_right(self._answers, self._mark if since is None else since, key=lambda one: one.received.number)
        return self._answers[first:]

    def _check_one_peer(self, answers: list[VisionAnswer]) -> None:
        """Raise LinkError if a session answers again after another one, as two services do that answer each frame."""
        for session in (str(one.fields["session"]) for one in answers if "session" in one.fields):
            if session in self._sessions[:-1]:
                raise LinkError(f"answers of two sessions, {self._sessions[-1]} and {session}, come in turn; end the "
                                "second vision service, or let the service keep its session (2.5)")
            if session not in self._sessions:
                self._sessions.append(session)

    def twists(self, since: int | None = None) -> list[VisionAnswer]:
        """Return only the twists."""
        return [one for one in self.answers(since) if one.is_twist]

    def answers_to_others(self, since: int) -> list[VisionAnswer]:
        """Return twists and acks since a mark that do not answer a frame with a valid header.

        An answer may come late, and twice while frames are lost (7.1).
        """
        plain = [[one.session, one.seq, one.t_us] for one in self._plain]
        names = ("session", "seq", "t_us")
        return [one for one in self.answers(since) if [one.echo.get(name) for name in names] not in plain]

    def answers_to(self, sent: Sent) -> list[VisionAnswer]:
        """Return all answers since it was sent that cite `sent`."""
        answers = self.answers()
        first = bisect_left(answers, sent.at_us, key=lambda one: one.received.at_us)
        return [one for one in answers[first:] if one.cites(sent)]

    def is_answered(self, sent: Sent, within_us: int = ANSWER_US) -> bool:
        """Return True if an answer to `sent` arrives in time."""
        return self.bench.wait(lambda: self.answers_to(sent), within_us)

    def answer_to(self, sent: Sent, within_us: int = ANSWER_US) -> VisionAnswer:
        """Return the answer to `sent`. Fails the case if none arrives in time."""
        if not self.is_answered(sent, within_us):
            self.need_nothing_dropped()
            self.bench.expect(False, f"no answer to frame {sent.seq} within {within_us / 1e6:g} s")
        return self.answers_to(sent)[0]

    def is_driven(self, *sent: Sent, within_us: int = ANSWER_US) -> bool:
        """Return True if a twist cites one of `sent` in time. It may come later than an ack of the same frame (7.1)."""
        return self.bench.wait(lambda: any(map(self.twists_to, sent)), within_us)

    def expect_twist(self, sent: Sent) -> None:
        """Fail the case unless a twist answers `sent`."""
        answer = self.answer_to(sent)
        self.bench.expect(self.is_driven(sent), f"it came to {answer.words()}, not to a twist")

    def expect_any_twist(self, sent: list[Sent]) -> None:
        """Fail the case unless a twist cites one of `sent`."""
        self.bench.expect(self.is_driven(*sent), "no twist came")

    def expect_finite(self) -> None:
        """Fail the case if a number of a twist is not finite."""
        for twist in self.twists():
            self.bench.expect(all(map(math.isfinite, twist.speeds)), f"{twist.text!r} is not finite")

    def twists_to(self, sent: Sent) -> list[VisionAnswer]:
        """Return the twists that cite `sent`."""
        return [one for one in self.answers_to(sent) if one.is_twist]

    def need_nothing_dropped(self) -> None:
        """Leave the case if this end's link rejected a message; another case reports it."""
        dropped = self.bench.dropped_here
        self.bench.need(dropped.total() == self._dropped, f"answers came that break the rules of keys or sizes: "
                        f"{', '.join(sorted(dropped))}")

    def met(self) -> Self:
        """Wait until the vision service drives by these images. Cases that need that are otherwise not applicable."""
        self.bench.need(self._drives(_MEETING_FRAMES), NOT_DRIVING)
        return self

    def _drives(self, frames: int) -> bool:
        """Return True once a twist cites one of that many plain frames."""
        sent: list[Sent] = []
        for _ in range(frames):
            sent.append(self.frame())
            if self.is_answered(sent[-1]) and self.is_driven(*sent, within_us=FRAME_US):
                return True
        return self.is_driven(*sent)

    def expect_driven(self, after: str) -> None:
        """Fail the case unless a twist answers one of three plain frames."""
        if not self._drives(3):
            self.need_nothing_dropped()
            self.bench.expect(False, f"after {after}, plain frames get no twist any more")
