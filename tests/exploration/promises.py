"""What the robot may do, from the design alone: it uses no record, no lease, no table of states and no ramp of ours.

It follows each event with its own bookkeeping in ticks, and raises `Broken` with the promise that the robot broke.
"""

from sightline.protocol.messages import STILL, Holder, State, Verb
from tests.exploration.robot import CONFIGS, DRIVERS, FRAMES, HUMAN, LIVE, NOW_US, OLD, SPEEDS, Image, Robot

RANK = {"vision": 1, "teleop": 2}
LEASE, SILENCE, STALE, FULL_SPEED, ZERO_SPEED, HOLD = 10, 3, 4, 1, 4, 10  # ticks, of DESIGN.md; HOLD as configured
RAMP = 4  # ticks from top speed to zero
TOP_MPS = 0.5
ARMED = (State.HOLD, State.ACTIVE, State.DEGRADED)
LATCHED = (State.STOPPED, State.FAULT)
NOBODY = -1
_CLOSE = 1e-9
_OLDER = (*range(1, FRAMES), OLD, NOBODY)  # the age one tick later; -1 is the last


class Broken(Exception):
    """A promise that does not hold."""


def demand(condition: bool, promise: str) -> None:
    if not condition:
        raise Broken(promise)


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
        self.seen = (False,) * len(DRIVERS)
        self.holder, self.left, self.live = NOBODY, 0, 0
        self.command = (NOBODY, NOBODY, NOBODY)  # age of the image, age of the arrival, driver
        self.auto = auto and not stopped
        self.stored = stopped  # STOP is on the disk
        self.held = 0
        self.idle = RAMP
        self.speed_mps = 0.0

    def save(self) -> tuple[float, ...]:
        """Return all of it."""
        return (
            _STATES[self.state], *self.images, self.last, self.previous, self.since_new, self.frozen, self.started, self.ended, *self.seen, self.holder, self.left,
            self.live, *self.command, self.auto, self.stored, self.held, self.idle, self.speed_mps,
        )

    def load(self, saved: tuple[float, ...]) -> None:
        """Put it into a state of `save`."""
        self.state, self.images = _STATE[saved[0]], saved[1:7]
        self.last, self.previous, self.since_new, self.frozen, self.started, self.ended = saved[7:13]
        self.seen = saved[13:16]
        self.holder, self.left, self.live = saved[16:19]
        self.command = saved[19:22]
        self.auto, self.stored, self.held, self.idle, self.speed_mps = saved[22:]

    # --- what happens ----------------------------------------------------------------------------------------------

    def on_twist(self, driver: int, age: int, reason: str, *, fresh: bool = True, real: bool = True) -> None:
        """A command arrived. `real` citations name a frame as issued; `fresh` numbers are newer than the last."""
        valid, image = reason in ("", "DISARMED"), self.images[age]
        if not real or not 0 <= image <= STALE:
            demand(not valid, "1: a command needs a frame that this robot issued lately, by its own record and clock")
            return
        known, self.seen = self.seen, tuple(was or index == driver for index, was in enumerate(self.seen))
        if not fresh and known[driver]:
            demand(not valid, "2: a command counts once")
            return
        if self.state in LATCHED:
            demand(not valid, "2: no command has an effect until reset")
            return
        if not self._may_take(driver):
            demand(not valid, "2: one driver at a time")
            return
        demand(valid, "an honest command is accepted")
        self.live = min(LIVE, self.live + 1 if self.holder == driver else 1)
        self.holder, self.left = driver, LEASE
        demand((reason == "") <= (self.state in ARMED), "2: only an armed robot applies commands")
        demand((reason == "") >= (self.state in ARMED), "an honest command is applied")
        if not reason:
            self.command = (image, 0, driver)

    def on_request(self, who: Holder, verb: Verb, age: int, reason: str, auto: bool) -> None:
        """A request arrived that cites the status of this age."""
        granted, cited = not reason, age < self.ended and age <= self.started
        driver = DRIVERS.index(who) if who in DRIVERS else NOBODY
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
        elif self._is_beside_human(driver):
            demand(not granted, "2: while a human drives nobody else arms or resets")
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
            self._lose_holder()
        if self.auto and self.state is State.DISARMED and self.holder != NOBODY and self.live >= LIVE:
            if self.speed_mps == 0.0:
                self._arm()
                self.held = -1  # this tick is the first in HOLD
        if self.state in ARMED:
            self._step()
        # The status of this tick follows its step, so it shows what ended in it.
        self.started, self.ended = min(self.started + 1, 2), min(self.ended + 1, FRAMES)

    # --- inside ----------------------------------------------------------------------------------------------------

    def _may_take(self, driver: int) -> bool:
        if driver == NOBODY or self.holder in (NOBODY, driver):
            return driver != NOBODY
        return RANK[DRIVERS[driver].source] > RANK[DRIVERS[self.holder].source]

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
        human, self.holder = DRIVERS[self.holder] is HUMAN, NOBODY
        if human:
            if self.state in ARMED:
                self._leave(State.DISARMED)
            self._end()

    @property
    def _is_permitted(self) -> bool:
        image, arrival, driver = self.command
        return not self.frozen and self.state in ARMED and driver != NOBODY and image < ZERO_SPEED and arrival <= SILENCE

    def _step(self) -> None:
        if self._is_permitted:
            self.state, self.held = State.ACTIVE if self.command[0] <= FULL_SPEED else State.DEGRADED, 0
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
        state, holder = gate.state, gate.holder(robot.now_us)
        if state is not self.state:
            self._check_state(state)
        promised = None if self.holder == NOBODY else DRIVERS[self.holder]
        demand(holder == promised, f"2: the driver is {promised and promised.source}")

    def _check_wheels(self, before_mps: float, speed_mps: float) -> None:
        image, _, driver = self.command
        faster = abs(speed_mps) > abs(before_mps) + _CLOSE or speed_mps * before_mps < 0
        if not self._is_permitted:
            self.idle = min(self.idle + 1, RAMP)
            demand(not faster, "1: no motion without an accepted command on a young frame")
            demand(speed_mps == 0.0 or self.idle < RAMP, "2: the wheels are at zero within the bound")
            return
        self.idle = 0
        limit_mps = TOP_MPS * min(1.0, (ZERO_SPEED - image) / (ZERO_SPEED - 1.5))
        demand(abs(speed_mps) <= max(abs(before_mps), limit_mps) + _CLOSE, "1: the age of the frame limits the speed")
        demand(not faster or speed_mps * SPEEDS[DRIVERS[driver]] > 0, "2: the wheels follow the holder")
        demand(driver == self.holder or self.holder == NOBODY, "2: the wheels follow the holder")

    def _check_state(self, state: State) -> None:
        demand(self.state is not State.STOPPED, "2: STOPPED is latched until reset, over restarts too")
        demand(state not in (State.ACTIVE, State.DEGRADED) or self.state in ARMED, "2: only arming permits motion")
        demand(state not in ARMED or self.state in ARMED, "2: only arming permits motion")
        raise Broken(f"the state is {self.state}, not {state}")


_STATES = {state: index for index, state in enumerate(State)}
_STATE = tuple(State)
__all__ = ["CONFIGS", "NOW_US", "STILL", "Broken", "Promises"]
