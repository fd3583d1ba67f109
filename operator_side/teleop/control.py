"""`sightline teleop`: a person drives, holding a key. Keys, frames and status in; messages for the robot out. Pure.

Every command cites the newest frame seen, so the robot itself judges how old the link is, as it does with any driver. A
person who lets go sends zeros and keeps the lease; one who is gone loses it, and the robot stops.
"""

from collections.abc import Iterator
from enum import Enum
from typing import Final

from sightline.operator_side.client.requests import Report, read_report
from sightline.operator_side.teleop_keys import (
    FRESH_US,
    HAND_OVER,
    MOST_AT_ONCE,
    MOVES,
    SPEEDS,
    STOPS,
    Hold,
    split_keys,
)
from sightline.operator_side.teleop_speed import Speeds, SpeedUp
from sightline.protocol.channels import ACK, REPLY, REQUEST, TWIST, Channel
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import (
    STILL,
    AnswerHeader,
    Echo,
    FrameHeader,
    Reply,
    Request,
    RequestHeader,
    State,
    Twist,
    Verb,
)
from sightline.protocol.refusals import RejectReason
from sightline.protocol.transports.link import Message
from sightline.protocol.text import format_twist

SOURCE: Final = "teleop"
PERIOD_US: Final = 30_000
"""Between commands, about one per frame. What a person does is sent at once."""
_REPEAT_AFTER_US: Final = 60_000
_ARM_FOR_US: Final = 2_000_000
"""A press arms for this long: five live commands and a request take a fraction of it."""
_ASK_ON: Final = (RejectReason.NOT_ALLOWED, RejectReason.STALE, RejectReason.OTHER_SESSION, RejectReason.UNKNOWN_FRAME)
"""What only time mends: live commands that are still missing, a status from before the link or the robot came back."""
_HAND_OVER_FOR_US: Final = 5_000_000
"""After that nobody is there to take over."""


class Mode(Enum):
    """Who is to drive."""

    LOOKING_ON = "looking on"
    DRIVING = "you drive"
    HANDING_OVER = "handing over"


class Teleop:
    """One person's session at one robot."""

    def __init__(self, session: str, speeds: Speeds) -> None:
        self.session = session
        self.speeds = speeds
        self.mode = Mode.LOOKING_ON
        self.report: Report | None = None
        self.heard_us = 0
        """When a status came, understood or not."""
        self.note = ""
        """What the person should know beside the robot's status."""
        self._hold = Hold()
        self._deaf_until_us = 0
        self._stick: tuple[float, float] | None = None
        self._stick_waits = False
        """Somebody stopped, or handed over, with the dead man's button held: it has to be let go of first."""
        self._speed_up = SpeedUp()
        self._echo: Echo | None = None
        self._unanswered = False
        self._seq = self._id = 0
        self._due_us = 0
        self._sent = STILL
        self._leaving = self.has_left = False
        self._asking: Verb | None = None
        self._ask_due_us = self._ask_until_us = self._asked_from_id = 0

    # --- what comes in -------------------------------------------------------------------------------------------

    def on_keys(self, text: str, now_us: int) -> None:
        """What was read from the terminal at once. A pile of keys is what a link that stalled or a paste brings, and
        tells of no key that is held now: only stopping counts, and so it is of what comes just behind it."""
        keys = split_keys(text)
        if len(keys) > MOST_AT_ONCE:
            self._deaf_until_us = now_us + FRESH_US
        if now_us < self._deaf_until_us:
            keys = [key for key in keys if key in STOPS]
            self._hold.miss(now_us)
        for key in keys:
            if key in MOVES:
                self._drive(self._hold.press(key, now_us), now_us)
            elif key in STOPS:
                self.stop()
            elif key == HAND_OVER:
                self.hand_over(now_us)
            elif key in SPEEDS:
                self.speeds.change(*SPEEDS[key])

    def on_stick(self, shares: tuple[float, float] | None, now_us: int) -> None:
        """A gamepad: shares (-1..1) of both speeds while its dead man's button is held, else None."""
        self._stick_waits &= shares is not None
        if self._stick_waits:
            return
        pressed = shares is not None and self._stick is None
        released = shares is None and self._stick is not None
        self._stick = shares
        if pressed:
            self._drive(True, now_us)
        elif released:
            self._hold.release()

    @property
    def sees(self) -> bool:
        """Whether a picture has come: without one there is nothing to cite."""
        return self._echo is not None

    def on_frame(self, message: Message) -> None:
        """The newest picture's header: what commands cite."""
        try:
            frame = decode(FrameHeader, message.header)
        except WireError:
            return
        self._echo = Echo(channel="frame", session=frame.session, seq=frame.seq, t_us=frame.t_us)
        self._unanswered = True

    def on_status(self, message: Message, now_us: int) -> None:
        """The newest status."""
        self.heard_us = now_us
        try:
            self.report = read_report(message)
        except WireError as error:
            self.note = f"the robot's status is not understood: {error.detail}"
            return
        self.speeds.limit(self.report.status)
        if self.mode is Mode.HANDING_OVER and self._asking is not Verb.RELEASE and self._other_drives():
            self.mode, self._asking, self.note = Mode.LOOKING_ON, None, ""

    def on_reply(self, message: Message) -> None:
        """An answer to what was asked."""
        try:
            reply = decode(Reply, message.payload, REPLY.max_payload_bytes)
        except WireError:
            return
        if reply.to != self.session or reply.id < self._asked_from_id:
            return
        if self._leaving:
            self.has_left |= reply.ok
        elif self._asking is None:
            return
        elif reply.ok:
            self._granted()
        elif not reply.detail.startswith(_ASK_ON):
            self.note = f"{self._asking} refused: {reply.detail}"
            self._asking = None

    # --- what a person wants -------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stand still, whoever drove; the robot stays armed, in this person's hands."""
        self._let_go()
        self.mode, self._asking, self._due_us = Mode.DRIVING, None, 0

    def hand_over(self, now_us: int) -> None:
        """Let go of the robot and arm whoever else sends commands: the one way back to autonomy, and a person's own."""
        self._let_go()
        self.mode, self.note = Mode.HANDING_OVER, ""
        self._ask(Verb.RELEASE, now_us, _HAND_OVER_FOR_US)

    def _let_go(self) -> None:
        self._hold.release()
        self._stick_waits |= self._stick is not None
        self._stick = None

    def leave(self) -> Iterator[Message]:
        """The last words: zero, then the lease given back, again until `has_left`. Nothing where another one drives."""
        if self.mode is Mode.LOOKING_ON:
            self.has_left = True
            return
        if self.mode is Mode.DRIVING and self._echo is not None:
            yield self._command(STILL, self._echo)
        if not self._leaving:
            self._leaving, self.mode = True, Mode.HANDING_OVER  # one zero: another would take the lease again
            self._asked_from_id = self._id + 1
        yield self._request(Verb.RELEASE)

    def _drive(self, fresh: bool, now_us: int) -> None:
        """A movement key takes over; a fresh press arms."""
        took_over = self.mode is not Mode.DRIVING
        self.mode = Mode.DRIVING
        if fresh or took_over:
            self.note = ""
            self._ask(Verb.ARM, now_us, _ARM_FOR_US)  # also if it seems armed: a status may be from before a release
        if took_over:
            self._speed_up, self._sent = SpeedUp(), STILL
        if self._sent == STILL:
            self._due_us = 0

    # --- what goes out -------------------------------------------------------------------------------------------

    def messages(self, now_us: int) -> Iterator[Message]:
        """What is to be sent now; call it every few milliseconds, and after every input."""
        if self._echo is None:
            return
        goal = self._goal(now_us)
        if self.mode is Mode.DRIVING and (now_us >= self._due_us or (goal == STILL != self._sent)):
            self._due_us = now_us + PERIOD_US
            self._sent = self._speed_up.step(goal, now_us)
            self._unanswered = False
            yield self._command(self._sent, self._echo)
        elif self._unanswered and self.mode is not Mode.DRIVING:
            self._unanswered = False
            yield self._message(ACK, encode(self._answer(self._echo)), b"")
        yield from self._asked(now_us)

    def _goal(self, now_us: int) -> Twist:
        """What is held, at the speeds of now."""
        if self.mode is not Mode.DRIVING:
            return STILL
        held = MOVES[self._hold.key] if self._hold.is_held(now_us) else (0, 0)
        linear, angular = held if self._stick is None else self._stick
        return Twist(
            linear_mps=linear * self.speeds.linear_mps, angular_rad_s=angular * self.speeds.angular_rad_s
        )

    def _asked(self, now_us: int) -> Iterator[Message]:
        verb = self._asking
        if now_us > self._ask_until_us and (verb is not None or self.mode is Mode.HANDING_OVER):
            self._gave_up()
        elif verb is not None and self._may_ask(verb, now_us):
            self._ask_due_us = now_us + _REPEAT_AFTER_US
            yield self._request(verb)

    def _may_ask(self, verb: Verb, now_us: int) -> bool:
        """What lets a robot move cites a status, so one must have come."""
        return now_us >= self._ask_due_us and (verb is Verb.RELEASE or self.report is not None)

    def _ask(self, verb: Verb, now_us: int, for_us: int) -> None:
        self._asking, self._ask_due_us, self._ask_until_us = verb, now_us, now_us + for_us
        self._asked_from_id = self._id + 1

    def _granted(self) -> None:
        handed_over = self._asking is Verb.RELEASE and self.mode is Mode.HANDING_OVER
        self._asking = Verb.ARM if handed_over else None
        self._asked_from_id = self._id + 1

    def _gave_up(self) -> None:
        self._asking = None
        if self.mode is Mode.HANDING_OVER:
            self.mode, self.note = Mode.LOOKING_ON, "nobody has taken over: is vision running?"
        else:
            self.note = "it could not be armed; press again"

    def _other_drives(self) -> bool:
        status = self.report.status if self.report else None
        armed = status is not None and status.state in (State.ACTIVE, State.DEGRADED)
        return armed and status is not None and status.holder is not None and status.holder.session != self.session

    # --- messages ------------------------------------------------------------------------------------------------

    def _answer(self, echo: Echo) -> AnswerHeader:
        self._seq += 1
        return AnswerHeader(source=SOURCE, session=self.session, seq=self._seq, echo=echo)

    def _command(self, twist: Twist, echo: Echo) -> Message:
        return self._message(TWIST, encode(self._answer(echo)), format_twist(twist))

    def _request(self, verb: Verb) -> Message:
        self._id += 1
        self._seq += 1
        echo = None
        if self.report is not None:
            stamp = self.report.stamp
            echo = Echo(channel="status", session=stamp.session, seq=stamp.seq, t_us=stamp.t_us)
        header = RequestHeader(source=SOURCE, session=self.session, seq=self._seq, echo=echo)
        return self._message(REQUEST, encode(header), encode(Request(id=self._id, verb=verb)))

    @staticmethod
    def _message(channel: Channel, header: bytes, payload: bytes) -> Message:
        return Message(channel, SOURCE, header, payload)
