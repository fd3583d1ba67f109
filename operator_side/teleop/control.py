"""Teleop's logic: keys held, speeds, hand-over to vision; messages for the robot out. Pure."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final

from sightline.operator_side.client.requests import StatusReport, read_report
from sightline.protocol.channels import ACK, REPLY, REQUEST, TWIST, Channel
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.messages import (
    STILL,
    AnswerHeader,
    Echo,
    FrameHeader,
    Reply,
    Request,
    RequestHeader,
    State,
    Status,
    Twist,
    Verb,
)
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import Message

_STEP: Final = 1.1
"""A key press changes a speed by 10 %."""
_LEAST_MPS: Final = 0.02
_LEAST_RAD_S: Final = 0.1
_RAMP_MPS2: Final = 0.8
_RAMP_RAD_S2: Final = 5.0
_FIRST_STEP_US: Final = 30_000
"""A press moves the robot with the very first command."""
_LONGEST_STEP_US: Final = 100_000


@dataclass(slots=True)
class Speeds:
    """Wanted top speeds, within what the robot says it can do."""

    linear_mps: float
    angular_rad_s: float
    most_mps: float = 3.0
    most_rad_s: float = 10.0

    def change(self, linear: int, angular: int) -> None:
        """By 10 % up (1) or down (-1) each."""
        self.linear_mps *= _STEP**linear
        self.angular_rad_s *= _STEP**angular
        self._keep()

    def limit(self, status: Status) -> None:
        """The robot's own limits; a robot that says none keeps what was."""
        self.most_mps = status.max_linear_mps or self.most_mps
        self.most_rad_s = status.max_angular_rad_s or self.most_rad_s
        self._keep()

    def _keep(self) -> None:
        self.linear_mps = max(min(_LEAST_MPS, self.most_mps), min(self.most_mps, self.linear_mps))
        self.angular_rad_s = max(min(_LEAST_RAD_S, self.most_rad_s), min(self.most_rad_s, self.angular_rad_s))


class SpeedUp:
    """Brings the twist to its goal: up by a ramp, down at once. A release is zero in the very next command."""

    def __init__(self) -> None:
        self.twist = STILL
        self._stepped_us: int | None = None

    def step(self, goal: Twist, now_us: int) -> Twist:
        """The twist to command now."""
        elapsed_us = _FIRST_STEP_US if self._stepped_us is None else min(_LONGEST_STEP_US, now_us - self._stepped_us)
        self._stepped_us = now_us
        self.twist = Twist(
            linear_mps=_towards(self.twist.linear_mps, goal.linear_mps, _RAMP_MPS2 * elapsed_us / 1e6),
            angular_rad_s=_towards(self.twist.angular_rad_s, goal.angular_rad_s, _RAMP_RAD_S2 * elapsed_us / 1e6),
        )
        return self.twist


def _towards(speed: float, goal: float, change: float) -> float:
    """`goal` where that is slower the same way; else nearer to it by `change`, from zero where the way reverses."""
    start = speed if speed * goal > 0 else 0.0
    if abs(goal) <= abs(start):
        return goal
    return min(goal, start + change) if goal > 0 else max(goal, start - change)


# What keys mean to `sightline teleop`, and whether one is still held. Pure.  A terminal tells presses and repeats,
# never releases. So a key counts as held for a little longer than its repeats are apart, which is learnt from the
# repeats themselves; before the first repeat, a little longer than the terminal's delay.


MOVES: Final[dict[str, tuple[int, int]]] = {
    "u": (1, 1), "i": (1, 0), "o": (1, -1),
    "j": (0, 1), "l": (0, -1),
    "m": (-1, -1), ",": (-1, 0), ".": (-1, 1),
    "\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1),
}  # fmt: skip
"""Key -> share of (linear, angular) speed. Back and to the left turns clockwise, as a car that backs up does."""
SPEEDS: Final[dict[str, tuple[int, int]]] = {
    "q": (1, 1), "z": (-1, -1), "w": (1, 0), "x": (-1, 0), "e": (0, 1), "c": (0, -1),
}  # fmt: skip
"""Key -> whether (linear, angular) speed goes up or down."""
STOPS: Final = ("k", " ", "\x1b[E")
HAND_OVER: Final = "a"
MOST_AT_ONCE: Final = 4
"""Keys of one read that hands on a keyboard may bring: at 30 repeats a second, what comes in 130 ms."""

_FIRST_DELAY_US: Final = 500_000
"""From a press to its first repeat on most desktops, until it is learnt."""
_SLACK: Final = 1.3
_LONGEST_FIRST_US: Final = 900_000
_FIRST_INTERVAL_US: Final = 35_000
_INTERVALS: Final = 3
_SHORTEST_HOLD_US: Final = 80_000
LONGEST_HOLD_US: Final = 120_000
"""With the period of the commands on top, a release is a zero command within 150 ms."""
_REPEATS_WITHIN_US: Final = 150_000
"""What comes later is another press."""
_FORGOTTEN_US: Final = 1_000_000
FRESH_US: Final = 300_000
"""A press after this long without any is a new decision to drive: only such a one arms a robot."""


def split_keys(text: str) -> list[str]:
    """The keys of what was read: an arrow is three characters. What is cut off or unknown stays as single ones."""
    keys: list[str] = []
    at = 0
    while at < len(text):
        length = 3 if text[at : at + 2] in ("\x1b[", "\x1bO") else 1
        keys.append(text[at : at + length].replace("\x1bO", "\x1b["))
        at += length
    return keys


@dataclass(slots=True)
class Hold:
    """The movement key that is held, as far as repeats tell."""

    key: str = ""
    delay_us: int = _FIRST_DELAY_US
    interval_us: int = _FIRST_INTERVAL_US
    _presses: int = 0
    _first_gap_us: int = 0
    _last_us: int | None = None

    def press(self, key: str, now_us: int) -> bool:
        """A movement key came, pressed or repeated. True for a fresh press, after a while without any."""
        gap_us = _FORGOTTEN_US if self._last_us is None else now_us - self._last_us
        if gap_us == 0 and key == self.key:
            return False  # several repeats of one read
        self._last_us = now_us
        if self._is_repeat(key, gap_us):
            self._learn(gap_us)
            self._presses += 1
            return False
        self.key, self._presses = key, 1
        return gap_us >= FRESH_US

    def _is_repeat(self, key: str, gap_us: int) -> bool:
        """The first repeat comes after the terminal's delay, the others soon after one another."""
        return key == self.key and gap_us < (_FORGOTTEN_US if self._presses == 1 else _REPEATS_WITHIN_US)

    def _learn(self, gap_us: int) -> None:
        """The delay is believed once a quick repeat has followed it: somebody who taps has none."""
        if self._presses == 1:
            self._first_gap_us = gap_us
            return
        if self._presses == 2 and self._first_gap_us > _REPEATS_WITHIN_US:
            self.delay_us = self._first_gap_us
        self.interval_us += (gap_us - self.interval_us) // 4

    def release(self) -> None:
        """Nothing is held any more."""
        self.key, self._presses = "", 0

    def miss(self, now_us: int) -> None:
        """Keys came that tell nothing of now; what follows them is no fresh press."""
        self.release()
        self._last_us = now_us

    def is_held(self, now_us: int) -> bool:
        """Whether the key has to be taken as held."""
        return bool(self.key) and self._last_us is not None and now_us - self._last_us <= self.patience_us

    @property
    def patience_us(self) -> int:
        """How long after the last press or repeat the key counts as held."""
        if self._presses <= 1:
            return min(_LONGEST_FIRST_US, round(self.delay_us * _SLACK))
        return max(_SHORTEST_HOLD_US, min(LONGEST_HOLD_US, _INTERVALS * self.interval_us))


# `sightline teleop`: a person drives, holding a key. Keys, frames and status in; messages for the robot out. Pure.
# Every command cites the newest frame seen, so the robot itself judges how old the link is, as it does with any
# driver. A person who lets go sends zeros and keeps the lease; one who is gone loses it, and the robot stops.


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
        self.report: StatusReport | None = None
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
        self._pending_request: Verb | None = None
        self._request_due_us = self._request_until_us = self._requested_from_id = 0

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
        self._echo = Echo.of(frame)
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
        if self.mode is Mode.HANDING_OVER and self._pending_request is not Verb.RELEASE and self._other_drives():
            self.mode, self._pending_request, self.note = Mode.LOOKING_ON, None, ""

    def on_reply(self, message: Message) -> None:
        """An answer to what was asked."""
        try:
            reply = decode(Reply, message.payload, REPLY.max_payload_bytes)
        except WireError:
            return
        if reply.to != self.session or reply.id < self._requested_from_id:
            return
        if self._leaving:
            self.has_left |= reply.ok
        elif self._pending_request is None:
            return
        elif reply.ok:
            self._granted()
        elif not reply.detail.startswith(_ASK_ON):
            self.note = f"{self._pending_request} refused: {reply.detail}"
            self._pending_request = None

    # --- what a person wants -------------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stand still, whoever drove; the robot stays armed, in this person's hands."""
        self._let_go()
        self.mode, self._pending_request, self._due_us = Mode.DRIVING, None, 0

    def hand_over(self, now_us: int) -> None:
        """Let go of the robot and arm whoever else sends commands: the one way back to autonomy, and a person's own."""
        self._let_go()
        self.mode, self.note = Mode.HANDING_OVER, ""
        self._repeat_request(Verb.RELEASE, now_us, _HAND_OVER_FOR_US)

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
            self._requested_from_id = self._id + 1
        yield self._request(Verb.RELEASE)

    def _drive(self, fresh: bool, now_us: int) -> None:
        """A movement key takes over; a fresh press arms."""
        took_over = self.mode is not Mode.DRIVING
        self.mode = Mode.DRIVING
        if fresh or took_over:
            self.note = ""
            # Also if it seems armed: a status may be from before a release.
            self._repeat_request(Verb.ARM, now_us, _ARM_FOR_US)
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
        yield from self._requests(now_us)

    def _goal(self, now_us: int) -> Twist:
        """What is held, at the speeds of now."""
        if self.mode is not Mode.DRIVING:
            return STILL
        held = MOVES[self._hold.key] if self._hold.is_held(now_us) else (0, 0)
        linear, angular = held if self._stick is None else self._stick
        return Twist(
            linear_mps=linear * self.speeds.linear_mps, angular_rad_s=angular * self.speeds.angular_rad_s
        )

    def _requests(self, now_us: int) -> Iterator[Message]:
        verb = self._pending_request
        if now_us > self._request_until_us and (verb is not None or self.mode is Mode.HANDING_OVER):
            self._gave_up()
        elif verb is not None and self._may_request(verb, now_us):
            self._request_due_us = now_us + _REPEAT_AFTER_US
            yield self._request(verb)

    def _may_request(self, verb: Verb, now_us: int) -> bool:
        """What lets a robot move cites a status, so one must have come."""
        return now_us >= self._request_due_us and (verb is Verb.RELEASE or self.report is not None)

    def _repeat_request(self, verb: Verb, now_us: int, for_us: int) -> None:
        self._pending_request, self._request_due_us, self._request_until_us = verb, now_us, now_us + for_us
        self._requested_from_id = self._id + 1

    def _granted(self) -> None:
        handed_over = self._pending_request is Verb.RELEASE and self.mode is Mode.HANDING_OVER
        self._pending_request = Verb.ARM if handed_over else None
        self._requested_from_id = self._id + 1

    def _gave_up(self) -> None:
        self._pending_request = None
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
        echo = None if self.report is None else Echo.of(self.report.stamp)
        header = RequestHeader(source=SOURCE, session=self.session, seq=self._seq, echo=echo)
        return self._message(REQUEST, encode(header), encode(Request(id=self._id, verb=verb)))

    @staticmethod
    def _message(channel: Channel, header: bytes, payload: bytes) -> Message:
        return Message(channel, SOURCE, header, payload)
