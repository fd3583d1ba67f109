"""The permitted actions of a robot, from the design alone, without any record, lease, ramp or table of the robot.

It follows each event with its own bookkeeping in ticks, and raises `BrokenError` with the promise that the robot broke.
Of the robot it reads what a user can see: the reason of each rejection, the state, the holder and the wheels' speed.

1. The robot never acts on a stale image: `on_twist` (a command counts only with a frame that was issued lately, whose
   image is young too) and `_check_wheels` (the age limits the speed at each tick, not only on arrival).
2. It can always be stopped and has one driver: `on_request` and `_check_state` (STOP, its latch, arming), `_may_take`
   and `check` (the holder), `_check_wheels` (zero in time and within the distance, only the holder moves the wheels).

Promises without a number keep the others from being true of a robot that never moves.
"""

import math

from sightline.protocol.messages import State, Verb
from tests.exploration.robot import DRIVERS, FRAMES, HUMAN, LIVE, OLD, SPEEDS, THIEF, Image, Robot

RANK = {"vision": 1, "teleop": 2}
LEASE, SILENCE, STALE, FULL_SPEED_TICKS, ZERO_SPEED, HOLD = 10, 3, 4, 1.5, 4, 10  # ticks; HOLD as configured
RAMP = 4  # ticks from top speed to zero
STOP_TICKS, STOP_M = 7, 0.25  # from the last valid command to wheels at zero
TOP_MPS = 0.5
TICK_S = 0.1
ARMED = (State.HOLD, State.ACTIVE, State.DEGRADED)
LATCHED = (State.STOPPED, State.FAULT)
NOBODY = -1
_CLOSE = 1e-9
_OLDER = (*range(1, FRAMES), OLD, NOBODY)  # the age one tick later; -1 is the last


class BrokenError(Exception):
    """A promise that does not hold."""


def demand(condition: bool, promise: str) -> None:
    if not condition:
        raise BrokenError(promise)


class Promises:
    """The promised state of a robot."""

    def __init__(self) -> None:
        self.begin(auto=False, stopped=False)

    def begin(self, *, auto: bool, stopped: bool) -> None:
        """Begin as after a start of the robot."""
        self.state = State.STOPPED if stopped else State.DISARMED
        self.images = (NOBODY,) * FRAMES  # age of the image in the frame of each age; nothing where no frame was issued
        self.last = self.previous = NOBODY  # ages of the two newest images
        self.since_new = NOBODY  # ticks since the newest new image
        self.frozen = False  # the newest frame came long after it
        self.started = 0
        self.ended = FRAMES  # ticks since the newest STOP, disarm, fault or loss of the human
        self.seen = (False,) * THIEF
        self.holder, self.left, self.live = NOBODY, 0, 0
        self.tokens = self.fenced = self.bound = 0  # bits of drivers: present, never again; the holder has a token
        self.former = NOBODY  # had the lease last, with a token, until its end
        self.command = (NOBODY, NOBODY, NOBODY)  # age of the image, age of the arrival, driver
        self.auto = auto and not stopped
        self.stored = stopped  # STOP is on the disk
        self.held = 0
        self.idle = RAMP
        self.quiet = 0  # ticks since the last accepted command, while the wheels turn
        self.speed_mps = self.way_m = 0.0  # and the distance since then

    def save(self) -> tuple[float, ...]:
        """Return all of it."""
        return (
            _STATES[self.state], *self.images, self.last, self.previous, self.since_new, self.frozen, self.started,
            self.ended, *self.seen, self.holder, self.left, self.live, *self.command, self.tokens, self.fenced,
            self.bound, self.former, self.auto,
            self.stored, self.held, self.idle, self.quiet, self.speed_mps, self.way_m,
        )

    def load(self, saved: tuple[float, ...]) -> None:
        """Put it into a state of `save`."""
        self.state, self.images = _STATE[saved[0]], saved[1:7]
        self.last, self.previous, self.since_new, self.frozen, self.started, self.ended = saved[7:13]
        self.seen = saved[13:16]
        self.holder, self.left, self.live = saved[16:19]
        self.command = saved[19:22]
        self.tokens, self.fenced, self.bound, self.former = saved[22:26]
        self.auto, self.stored, self.held, self.idle, self.quiet, self.speed_mps, self.way_m = saved[26:]

    # --- what happens ----------------------------------------------------------------------------------------------

    def on_twist(
        self, driver: int, age: int, reason: str, *, fresh: bool = True, real: bool = True, proven: bool = True
    ) -> None:
        """A command arrived.

        Args:
            driver: that it names, or the thief with proofs of its own.
            age: of the cited frame.
            reason: of its rejection.
            fresh: its number is newer than the last.
            real: it names the frame as issued.
            proven: where drivers prove their identity, its proof is the next one of the driver.
        """
        valid, image = reason in ("", "DISARMED"), self.images[age]
        if not real or not 0 <= image <= STALE:
            demand(not valid, "1: a command needs a frame that this robot issued lately, by its own record and clock")
            return
        known, self.seen = self.seen, tuple(was or index == driver for index, was in enumerate(self.seen))
        if not fresh and known[driver]:
            demand(not valid, "2: a command counts once")
            return
        if not proven and self._names_holder(driver):
            demand(not valid, "2: a copied identity proves nothing")
            return
        if self.state in LATCHED:
            demand(not valid, "2: no command has an effect until reset")
            return
        if not self._may_take(driver):
            demand(not valid, "2: one driver at a time")
            return
        demand(valid, "an honest command is accepted")
        self.live = min(LIVE, self.live + 1 if self.holder == driver else 1)
        if self.holder != driver:
            if self.holder != NOBODY and RANK[DRIVERS[self.holder].source] == RANK[DRIVERS[driver].source]:
                self.fenced |= 1 << self.holder
            self.bound = self.tokens >> driver & 1
        self.holder, self.left, self.former = driver, LEASE, NOBODY
        demand((reason == "") <= (self.state in ARMED), "2: only an armed robot applies commands")
        demand((reason == "") >= (self.state in ARMED), "an honest command is applied")
        if not reason:
            self.command = (image, 0, driver)
            self.quiet, self.way_m = 0, 0.0

    def on_request(self, driver: int, verb: Verb, age: int, reason: str, auto: bool) -> None:
        """A request arrived that cites the status of this age."""
        granted, cited = not reason, age < self.ended and age <= self.started
        if verb is Verb.STOP:
            demand(granted, "2: STOP is always granted")
            self._leave(State.STOPPED)
            self._end()
        elif verb is Verb.DISARM:
            demand(granted, "2: disarm is always granted")
            if self.state in ARMED:
                self._leave(State.DISARMED)
            self._end()
        elif verb is Verb.RELEASE:
            self._release(driver)
        else:
            demand(cited or not granted, "2: a late request has no effect after STOP, disarm or the loss of the human")
            self._on_permission(verb, driver, granted, cited, auto)

    def _on_permission(self, verb: Verb, driver: int, granted: bool, cited: bool, auto: bool) -> None:
        still = self.speed_mps == 0.0
        if verb is Verb.ACQUIRE:
            may = cited and self._may_take(driver)
            if may and self.holder != driver:
                self.holder, self.left, self.live, self.command = driver, LEASE, 0, (NOBODY,) * 3
                self.former = NOBODY
        elif self._is_beside_human(driver):
            demand(not granted, "2: while a human drives no other operator arms or resets")
            return
        elif verb is Verb.ARM:
            ready = self.state is State.DISARMED and self.holder != NOBODY and self.live >= LIVE and still
            demand(ready or self.state in ARMED or not granted,
                   "2: arming needs DISARMED, live commands of the driver and wheels at zero")
            may = cited and (ready or self.state in ARMED)
            if may and ready:
                self._arm()
                self.auto = auto
        else:
            demand(still or self.state not in LATCHED or not granted, "2: reset needs wheels at zero")
            may = cited and (self.state not in LATCHED or still)
            if may and self.state in LATCHED:
                self._leave(State.DISARMED)
        demand(granted or not may, f"an honest {verb} is granted")
        demand(may or not granted, "2: one driver at a time")

    def on_token(self, driver: int, is_present: bool) -> None:
        """The token of a driver appeared or ended."""
        if is_present:
            self.tokens |= 1 << driver
        else:
            self.tokens &= ~(1 << driver)
            if self.bound and self.holder == driver:
                self.fenced |= 1 << driver
                self.left = 0
                self._lose_holder()
            elif self.former == driver:
                self.fenced |= 1 << driver
                self.former = NOBODY

    def on_restart(self, auto: bool) -> None:
        """The driver process started again."""
        self.begin(auto=auto, stopped=self.stored)

    def on_write(self) -> None:
        """The disk stored the latch."""
        self.stored = self.state is State.STOPPED

    def on_fault(self) -> None:
        """The drive failed."""
        if self.state not in LATCHED:
            self._leave(State.FAULT)
            self._end()

    def on_tick(self, image: Image) -> None:
        """A tick passed, and the robot published a frame with this image."""
        last, previous, *aged = (_OLDER[age] for age in (self.last, self.previous, *self.images[:-1]))
        self.since_new = _OLDER[self.since_new]
        if image is Image.NEW:
            self.since_new, last, previous = 0, 0, last
        elif image is Image.PREVIOUS:
            last, previous = previous, last
        self.last, self.previous = last, previous
        self.images = (NOBODY if image is Image.MISSING else last, *aged)
        if image is not Image.MISSING:
            self.frozen = self.since_new >= OLD
        shown, arrival, driver = self.command
        if driver != NOBODY:
            self.command = _OLDER[shown], min(arrival + 1, SILENCE + 1), driver
        self.left = max(0, self.left - 1)
        if self.left == 0 and self.holder != NOBODY:
            former = self.holder if self.bound else NOBODY
            self._lose_holder()
            self.former = former
        may_arm = self.state is State.DISARMED and self.holder != NOBODY and self.live >= LIVE
        if self.auto and may_arm and self.speed_mps == 0.0:
            self._arm()
            self.held = -1  # this tick is the first in HOLD
        if self.state in ARMED:
            self._step()
        # The status of this tick follows its step, so it shows what ended in it.
        self.started, self.ended = min(self.started + 1, 2), min(self.ended + 1, FRAMES)

    # --- inside ----------------------------------------------------------------------------------------------------

    def _names_holder(self, driver: int) -> bool:
        return self.holder != NOBODY and DRIVERS[self.holder] == DRIVERS[driver]

    def _may_take(self, driver: int) -> bool:
        if driver == NOBODY or self.fenced >> driver & 1:
            return False
        if self.holder in (NOBODY, driver):
            return True
        rank, other = RANK[DRIVERS[driver].source], RANK[DRIVERS[self.holder].source]
        is_silent = LEASE - self.left > STALE
        return rank > other or bool(rank == other and self.bound and is_silent and self.tokens >> driver & 1)

    def _is_beside_human(self, driver: int) -> bool:
        return self.holder not in (NOBODY, driver) and DRIVERS[self.holder] is HUMAN

    def _arm(self) -> None:
        self.state, self.command, self.held = State.HOLD, (NOBODY,) * 3, 0

    def _leave(self, state: State) -> None:
        if self.state is not state:
            self.live, self.command, self.held = 0, (NOBODY,) * 3, 0
        self.state = state

    def _end(self) -> None:
        self.ended, self.auto = 0, False

    def _release(self, driver: int) -> None:
        if self.holder == driver != NOBODY:
            self.command = (NOBODY,) * 3
            self.left = 0
            self._lose_holder()

    def _lose_holder(self) -> None:
        human, self.holder, self.bound = DRIVERS[self.holder] is HUMAN, NOBODY, 0
        if human:
            if self.state in ARMED:
                self._leave(State.DISARMED)
            self._end()

    @property
    def _is_permitted(self) -> bool:
        image, arrival, driver = self.command
        is_young = image < ZERO_SPEED and arrival <= SILENCE
        return not self.frozen and self.state in ARMED and driver != NOBODY and is_young

    def _step(self) -> None:
        if self._is_permitted:
            self.state, self.held = State.ACTIVE if self.command[0] <= FULL_SPEED_TICKS else State.DEGRADED, 0
            return
        self.held = self.held + 1 if self.state is State.HOLD else 0
        self.state = State.HOLD
        if self.held > HOLD:
            self._leave(State.DISARMED)

    # --- what must hold in each state ------------------------------------------------------------------------------

    def check(self, robot: Robot, *, ticked: bool) -> None:
        """Compare the robot with its promised state."""
        gate = robot.gate
        before_mps, speed_mps = self.speed_mps, gate.applied.linear_mps
        if ticked:
            self._check_wheels(before_mps, speed_mps)
            self.speed_mps = speed_mps
        else:
            demand(speed_mps == before_mps, "2: only a tick moves the wheels")
        if gate.state is not self.state:
            self._check_state(gate.state)
        promised = "no driver" if self.holder == NOBODY else DRIVERS[self.holder].source
        demand(robot.holder() == self.holder, f"2: the lease belongs to {promised}")

    def _check_wheels(self, before_mps: float, speed_mps: float) -> None:
        """Check a tick: the wheels approach what is permitted, without going beyond it, and stop in time."""
        image, _, driver = self.command
        permitted, limit_mps = self._is_permitted, 0.0
        if permitted:
            limit_mps = TOP_MPS * min(1.0, (ZERO_SPEED - image) / (ZERO_SPEED - FULL_SPEED_TICKS))
        goal_mps = math.copysign(limit_mps, SPEEDS[DRIVERS[driver]]) if permitted else 0.0
        left_mps, before_left_mps = goal_mps - speed_mps, goal_mps - before_mps
        arrived = abs(left_mps) <= _CLOSE
        nearer = abs(left_mps) < abs(before_left_mps) - _CLOSE and left_mps * before_left_mps > 0
        faster = abs(speed_mps) > abs(before_mps) + _CLOSE or speed_mps * before_mps < 0
        demand(permitted or not faster, "1: no motion without an accepted command on a young frame")
        demand(permitted or nearer or arrived, "2: without a permitted command the wheels brake")
        beyond = abs(speed_mps) > limit_mps + _CLOSE
        demand(not beyond or (nearer and not faster), "1: the age of the frame limits the speed")
        demand(nearer or arrived, "2: the wheels follow the holder")
        demand(not permitted or self.holder in (driver, NOBODY), "2: the wheels follow the holder")
        self.idle = 0 if permitted else min(self.idle + 1, RAMP)
        self.quiet, self.way_m = self.quiet + 1, self.way_m + abs(before_mps) * TICK_S
        if speed_mps == 0.0:
            self.quiet, self.way_m = 0, 0.0
        stopped_in_time = self.idle < RAMP and self.quiet < STOP_TICKS and self.way_m <= STOP_M
        demand(speed_mps == 0.0 or stopped_in_time, "2: the wheels are at zero within the bounds")

    def _check_state(self, state: State) -> None:
        demand(self.state is not State.STOPPED, "2: STOPPED is latched until reset, over restarts too")
        demand(state not in (State.ACTIVE, State.DEGRADED) or self.state in ARMED, "2: only arming permits motion")
        demand(state not in ARMED or self.state in ARMED, "2: only arming permits motion")
        raise BrokenError(f"the state is {self.state}, not {state}")


_STATES = {state: index for index, state in enumerate(State)}
_STATE = tuple(State)
