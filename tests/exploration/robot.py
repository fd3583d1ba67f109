"""The real classes of a robot's decision to move, put into any state and read back as a short tuple.

A state contains ages in ticks instead of times, so that two states with the same future are the same tuple. Whatever
is older than every limit is equally old. Without this there would be no end of states.
"""

import tempfile
from collections import OrderedDict
from enum import Enum
from functools import cache
from hashlib import sha256
from pathlib import Path

from sightline.protocol.channels import REQUEST, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.messages import STILL, AnswerHeader, Echo, Holder, Request, RequestHeader, State, Twist, Verb
from sightline.protocol.proof import NO_PROOF, Proof, tokens_of
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver import core as driver_core
from sightline.robot_side.driver.persistence import LatchWriter, StopLatch
from sightline.robot_side.safety import gate as safety_gate
from sightline.robot_side.safety import lease as safety_lease
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.robot_side.safety.validation import AcceptedCommand

TICK_US = 100_000
NOW_US = 1_000_000_000
NOW_SEQ = 10_000
"""The present, in each state: the newest frame and status have this number."""
ROBOT, EARLIER = "0000aaaa", "0000eeee"
_holder = cache(Holder)
VISION, SECOND, HUMAN = (
    _holder(source="vision", session="0000bbbb"),
    _holder(source="vision", session="0000cccc"),
    _holder(source="teleop", session="0000dddd"),
)
DRIVERS = (VISION, SECOND, HUMAN, VISION)
"""The last one is a thief: a peer that copied the session of the first."""
THIEF = 3
_SENDERS = tuple((who.source, who.session) for who in DRIVERS[:THIEF])
_PLACE = {sender: place for place, sender in enumerate(_SENDERS)}
OPERATOR = _holder(source="operator", session="0000ffff")
SPEEDS = {VISION: 0.5, SECOND: 0.5, HUMAN: -0.5}
STATES = tuple(State)
_STATE_INDEX = {state: index for index, state in enumerate(STATES)}
FRAMES = 6  # of age 0 to 5 ticks
OLD = FRAMES - 1  # an image of this age or above is stale
STATUSES = (0, 2, 21)
"""Ages of the statuses that an operator cites; the last one is too old for any request."""
LIVE = 2
PLAIN, AUTO, KEYS = range(3)
"""Configurations: an operator arms; the robot arms itself; an operator arms, and drivers prove their identity.

In the last one drivers have tokens, too.
"""
SAFETY = {"live_commands_to_arm": LIVE, "disarm_after_hold_s": 1}
HELD = 11  # ticks in HOLD until it ends
RECORD_FIELDS = 2 * FRAMES + 4
ROBOT_FIELDS = RECORD_FIELDS + 22


class Image(Enum):
    """Fingerprints of the images that the camera delivers."""

    MISSING = 0
    LAST = 1
    PREVIOUS = 2
    NEW = 3


def _config(auto_arm: bool) -> RobotConfig:
    none = PluginChoice(kind="log")
    return RobotConfig(camera=none, drive=none, safety=SafetyConfig(**SAFETY, auto_arm=auto_arm))


CONFIGS = (_config(False), _config(True), _config(False))


def _chain(secret: bytes) -> tuple[str, ...]:
    """Return the end of a chain of proofs: an old one, the last accepted one, and the next one (clause 6.6)."""
    elements = [secret]
    while len(elements) < 3:
        elements.append(sha256(elements[-1]).digest()[:16])
    return tuple(element.hex() for element in reversed(elements))


CHAINS = tuple(_chain(bytes(15) + bytes([driver])) for driver in range(len(DRIVERS)))
"""Each state has the proofs of the same three commands, since a proof counts only by those before it."""
OLD_PROOF, LAST_PROOF, NEXT_PROOF = range(3)
TOKENS = tuple(next(tokens_of(chain[OLD_PROOF])) for chain in CHAINS)
SHARING = (0, 1)
"""The drivers that may declare their token: two vision services."""
_OWNER = {proof: driver for driver, chain in enumerate(CHAINS) for proof in chain}

# All of these are pure, and the same arguments come in many states. Without this most of the time is spent in them.
driver_core.decode = cache(driver_core.decode)
driver_core.parse_twist = cache(driver_core.parse_twist)
safety_lease.continues = cache(safety_lease.continues)
safety_lease.tokens_of = cache(lambda proof: tuple(tokens_of(proof)))
safety_gate.LastRejection = cache(safety_gate.LastRejection)
safety_gate.Holder = driver_core.Holder = _holder
Holder.__eq__ = object.__eq__  # of each value there is one
driver_core.Reply = lambda **_fields: None
_ramp = safety_gate.Ramp(CONFIGS[0].safety)


@cache
def _after_ramp(speed: float, acceleration: float, goal: float, elapsed_us: int) -> tuple[Twist, float]:
    axis = _ramp._linear
    axis.speed, axis._acceleration = speed, acceleration
    return _ramp.step(_twist(goal), elapsed_us), axis._acceleration


class _Ramp(safety_gate.Ramp):
    """The ramp, which computes each of its steps once."""

    def step(self, goal: Twist, elapsed_us: int) -> Twist:
        axis = self._linear
        assert not goal.angular_rad_s, "no command of the exploration turns the robot"
        twist, axis._acceleration = _after_ramp(axis.speed, axis._acceleration, goal.linear_mps, elapsed_us)
        axis.speed = twist.linear_mps
        return twist


class _Core(driver_core.DriverCore):
    """The core, without its replies and with a ramp of short memory."""

    def __init__(self, mode: int, *, stopped: bool) -> None:
        super().__init__(CONFIGS[mode], ROBOT, stopped=stopped)
        self.gate._ramp = _Ramp(CONFIGS[mode].safety)
        self.gate._needs_proof = mode == KEYS

    def _post(self, *_reply: object) -> None:
        pass


class _Record(OrderedDict[int, int]):
    """Times of frames, images or statuses that many states share, so that only a tick may change a copy of it."""

    @classmethod
    def of(cls, times: list[tuple[int, int]]) -> "_Record":
        record = cls()
        for key, t_us in times:
            OrderedDict.__setitem__(record, key, t_us)
        return record

    def __setitem__(self, key: int, t_us: int) -> None:
        raise TypeError("the robot changed its record of frames, images or statuses between two ticks")

    popitem = pop = clear = move_to_end = __delitem__ = __setitem__


class Robot:
    """One robot whose state can be replaced."""

    def __init__(self) -> None:
        self._cores = [_Core(mode, stopped=False) for mode in range(len(CONFIGS))]
        self._after_write = latch_on_disk()
        self._starts = {(mode, disk): self._start(mode, disk) for mode in range(len(CONFIGS)) for disk in range(2)}
        self.start(0, 0)

    def _start(self, mode: int, disk: int) -> tuple[float, ...]:
        """Return the state after a start of the driver process, with motors at zero, as the guardian leaves them."""
        self._mode, self._disk, self._started, self.now_us = mode, disk, 0, NOW_US
        self.core = _Core(mode, stopped=bool(disk))
        self.gate = self.core.gate
        self.core.tick(self.now_us, None, None)
        self.gate.issued.add("status", NOW_SEQ, self.now_us)
        self._images = Image.LAST.value, Image.PREVIOUS.value
        self._record: tuple[int, ...] | None = None
        self._numbers, self._proof = _seen(False, False, False), NO_PROOF
        return self.save()

    def start(self, mode: int, disk: int) -> None:
        """Start the driver process, with what is on the disk."""
        self.load(self._starts[mode, disk])

    # --- states ----------------------------------------------------------------------------------------------------

    def save(self) -> tuple[float, ...]:
        """Return everything that decides the future of this robot."""
        gate, now_us = self.gate, self.now_us
        lease, command, sequence, axis, held = gate._lease, gate._command, gate._sequence, gate._ramp._linear, 0
        echo, arrival, commanded = -1, -1, 0.0
        if command is not None:
            echo, arrival = _age(command.echo_us, now_us), min((now_us - command.arrival_us) // TICK_US, 4)
            commanded = command.twist.linear_mps
        if gate.state is State.HOLD:
            held = min((now_us - gate._hold_since_us) // TICK_US, HELD)
        newest = NOW_SEQ + (now_us - NOW_US) // TICK_US
        return (
            *(self._record or self._save_record()),
            self._mode,
            self._disk,
            min(self._started, STATUSES[1]),
            _STATE_INDEX[gate.state],
            *[key in sequence._drivers or key in sequence._others for key in _SENDERS],
            sum((TOKENS[driver] in lease._tokens) << driver for driver in SHARING),
            sum((DRIVERS[driver] in lease._fenced) << driver for driver in SHARING),
            bool(lease.token),
            self._holder(),
            max(0, (lease.expires_us - now_us) // TICK_US),
            min(gate._live_commands, LIVE),
            _denied(newest - gate.issued._denied_seq),
            gate.arms_itself,
            held,
            echo,
            arrival,
            commanded,
            gate.applied.linear_mps,
            axis.speed,
            axis._acceleration,
        )

    def _holder(self) -> int:
        """Return the driver of the lease, which may have ended, or -1. A thief differs from the first by its proofs."""
        lease = self.gate._lease
        if lease.holder is None:
            return -1
        place = _PLACE[lease.holder.source, lease.holder.session]
        return place if lease.proof.proof is None else _OWNER[lease.proof.proof]

    def holder(self) -> int:
        """Return the driver that holds the lease, or -1."""
        return -1 if self.gate.holder(self.now_us) is None else self._holder()

    def _save_record(self) -> tuple[int, ...]:
        """Return the frames and images."""
        now_us, pictures, frames = self.now_us, self.gate.pictures, self.gate.issued._times.get("frame", ())
        shown, first = pictures._shown_us, pictures._first_us
        newest = NOW_SEQ + (now_us - NOW_US) // TICK_US
        return (
            *[newest - age in frames for age in range(FRAMES)],
            *[_age(shown.get(now_us - age * TICK_US), now_us) for age in range(FRAMES)],
            _age(first.get(self._images[0]), now_us),
            _age(first.get(self._images[1]), now_us),
            min((pictures._newest_us - pictures._changed_us) // TICK_US, OLD),
            _age(pictures._newest_us, now_us),
        )

    def load(self, state: tuple[float, ...]) -> None:
        """Put the robot into a state of `save`."""
        self._record = saved = state[:RECORD_FIELDS]
        (
            self._mode, self._disk, self._started, state_index, *seen, present, fenced, bound, holder, left, live,
            denied, arms_itself, held, echo, arrival, commanded, applied, speed, acceleration,
        ) = state[RECORD_FIELDS:]  # fmt: skip
        self.now_us, self._images = NOW_US, (1, 2)
        self.core = core = self._cores[self._mode]
        self.gate = gate = core.gate
        record, pictures, lease, axis = gate.issued, gate.pictures, gate._lease, gate._ramp._linear
        frames, pictures._shown_us, pictures._first_us, pictures._newest_us, pictures._changed_us = _load_record(saved)
        record._times = {"frame": frames, "status": _statuses(self._started)}
        record._denied_seq = NOW_SEQ - denied
        self._numbers = _seen(*seen)
        self._proof = Proof(CHAINS[holder][LAST_PROOF]) if self._mode == KEYS and holder >= 0 else NO_PROOF
        self._forget()
        lease.holder = None if holder < 0 else DRIVERS[holder]
        lease.expires_us = NOW_US + left * TICK_US
        lease._tokens = OrderedDict((TOKENS[driver], None) for driver in SHARING if present >> driver & 1)
        lease._fenced = OrderedDict((DRIVERS[driver], None) for driver in SHARING if fenced >> driver & 1)
        lease._known.clear()  # here each proof shows its token
        lease._ended.clear()  # without it a driver that has just left may drive, so nothing is missed
        lease.token = TOKENS[holder] if bound else ""
        gate.state = STATES[state_index]
        gate._live_commands = live
        gate.arms_itself = arms_itself
        gate._hold_since_us = NOW_US - held * TICK_US
        gate._command = None if echo < 0 else _command(commanded, echo, arrival)
        gate._last_step_us = NOW_US
        gate.applied = _twist(applied)
        axis.speed, axis._acceleration = speed, acceleration

    def _forget(self) -> None:
        """Forget the number and the proof of a message before, that led to the same state and was not undone."""
        sequence = self.gate._sequence
        sequence._drivers, sequence._others = self._numbers.copy(), OrderedDict()
        self.gate._lease.proof = self._proof

    # --- what happens ----------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Kill the driver process, and start it with what is on the disk."""
        self.start(self._mode, self._disk)

    def tick(self, image: Image) -> None:
        """Let one tick pass; the robot publishes a frame and a status."""
        record, pictures = self.gate.issued, self.gate.pictures
        record._times = {channel: OrderedDict(times) for channel, times in record._times.items()}
        pictures._shown_us, pictures._first_us = OrderedDict(pictures._shown_us), OrderedDict(pictures._first_us)
        self._record = None
        self.now_us += TICK_US
        if image is not Image.MISSING:
            self.core.on_issued(NOW_SEQ + 1, self.now_us, image.value)
            if image is not Image.LAST:
                self._images = (image.value, 1)
        self.core.tick(self.now_us, None, None)
        record.add("status", NOW_SEQ + 1, self.now_us)
        self._started += 1

    def twist(
        self, who: Holder, age: int, seq: int, session: str = ROBOT, shift_us: int = 0, proof: str | None = None
    ) -> str:
        """Deliver a command; return the reason of its rejection, or an empty string."""
        gate = self.gate
        self._forget()
        accepted, gate.last_rejection = gate.accepted, None
        self.core.on_twist(_twist_message(who, age, seq, session, shift_us, proof), NOW_US)
        if gate.accepted > accepted:
            return ""
        assert gate.last_rejection is not None
        return gate.last_rejection.reason

    def request(self, who: Holder, verb: Verb, age: int, proof: str | None = None) -> str:
        """Deliver a request; return the reason of its rejection, or an empty string."""
        gate = self.gate
        self._forget()
        gate.last_rejection = None
        self.core.on_request(_request_message(who, verb, age, proof), NOW_US)
        return gate.last_rejection.reason if gate.last_rejection else ""

    def token(self, driver: int, is_present: bool) -> None:
        """Deliver the token of a driver, or its end."""
        self._forget()
        self.core.on_token(TOKENS[driver], is_present, NOW_US)

    def fault(self) -> None:
        """Report a failure of the drive."""
        self.gate.fault("broken")

    def write_latch(self) -> None:
        """Let the disk store what the driver process wants there."""
        self._disk = self._after_write[self._disk, self.gate.state is State.STOPPED]


def _denied(age: int) -> int:
    """Return the age of the newest denied status; the cited old one is denied until a start, once any was."""
    return age if age <= STATUSES[1] else STATUSES[1] + 1 if age <= STATUSES[2] else STATUSES[2] + 1


def _age(t_us: int | None, now_us: int) -> int:
    return -1 if t_us is None else min((now_us - t_us) // TICK_US, OLD)


@cache
def _load_record(saved: tuple[int, ...]) -> tuple[_Record, _Record, _Record, int, int]:
    """Return the times of frames, images and first images, and those of the newest image and change."""
    issued, shown, (last, previous, unchanged, newest) = saved[:FRAMES], saved[FRAMES:-4], saved[-4:]
    ages = list(reversed(range(FRAMES)))
    newest_us = NOW_US - newest * TICK_US
    return (
        _Record.of([(NOW_SEQ - age, NOW_US - age * TICK_US) for age in ages if issued[age]]),
        _Record.of([(NOW_US - age * TICK_US, NOW_US - shown[age] * TICK_US) for age in ages if shown[age] >= 0]),
        _Record.of([
            (image.value, NOW_US - age * TICK_US)
            for image, age in ((Image.PREVIOUS, previous), (Image.LAST, last))
            if age >= 0
        ]),
        newest_us,
        newest_us - unchanged * TICK_US,
    )


@cache
def _statuses(started: int) -> _Record:
    ages = [STATUSES[2], *reversed(range(started + 1))]
    return _Record.of([(NOW_SEQ - age, NOW_US - age * TICK_US) for age in ages])


@cache
def _seen(*seen: bool) -> OrderedDict[tuple[str, str], tuple[int, int]]:
    return OrderedDict((key, (0, NOW_US)) for key, was in zip(_SENDERS, seen, strict=True) if was)


@cache
def _command(speed: float, echo: int, arrival: int) -> AcceptedCommand:
    return AcceptedCommand(_twist(speed), NOW_US - echo * TICK_US, NOW_US - arrival * TICK_US, 300_000, True)


@cache
def _twist(speed: float) -> Twist:
    return Twist(linear_mps=speed, angular_rad_s=0.0) if speed else STILL


@cache
def _twist_message(who: Holder, age: int, seq: int, session: str, shift_us: int, proof: str | None) -> Message:
    echo = Echo(channel="frame", session=session, seq=NOW_SEQ - age, t_us=NOW_US - age * TICK_US + shift_us)
    header = AnswerHeader(source=who.source, session=who.session, seq=seq, echo=echo, proof=proof)
    return Message(TWIST, who.source, encode(header), f"{SPEEDS[who]}|0".encode())


@cache
def _request_message(who: Holder, verb: Verb, age: int, proof: str | None) -> Message:
    echo = Echo(channel="status", session=ROBOT, seq=NOW_SEQ - age, t_us=NOW_US - age * TICK_US)
    header = RequestHeader(source=who.source, session=who.session, seq=1, echo=echo, proof=proof)
    return Message(REQUEST, who.source, encode(header), encode(Request(id=1, verb=verb)))


def latch_on_disk() -> dict[tuple[int, bool], int]:
    """Return what is on disk after a write, by what was there and what is wanted, as the real latch leaves it."""
    after = {}
    for before in (False, True):
        for wanted in (False, True):
            with tempfile.TemporaryDirectory() as folder:
                StopLatch(Path(folder), "r1").write(before)
                writer = LatchWriter(StopLatch(Path(folder), "r1"))
                writer.want(wanted)
                writer.close()
                after[int(before), wanted] = int(StopLatch(Path(folder), "r1").is_set())
    return after
