"""The logic of teleop: held keys, speeds, handover to the vision service, and the messages to the robot. Pure."""

import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final

from sightline.operator_side.client.requests import StatusReport, read_report
from sightline.protocol.channels import ACK, REPLY, REQUEST, TWIST, Channel
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError, RejectReason, WireError
from sightline.protocol.messages import (
    STILL,
    AnswerHeader,
    Echo,
    FrameHeader,
    LeaseHolder,
    Reply,
    Request,
    RequestHeader,
    State,
    Status,
    Twist,
    Verb,
)
from sightline.protocol.proof import NO_PROOF, Proof, ProofChain
from sightline.protocol.text import format_twist
from sightline.protocol.transports.link import Message

_STEP: Final = 1.1
"""Factor of a speed change: a key press changes a speed by 10 %."""
_LEAST_MPS: Final = 0.02
_LEAST_RAD_S: Final = 0.1
_RAMP_MPS2: Final = 0.8
_RAMP_RAD_S2: Final = 5.0
_FIRST_STEP_US: Final = 30_000
"""Duration of the first ramp step, so that a press moves the robot with the first command."""
_LONGEST_STEP_US: Final = 100_000


@dataclass(slots=True)
class Speeds:
    """The operator's maximum speeds, within the limits of the robot."""

    linear_mps: float
    angular_rad_s: float
    most_mps: float = 3.0
    most_rad_s: float = 10.0

    def change(self, linear: int, angular: int) -> None:
        """Raise (1), lower (-1) or leave (0) each speed by 10 %."""
        self.linear_mps *= _STEP**linear
        self.angular_rad_s *= _STEP**angular
        self._keep()

    def limit(self, status: Status) -> None:
        """Apply the limits of the robot's status. A zero leaves the old limit."""
        self.most_mps = status.max_linear_mps or self.most_mps
        self.most_rad_s = status.max_angular_rad_s or self.most_rad_s
        self._keep()

    def _keep(self) -> None:
        self.linear_mps = max(min(_LEAST_MPS, self.most_mps), min(self.most_mps, self.linear_mps))
        self.angular_rad_s = max(min(_LEAST_RAD_S, self.most_rad_s), min(self.most_rad_s, self.angular_rad_s))


class SpeedUp:
    """Moves the twist to its goal: up by a ramp, down immediately, so that a release is zero in the next command."""

    def __init__(self) -> None:
        self.twist = STILL
        self._stepped_us: int | None = None

    def step(self, goal: Twist, now_us: int) -> Twist:
        """Return the twist to command now."""
        elapsed_us = _FIRST_STEP_US if self._stepped_us is None else min(_LONGEST_STEP_US, now_us - self._stepped_us)
        self._stepped_us = now_us
        self.twist = Twist(
            linear_mps=_towards(self.twist.linear_mps, goal.linear_mps, _RAMP_MPS2 * elapsed_us / 1e6),
            angular_rad_s=_towards(self.twist.angular_rad_s, goal.angular_rad_s, _RAMP_RAD_S2 * elapsed_us / 1e6),
        )
        return self.twist


def _towards(speed: float, goal: float, change: float) -> float:
    """Return `goal` if slower in the same direction, else a step of `change` toward it. A reversal starts at 0."""
    start = speed if speed * goal > 0 else 0.0
    if abs(goal) <= abs(start):
        return goal
    return min(goal, start + change) if goal > 0 else max(goal, start - change)


# --- keys --------------------------------------------------------------------------------------------------------
#
# A terminal reports presses and repeats, but no releases. So a key counts as held for a little longer than the interval
# of its repeats, which is learned. Before the first repeat, it counts as held for a little longer than the delay.

_ARROWS: Final = {"\x1b[A": (1, 0), "\x1b[B": (-1, 0), "\x1b[D": (0, 1), "\x1b[C": (0, -1)}
_BOTH_SPEEDS: Final = {"+": (1, 1), "=": (1, 1), "-": (-1, -1)}
_SPACE: Final = " "
SWITCH: Final = "\t"
QUIT: Final = "q"
STOP_KEYS: Final = ("\n", "\r")


@dataclass(frozen=True, slots=True)
class Layout:
    """The keys of one layout. Tab, Q, Space, Enter, the arrows, + and - are in all layouts.

    `moves` maps a key to its share of (linear, angular) speed. Back and left turns clockwise, as a car does.
    `speeds` maps a key to a change of (linear, angular) speed, up (1) or down (-1).
    `help` is the help line in the terminal.
    """

    moves: Mapping[str, tuple[int, int]]
    speeds: Mapping[str, tuple[int, int]]
    stops: tuple[str, ...]
    help: str


_COMMON_HELP: Final = """\
  Tab  switch between manual and vision         + -  both speeds 10 % up, down
  q    quit; the robot stops                    {linear}  speed    {angular}  turn rate
  Enter  STOP: it stays at zero until `sightline reset`
The first press arms the robot: make sure that it may move.
"""

WASD: Final = Layout(
    moves={"w": (1, 0), "s": (-1, 0), "a": (0, 1), "d": (0, -1), **_ARROWS},
    speeds={"r": (1, 0), "f": (-1, 0), "t": (0, 1), "g": (0, -1), **_BOTH_SPEEDS},
    stops=(_SPACE,),
    help="""\
        w                  hold a key to drive, release it to stop
     a  s  d               w s  forward, back    a d  turn left, right
  or the arrow keys        Space  stop
"""
    + _COMMON_HELP.format(linear="r f", angular="t g"),
)
LEGACY: Final = Layout(
    moves={
        "u": (1, 1), "i": (1, 0), "o": (1, -1),
        "j": (0, 1), "l": (0, -1),
        "m": (-1, -1), ",": (-1, 0), ".": (-1, 1), **_ARROWS,
    },
    speeds={"w": (1, 0), "x": (-1, 0), "e": (0, 1), "c": (0, -1), **_BOTH_SPEEDS},
    stops=("k", _SPACE, "\x1b[E"),
    help="""\
     u  i  o               hold a key to drive, release it to stop
     j  k  l               i ,  forward, back    j l  turn    u o m .  curves
     m  ,  .  or arrows    k or Space  stop
"""
    + _COMMON_HELP.format(linear="w x", angular="e c"),
)  # fmt: skip
LAYOUTS: Final = {"wasd": WASD, "legacy": LEGACY}


def layout_of(name: str) -> Layout:
    """Return the layout of `--keys`. Raises ConfigError for an unknown layout."""
    if name not in LAYOUTS:
        raise ConfigError(f"unknown --keys '{name}'; expected {' or '.join(LAYOUTS)}")
    return LAYOUTS[name]


MOST_AT_ONCE: Final = 4
"""Largest number of keys in one read from a real key press: at 30 repeats a second, those of 130 ms."""

_FIRST_DELAY_US: Final = 500_000
"""Delay from a press to its first repeat on most desktops, until it is learned."""
_SLACK: Final = 1.3
_LONGEST_FIRST_US: Final = 900_000
_FIRST_INTERVAL_US: Final = 35_000
_INTERVALS: Final = 3
_SHORTEST_HOLD_US: Final = 80_000
LONGEST_HOLD_US: Final = 120_000
"""Longest hold after a repeat. With the command period, a release is a zero command within 150 ms."""
_REPEATS_WITHIN_US: Final = 150_000
"""Interval after which the same key is a new press."""
_FORGOTTEN_US: Final = 1_000_000
FRESH_US: Final = 300_000
"""Pause after which a press is a new decision to drive. Only such a press arms a robot."""


def split_keys(text: str) -> list[str]:
    """Split text from a terminal into keys. An arrow has three characters. Unknown sequences become single keys."""
    keys: list[str] = []
    at = 0
    while at < len(text):
        length = 3 if text[at : at + 2] in ("\x1b[", "\x1bO") else 1
        keys.append(text[at : at + length].replace("\x1bO", "\x1b["))
        at += length
    return keys


@dataclass(slots=True)
class Hold:
    """The held movement key, derived from its repeats."""

    key: str = ""
    delay_us: int = _FIRST_DELAY_US
    interval_us: int = _FIRST_INTERVAL_US
    _presses: int = 0
    _first_gap_us: int = 0
    _last_us: int | None = None

    def press(self, key: str, now_us: int) -> bool:
        """Process a pressed or repeated movement key. Returns True for a fresh press, after a pause."""
        gap_us = _FORGOTTEN_US if self._last_us is None else now_us - self._last_us
        if gap_us == 0 and key == self.key:
            return False  # several repeats in one read
        self._last_us = now_us
        if self._is_repeat(key, gap_us):
            self._learn(gap_us)
            self._presses += 1
            return False
        self.key, self._presses = key, 1
        return gap_us >= FRESH_US

    def _is_repeat(self, key: str, gap_us: int) -> bool:
        """Return True for a repeat: the first comes after the terminal's delay, the others after short intervals."""
        return key == self.key and gap_us < (_FORGOTTEN_US if self._presses == 1 else _REPEATS_WITHIN_US)

    def _learn(self, gap_us: int) -> None:
        """Learn the delay when a quick repeat follows it. Single presses are not used."""
        if self._presses == 1:
            self._first_gap_us = gap_us
            return
        if self._presses == 2 and self._first_gap_us > _REPEATS_WITHIN_US:
            self.delay_us = self._first_gap_us
        self.interval_us += (gap_us - self.interval_us) // 4

    def release(self) -> None:
        """Forget the held key."""
        self.key, self._presses = "", 0

    def miss(self, now_us: int) -> None:
        """Process late keys: no key is held, and the next press is not fresh."""
        self.release()
        self._last_us = now_us

    def is_held(self, now_us: int) -> bool:
        """Return True if the key counts as held."""
        return bool(self.key) and self._last_us is not None and now_us - self._last_us <= self.patience_us

    @property
    def patience_us(self) -> int:
        """Return the time after the last press or repeat for which the key counts as held."""
        if self._presses <= 1:
            return min(_LONGEST_FIRST_US, round(self.delay_us * _SLACK))
        return max(_SHORTEST_HOLD_US, min(LONGEST_HOLD_US, _INTERVALS * self.interval_us))


# --- driving -----------------------------------------------------------------------------------------------------
#
# Every command cites the newest received frame, so that the robot measures the age of the link as for any driver. An
# operator without pressed keys sends zeros and holds the lease. An operator that is gone loses it, and the robot stops.


SOURCE: Final = "teleop"
PERIOD_US: Final = 30_000
"""Time between commands, about one per frame. A change is sent immediately."""
_REPEAT_AFTER_US: Final = 60_000
_ARM_FOR_US: Final = 2_000_000
"""Time for which a press requests arming. Five valid commands and a request need a fraction of it."""
_RETRIED: Final = (RejectReason.NOT_ALLOWED, RejectReason.STALE, RejectReason.OTHER_SESSION, RejectReason.UNKNOWN_FRAME,
                   RejectReason.NOT_PROVEN)
"""Rejections that end by themselves: missing valid commands, a status from before the return of link or robot, or a
command that overtook the request."""
_HAND_OVER_FOR_US: Final = 5_000_000
"""Time after which no vision service takes over."""


class Mode(Enum):
    """The driver that the operator has selected."""

    WATCHING = "watching"
    DRIVING = "you drive"
    HANDING_OVER = "handing over"


class Teleop:
    """The session of one operator with one robot."""

    def __init__(self, session: str, speeds: Speeds, layout: Layout = WASD) -> None:
        self.session = session
        self._own = LeaseHolder.of(SOURCE, session)
        self._proofs = ProofChain(secrets.token_bytes)
        self.speeds = speeds
        self.layout = layout
        self.mode = Mode.WATCHING
        self.report: StatusReport | None = None
        self.received_us = 0
        """Time of the last status, valid or invalid."""
        self.note = ""
        """A note for the operator, shown next to the robot's status."""
        self.wants_to_quit = False
        self.is_stopping = False
        """True after STOP was pressed, until it is proven."""
        self._hold = Hold()
        self._ignored_until_us = 0
        self._stick: tuple[float, float] | None = None
        self._stick_waits = False
        """True if a stop or a handover came while the dead man's button was held. It must be released first."""
        self._speed_up = SpeedUp()
        self._echo: Echo | None = None
        self._unanswered = False
        self._seq = self._id = 0
        self._due_us = 0
        self._sent = STILL
        self._leaving = self._has_released = False
        self._pending_request: Verb | None = None
        self._request_due_us = self._request_until_us = self._requested_from_id = 0

    # --- inputs --------------------------------------------------------------------------------------------------

    def on_keys(self, text: str, now_us: int) -> None:
        """Process the keys of one read from the terminal.

        Many keys at once come from a stalled link or a paste, and do not show the currently held key. Of these keys,
        and of keys shortly after, only stop keys count.
        """
        keys = split_keys(text)
        if len(keys) > MOST_AT_ONCE:
            self._ignored_until_us = now_us + FRESH_US
        if now_us < self._ignored_until_us:
            keys = [key for key in keys if key in (*self.layout.stops, *STOP_KEYS)]
            self._hold.miss(now_us)
        for key in keys:
            if key in self.layout.moves:
                self._drive(self._hold.press(key, now_us), now_us)
            elif key in self.layout.stops:
                self.stop()
            elif key in STOP_KEYS:
                self.latch_stop(now_us)
            elif key == SWITCH:
                self.switch(now_us)
            elif key == QUIT:
                self.wants_to_quit = True
            elif key in self.layout.speeds:
                self.speeds.change(*self.layout.speeds[key])

    def on_stick(self, shares: tuple[float, float] | None, now_us: int) -> None:
        """Process a gamepad's shares (-1..1) of both speeds; None if its dead man's button is not held."""
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
    def has_frame(self) -> bool:
        """Return True if a frame has arrived, which a command must cite."""
        return self._echo is not None

    def on_frame(self, message: Message) -> None:
        """Store the newest frame, which commands cite."""
        try:
            frame = decode(FrameHeader, message.header)
        except WireError:
            return
        self._echo = Echo.of(frame)
        self._unanswered = True

    def on_status(self, message: Message, now_us: int) -> None:
        """Process the newest status."""
        self.received_us = now_us
        try:
            self.report = read_report(message)
        except WireError as error:
            self.note = f"invalid status from the robot: {error.detail}"
            return
        self.speeds.limit(self.report.status)
        if self.report.status.state is State.STOPPED and self.report.status.applied == (0.0, 0.0):
            self.on_stopped()
        if self.mode is Mode.HANDING_OVER and self._pending_request is not Verb.RELEASE and self._other_drives():
            self.mode, self._pending_request, self.note = Mode.WATCHING, None, ""

    def on_reply(self, message: Message) -> None:
        """Process the reply to a request."""
        try:
            reply = decode(Reply, message.payload, REPLY.max_payload_bytes)
        except WireError:
            return
        if reply.to != self._own.digest or reply.id < self._requested_from_id:
            return
        if self._leaving:
            self._has_released |= reply.ok
        elif self._pending_request is None:
            return
        elif reply.ok:
            self._granted()
        elif not reply.detail.startswith(_RETRIED):
            self.note = f"{self._pending_request} rejected: {reply.detail}"
            self._pending_request = None

    # --- actions of the operator ---------------------------------------------------------------------------------

    def stop(self) -> None:
        """Take over and stand still. The robot stays armed, and this operator is the driver."""
        self._let_go()
        self.mode, self._pending_request, self._due_us = Mode.DRIVING, None, 0

    def latch_stop(self, now_us: int) -> None:
        """Send STOP until it is proven. The shell also sends it by datagrams."""
        self._let_go()
        self.mode, self.note, self.is_stopping = Mode.WATCHING, "STOP is not confirmed, repeating", True
        self._pending_request, self._request_due_us = None, now_us

    def on_stopped(self) -> None:
        """End the repetition of STOP, because the robot is STOPPED with its wheels at zero."""
        if self.is_stopping:
            self.is_stopping, self.note = False, ""

    def switch(self, now_us: int) -> None:
        """Hand over to the vision service, or take over from it and stand still."""
        is_manual = self.mode is Mode.DRIVING or (self.mode is Mode.WATCHING and not self._other_drives())
        if is_manual:
            self.hand_over(now_us)
        else:
            self.stop()

    def hand_over(self, now_us: int) -> None:
        """Release the robot and arm it for the vision service. This is the only way back to autonomy."""
        self._let_go()
        self.mode, self.note = Mode.HANDING_OVER, ""
        self._repeat_request(Verb.RELEASE, now_us, _HAND_OVER_FOR_US)

    def _let_go(self) -> None:
        self._hold.release()
        self._stick_waits |= self._stick is not None
        self._stick = None

    @property
    def has_left(self) -> bool:
        """Return True if the operator may leave: the lease is released, and no STOP is unproven."""
        return self._has_released and not self.is_stopping

    def leave(self) -> Iterator[Message]:
        """Yield the last messages, until `has_left`: STOP while it is not proven, zero, the release of the lease.

        While another driver holds the lease, only STOP.
        """
        if self.is_stopping:
            yield self._request(Verb.STOP)
        if self.mode is Mode.WATCHING:
            self._has_released = True
            return
        if self.mode is Mode.DRIVING and self._echo is not None:
            yield self._command(STILL, self._echo)
        if not self._leaving:
            self._leaving, self.mode = True, Mode.HANDING_OVER  # only one zero, because a second would take the lease
            self._requested_from_id = self._id + 1
        yield self._request(Verb.RELEASE)

    def _drive(self, fresh: bool, now_us: int) -> None:
        """Take over for a movement key. A fresh press also arms."""
        took_over = self.mode is not Mode.DRIVING
        self.mode = Mode.DRIVING
        if fresh or took_over:
            self.note = ""
            # Also if the status shows an armed robot, because it may precede a release.
            self._repeat_request(Verb.ARM, now_us, _ARM_FOR_US)
        if took_over:
            self._speed_up, self._sent = SpeedUp(), STILL
        if self._sent == STILL:
            self._due_us = 0

    # --- outputs -------------------------------------------------------------------------------------------------

    def messages(self, now_us: int) -> Iterator[Message]:
        """Yield the messages to send now. Call it every few milliseconds and after every input."""
        if self.is_stopping and now_us >= self._request_due_us:
            self._request_due_us = now_us + _REPEAT_AFTER_US
            yield self._request(Verb.STOP)
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
        """Return the twist of the held key or stick at the current speeds."""
        if self.mode is not Mode.DRIVING:
            return STILL
        held = self.layout.moves[self._hold.key] if self._hold.is_held(now_us) else (0, 0)
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
        """Return True if a request may be sent again. One that permits motion needs a received status to cite."""
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
            self.mode, self.note = Mode.WATCHING, "no vision service took over; run `sightline vision`"
        else:
            self.note = "it could not be armed; press again"

    def _other_drives(self) -> bool:
        status = self.report.status if self.report else None
        armed = status is not None and status.state in (State.ACTIVE, State.DEGRADED)
        return armed and status is not None and status.holder is not None and status.holder != self._own

    # --- messages ------------------------------------------------------------------------------------------------

    def _answer(self, echo: Echo, proof: Proof = NO_PROOF) -> AnswerHeader:
        self._seq += 1
        return AnswerHeader(source=SOURCE, session=self.session, seq=self._seq, echo=echo, proof=proof.proof,
                            next_proof=proof.next_proof)

    def _command(self, twist: Twist, echo: Echo) -> Message:
        return self._message(TWIST, encode(self._answer(echo, self._proofs.next())), format_twist(twist))

    def _request(self, verb: Verb) -> Message:
        self._id += 1
        self._seq += 1
        echo = None if self.report is None else Echo.of(self.report.stamp)
        proof = self._proofs.next()
        header = RequestHeader(source=SOURCE, session=self.session, seq=self._seq, echo=echo, proof=proof.proof,
                               next_proof=proof.next_proof)
        return self._message(REQUEST, encode(header), encode(Request(id=self._id, verb=verb)))

    @staticmethod
    def _message(channel: Channel, header: bytes, payload: bytes) -> Message:
        return Message(channel, SOURCE, header, payload)
