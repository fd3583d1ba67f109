"""The real classes of a robot's decision to move, put into any state and read back as a short tuple.

A state contains ages in ticks instead of times, so that two states with the same future are the same tuple. Whatever
is older than every limit is equally old. Without this there would be no end of states.
"""

import tempfile
from collections import OrderedDict
from enum import Enum
from functools import cache
from pathlib import Path

from sightline.protocol.channels import REQUEST, TWIST
from sightline.protocol.codec import encode
from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import STILL, AnswerHeader, Echo, Holder, Request, RequestHeader, State, Twist, Verb
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver import core as driver_core
from sightline.robot_side.driver.persistence import LatchWriter, StopLatch
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.robot_side.safety.validation import AcceptedCommand

TICK_US = 100_000
NOW_US = 1_000_000_000
NOW_SEQ = 10_000
"""The present, in each state: the newest frame and status have this number."""
ROBOT, EARLIER = "0000aaaa", "0000eeee"
VISION, SECOND, HUMAN = (
    Holder(source="vision", session="0000bbbb"),
    Holder(source="vision", session="0000cccc"),
    Holder(source="teleop", session="0000dddd"),
)
DRIVERS = (VISION, SECOND, HUMAN)
_SENDERS = tuple((who.source, who.session) for who in DRIVERS)
OPERATOR = Holder(source="operator", session="0000ffff")
SPEEDS = {VISION: 0.5, SECOND: 0.5, HUMAN: -0.5}
STATES = tuple(State)
FRAMES = 6  # of age 0 to 5 ticks
OLD = FRAMES - 1  # an image of this age or above is stale
STATUSES = (0, 2, 21)
"""Ages of the statuses that an operator cites; the last one is too old for any request."""
LIVE = 2
SAFETY = {"live_commands_to_arm": LIVE, "disarm_after_hold_s": 1}
ROBOT_FIELDS = 35
HELD = 11  # ticks in HOLD until it ends


# Both are pure, and each message here arrives in many states.
driver_core.decode = cache(driver_core.decode)
driver_core.parse_twist = cache(driver_core.parse_twist)


class Image(Enum):
    """What the camera delivers: fingerprints of the image."""

    MISSING = 0
    LAST = 1
    PREVIOUS = 2
    NEW = 3


def _config(auto_arm: bool) -> RobotConfig:
    return RobotConfig(
        camera=PluginChoice(kind="log"), drive=PluginChoice(kind="log"), safety=SafetyConfig(**SAFETY, auto_arm=auto_arm)
    )


CONFIGS = (_config(False), _config(True))


class Robot:
    """One robot whose state can be replaced."""

    def __init__(self) -> None:
        self._cores = [driver_core.DriverCore(config, ROBOT) for config in CONFIGS]
        self._after_write = latch_on_disk()
        self._auto = self._disk = 0
        self.now_us = NOW_US
        self.start(0, 0)

    def start(self, auto: int, disk: int) -> None:
        """Start the driver process again, with motors at zero, as the guardian leaves them."""
        self._auto, self._disk = auto, disk
        self.core = self._cores[auto] = driver_core.DriverCore(CONFIGS[auto], ROBOT, stopped=bool(disk))
        self.gate = self.core.gate
        self.core.tick(self.now_us, None, None)
        self.gate.issued.add("status", NOW_SEQ, self.now_us)
        self._started, self._images = 0, (Image.LAST.value, Image.PREVIOUS.value)

    # --- states ----------------------------------------------------------------------------------------------------

    def save(self) -> tuple[float, ...]:
        """Return everything that decides the future of this robot."""
        gate, now_us = self.gate, self.now_us
        record, pictures, lease, command, sequence = gate.issued, gate.pictures, gate._lease, gate._command, gate._sequence
        frames, shown, first = record._times.get("frame", ()), pictures._shown_us, pictures._first_us
        newest = NOW_SEQ + (now_us - NOW_US) // TICK_US
        return (
            self._auto,
            self._disk,
            min(self._started, STATUSES[1]),
            STATES.index(gate.state),
            *[newest - age in frames for age in range(FRAMES)],
            *[_age(shown.get(now_us - age * TICK_US), now_us) for age in range(FRAMES)],
            _age(first.get(self._images[0]), now_us),
            _age(first.get(self._images[1]), now_us),
            min((pictures._newest_us - pictures._changed_us) // TICK_US, OLD),
            _age(pictures._newest_us, now_us),
            *[key in sequence._drivers or key in sequence._others for key in _SENDERS],
            -1 if lease.holder is None else DRIVERS.index(lease.holder),
            max(0, (lease.expires_us - now_us) // TICK_US),
            min(gate._live_commands, LIVE),
            min(newest - record._denied_seq, STATUSES[1] + 1),
            gate.arms_itself,
            min((now_us - gate._hold_since_us) // TICK_US, HELD) if gate.state is State.HOLD else 0,
            -1 if command is None else _age(command.echo_us, now_us),
            -1 if command is None else min((now_us - command.arrival_us) // TICK_US, 4),
            0.0 if command is None else command.twist.linear_mps,
            gate.applied.linear_mps,
            gate._ramp._linear.speed,
            gate._ramp._linear._acceleration,
        )

    def load(self, state: tuple[float, ...]) -> None:
        """Put the robot into a state of `save`."""
        self._auto, self._disk, self._started, state_index = state[:4]
        (
            last, previous, unchanged, newest, seen_vision, seen_second, seen_human, holder, left, live, denied, arms_itself,
            held, echo, arrival, commanded, applied, speed, acceleration,
        ) = state[4 + 2 * FRAMES:]  # fmt: skip
        self.now_us, self._images = NOW_US, (1, 2)
        self.core = core = self._cores[self._auto]
        self.gate = gate = core.gate
        core._outbox = []
        record, pictures, lease = gate.issued, gate.pictures, gate._lease
        record._times = {
            "frame": _frames(state[4 : 4 + FRAMES]).copy(),
            "status": _statuses(self._started).copy(),
        }
        record._denied_seq = NOW_SEQ - denied
        pictures._shown_us = _shown(state[4 + FRAMES : 4 + 2 * FRAMES]).copy()
        pictures._first_us = _first(last, previous).copy()
        pictures._newest_us = NOW_US - newest * TICK_US
        pictures._changed_us = pictures._newest_us - unchanged * TICK_US
        gate._sequence._drivers = _seen(seen_vision, seen_second, seen_human).copy()
        gate._sequence._others = OrderedDict()
        lease.holder = None if holder < 0 else DRIVERS[holder]
        lease.expires_us = NOW_US + left * TICK_US
        gate.state = STATES[state_index]
        gate._live_commands = live
        gate.arms_itself = arms_itself
        gate._hold_since_us = NOW_US - held * TICK_US
        gate._command = None if echo < 0 else _command(commanded, echo, arrival)
        gate._last_step_us = NOW_US
        gate.applied = _twist(applied)
        ramp = gate._ramp._linear
        ramp.speed, ramp._acceleration = speed, acceleration
        ramp = gate._ramp._angular
        ramp.speed = ramp._acceleration = 0.0

    # --- what happens ----------------------------------------------------------------------------------------------

    def restart(self) -> None:
        """Kill the driver process, and start it with what is on the disk."""
        self.start(self._auto, self._disk)

    def tick(self, image: Image) -> None:
        """Let one tick pass; the robot publishes a frame and a status."""
        self.now_us += TICK_US
        if image is not Image.MISSING:
            self.core.on_issued(NOW_SEQ + 1, self.now_us, image.value)
            if image is not Image.LAST:
                self._images = (image.value, 1)
        self.core.tick(self.now_us, None, None)
        self.gate.issued.add("status", NOW_SEQ + 1, self.now_us)
        self._started += 1

    def twist(self, who: Holder, age: int, seq: int, session: str = ROBOT, shift_us: int = 0) -> str:
        """Deliver a command; return the reason of its rejection, or an empty string."""
        gate = self.gate
        accepted, gate.last_rejection = gate.accepted, None
        self.core.on_twist(_twist_message(who, age, seq, session, shift_us), NOW_US)
        if gate.accepted > accepted:
            return ""
        assert gate.last_rejection is not None
        return gate.last_rejection.reason

    def request(self, who: Holder, verb: Verb, age: int) -> str:
        """Deliver a request; return the reason of its rejection, or an empty string."""
        gate = self.gate
        gate.last_rejection = None
        self.core.on_request(_request_message(who, verb, age), NOW_US)
        return gate.last_rejection.reason if gate.last_rejection else ""

    def fault(self) -> None:
        """Report a failure of the drive."""
        self.gate.fault("broken")

    def write_latch(self) -> None:
        """Let the disk store what the driver process wants there."""
        self._disk = self._after_write[self._disk, self.gate.state is State.STOPPED]


def _age(t_us: int | None, now_us: int) -> int:
    return -1 if t_us is None else min((now_us - t_us) // TICK_US, OLD)


@cache
def _frames(issued: tuple[bool, ...]) -> OrderedDict[int, int]:
    ages = [age for age in reversed(range(FRAMES)) if issued[age]]
    return OrderedDict((NOW_SEQ - age, NOW_US - age * TICK_US) for age in ages)


@cache
def _statuses(started: int) -> OrderedDict[int, int]:
    ages = [STATUSES[2], *reversed(range(started + 1))]
    return OrderedDict((NOW_SEQ - age, NOW_US - age * TICK_US) for age in ages)


@cache
def _shown(ages: tuple[int, ...]) -> OrderedDict[int, int]:
    pairs = [(age, shown) for age, shown in enumerate(ages) if shown >= 0]
    return OrderedDict((NOW_US - age * TICK_US, NOW_US - shown * TICK_US) for age, shown in reversed(pairs))


@cache
def _first(last: int, previous: int) -> OrderedDict[int, int]:
    ages = [(Image.PREVIOUS, previous), (Image.LAST, last)]
    return OrderedDict((image.value, NOW_US - age * TICK_US) for image, age in ages if age >= 0)


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
def _twist_message(who: Holder, age: int, seq: int, session: str, shift_us: int) -> Message:
    echo = Echo(channel="frame", session=session, seq=NOW_SEQ - age, t_us=NOW_US - age * TICK_US + shift_us)
    header = AnswerHeader(source=who.source, session=who.session, seq=seq, echo=echo)
    return Message(TWIST, who.source, encode(header), f"{SPEEDS[who]}|0".encode())


@cache
def _request_message(who: Holder, verb: Verb, age: int) -> Message:
    echo = Echo(channel="status", session=ROBOT, seq=NOW_SEQ - age, t_us=NOW_US - age * TICK_US)
    header = RequestHeader(source=who.source, session=who.session, seq=1, echo=echo)
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
