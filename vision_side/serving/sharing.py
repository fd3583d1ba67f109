"""Decide which robots this vision service drives, among other services. Pure.

    tokens of robots and services -> assignment -> owner and two standbys of each robot
    part      subscribes to           has a driver token  ends when
    STANDBY   camera model, status    no                  the robot gets other choices, and its driver works
    CLAIM     + frames                yes                 no other driver is left, or one is silent or newer
    DRIVE     + frames                yes                 a better choice claims it, or another driver keeps the lease

The owner claims; the former driver sees the token and leaves; then the owner drives, first by the newest frame. A claim
without effect for a second, e.g. because a mission continues, receives no more frames. So two services never receive
the frames of one robot, except while one of them hangs. The robot's lease decides who drives, not this module. A
service that left for a claim is standby until the claimer works, because the token may be of one that never answers.
"""

from collections.abc import Sized
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import State, Status
from sightline.protocol.transports.tokens import (
    MAX_ROBOTS,
    MAX_SERVICES,
    DriverToken,
    RobotToken,
    Token,
    VisionToken,
)
from sightline.vision_side.serving.assignment import assign, ranked

SILENT_US: Final = 380_000
"""Time without a sign of the driver after which the standby drives: four statuses. The robot permits it after 400 ms,
and the first command comes later."""
SECOND_STANDBY_US: Final = 1_000_000
"""The same time for the second standby, from the silence or the newest driver token: the first standby hangs, too."""
NO_DRIVER_US, NEXT_CHOICE_US = 1_500_000, 500_000
"""Time without a driver token after which the standby claims a robot, and the delay of each of the next two choices."""
BETWEEN_CHANGES_US: Final = 1_000_000
"""Shortest time between two claims of one robot by one service. It doubles while claims have no effect."""
SETTLED_US: Final = 1_200_000
"""Age of the newest driver token from which the owner claims a robot whose driver works. A new service does not know
earlier changes, and a claim needs up to 0.2 s to have an effect. So a robot changes at most once a second."""
MAX_DOUBLINGS: Final = 2
NO_FRAMES_US: Final = 2_300_000
"""Time without a frame of the robot after which a driver without a command is silent. By then `status` reports a failed
camera. A driver that does not subscribe to frames gets none either."""
NOT_MINE_US: Final = 300_000
"""Time without the lease, although commands are sent, after which a driver needs a new session."""
FRESH_COMMANDS: Final = 48
"""Commands of one session without the lease. After 64 a robot no longer knows the owner of the token."""
STATUS_GAP_US: Final = 150_000
"""Longest time between two statuses of a link that works. A longer gap gives no information."""
OF_DRIVERS: Final = (
    RejectReason.STALE, RejectReason.OUT_OF_ORDER, RejectReason.OTHER_SESSION, RejectReason.UNKNOWN_FRAME,
    RejectReason.FROM_FUTURE, RejectReason.DISARMED,
)
"""Rejections that show a driver at work. Other programs, and drivers without the lease, cause the other rejections."""
ROBOT_RETURNS_US: Final = 2_000_000
"""Time after the return of this service's link at which a missing robot token counts as ended. A robot tries to connect
at least once a second."""
SERVICE_RETURNS_US: Final = 300_000
"""The same for tokens of services and drivers. A service may have died with its router, so its robots stand. A service
that returns later gets its robots back. Until then nothing is claimed, because driver tokens may arrive late."""
MAX_DRIVERS: Final = 16
"""Security limit: drivers of one robot. Further tokens, also of robots and services, count when there is room."""
MAX_OWN: Final = 2 * MAX_ROBOTS
"""Number of stored tokens of this service, the newest ones."""
_UNKNOWN: Final = -1
"""A time or a count before the first status."""


class SharingPart(Enum):
    """The part of this service for one robot."""

    NONE = "none"
    STANDBY = "standby"
    CLAIM = "claim"
    DRIVE = "drive"


@dataclass(slots=True)
class SharedRobot:
    """State of one robot: its drivers, and the part of this service."""

    drivers: set[DriverToken]
    part: SharingPart = SharingPart.NONE
    is_busy: bool = False
    """True for a mission that an operator requested here. The robot stays, because other services do not know it."""
    ignored: set[DriverToken] = field(default_factory=set)
    """Drivers that were silent. A new session of such a driver counts again."""
    driverless_us: int = 0
    """Time when the last driver token ended, or when this robot became known."""
    driver_us: int = _UNKNOWN
    """Time when the newest driver token appeared."""
    has_left: bool = False
    """True after it left for another driver, until a status shows that this driver works."""
    changed_us: int = -BETWEEN_CHANGES_US << MAX_DOUBLINGS
    renewed_us: int = -BETWEEN_CHANGES_US << MAX_DOUBLINGS
    tries: int = 0
    """Claims and new sessions since this service last held the lease. Each one doubles the wait."""
    arrived: int = _UNKNOWN
    """Commands of its driver in the newest status, accepted or not."""
    answered: int = _UNKNOWN
    """Answered frames, or frames in flight, at the last status with more answers than frames in flight."""
    status_us: int = _UNKNOWN
    """Time of the newest status."""
    active_us: int = _UNKNOWN
    """Last time at which the driver worked, or had no reason to."""
    worked_us: int = _UNKNOWN
    """Last time at which the driver worked, or the first status of this part."""
    frames: int = _UNKNOWN
    """Frames sent by the robot at that time. Without a later frame there is nothing to answer."""
    sent: int = _UNKNOWN
    """Commands of the session of this service."""
    held: int = _UNKNOWN
    """The value of `sent` when it last held the lease."""
    has_held: bool = False
    """True if this service has held the lease since it drives."""
    mine_us: int = _UNKNOWN
    """Last time at which this service held the lease, or had no reason to."""

    @property
    def others(self) -> set[DriverToken]:
        """Return the drivers that are not ignored."""
        return self.drivers - self.ignored

    @property
    def is_silent(self) -> bool:
        """Return True if its statuses show no driver at work."""
        return self.status_us - self.active_us >= SILENT_US

    def is_kept(self, now_us: int) -> bool:
        """Return True if another driver that appeared after this one keeps the robot. It may ignore this token."""
        if self.part is SharingPart.DRIVE:
            return not self.has_held and self.is_not_mine and bool(self.others)
        return self.driver_us >= self.changed_us and now_us - self.changed_us >= BETWEEN_CHANGES_US

    @property
    def is_not_mine(self) -> bool:
        """Return True if its statuses show that this service sends commands but does not hold the lease."""
        return self.status_us - self.mine_us >= NOT_MINE_US

    def begin_session(self, now_us: int) -> None:
        """Forget the commands of the earlier session."""
        self.mine_us, self.sent, self.held = now_us, 0, 0

    def begin_part(self) -> None:
        """Forget the earlier statuses."""
        self.frames = self.status_us = _UNKNOWN


class Sharing:
    """The robots of one vision service among others.

    Args:
        own: the token of this service.
        named: robots that it serves without a robot token, e.g. of older releases.
    """

    def __init__(self, own: VisionToken, named: tuple[str, ...] = ()) -> None:
        self.own = own
        self._is_leaving = False
        self._own_drivers: dict[DriverToken, None] = {}
        self._drivers: dict[str, set[DriverToken]] = {robot: set() for robot in named}
        self.robots = {robot: SharedRobot(self._drivers[robot]) for robot in named}
        self._named = frozenset(named)
        self._services: set[VisionToken] = set()
        self._twins = 0
        """Number of services with this name that take precedence."""
        self._choices: dict[str, tuple[str, ...]] = {}
        self._is_changed = True
        self._full: dict[int, tuple[Sized, int]] = {}
        """Tables that had no room for a token, and their limits."""
        self._is_up, self._up_us = True, -SERVICE_RETURNS_US
        self._ended: set[Token] = set()
        """Tokens that ended with the link of this service. The state of their owners is unknown."""

    @property
    def has_twin(self) -> bool:
        """Return True if another service has this name and takes precedence."""
        return self._twins > 0

    def add_own(self, token: DriverToken) -> None:
        """Add a driver token of this service before it is declared."""
        # It never counts as another driver, even after its end, because a link that returns declares it again.
        self._own_drivers[token] = None
        if len(self._own_drivers) > MAX_OWN:
            del self._own_drivers[next(iter(self._own_drivers))]

    def is_named(self, robot: str) -> bool:
        """Return True if this service serves a robot that has no token."""
        return robot in self._named

    def leave(self) -> None:
        """End the part of this service: each robot goes to the first other service that claims it."""
        self._is_leaving = self._is_changed = True

    def services(self) -> dict[str, float]:
        """Return the weight of each service, with this one. Of two with one name the lower instance counts."""
        present = sorted((*self._services, self.own), key=lambda one: one.instance, reverse=True)
        return {one.name: one.weight for one in present if not (self._is_leaving and one == self.own)}

    def on_link(self, is_up: bool, now_us: int) -> None:
        """Note the loss or the return of the link of this service. Nothing changes while the link is lost."""
        self._is_up, self._up_us = is_up, now_us
        for robot in self.robots.values():
            robot.begin_part()
            robot.driverless_us = now_us
            robot.begin_session(now_us)

    def on_token(self, token: Token, is_present: bool, now_us: int) -> None:
        """Note a token that appeared or ended. If it ended with the link, call `on_link` first."""
        self._ended.discard(token)
        if not is_present and not self._is_up:
            self._ended.add(token)
        elif isinstance(token, DriverToken):
            self._on_driver(token, is_present, now_us)
        elif isinstance(token, RobotToken):
            self._on_robot(token.robot, is_present, now_us)
        elif token != self.own:
            if not is_present:
                self._services.discard(token)
            elif not self._is_full(self._services, MAX_SERVICES):
                self._services.add(token)
            self._is_changed = True
            if token.name == self.own.name:
                self._twins = sum(one.name == token.name and one.instance < self.own.instance for one in self._services)

    def _on_robot(self, robot: str, is_present: bool, now_us: int) -> None:
        if is_present and robot not in self.robots and not self._is_full(self.robots, MAX_ROBOTS):
            self.robots[robot] = SharedRobot(
                self._drivers.setdefault(robot, set()), driverless_us=now_us, driver_us=now_us)
            self._is_changed = True
        elif not is_present and robot in self.robots and robot not in self._named:
            del self.robots[robot]
            self._is_changed = True
            if not self._drivers[robot]:
                del self._drivers[robot]

    def _on_driver(self, token: DriverToken, is_present: bool, now_us: int) -> None:
        if token in self._own_drivers:
            return
        if token.robot not in self._drivers and self._is_full(self._drivers, MAX_ROBOTS):
            return
        # The tokens of a robot and of its driver arrive in any order.
        drivers, robot = self._drivers.setdefault(token.robot, set()), self.robots.get(token.robot)
        if is_present and token not in drivers and not self._is_full(drivers, MAX_DRIVERS):
            drivers.add(token)
            if robot is not None:
                robot.driver_us = now_us
        elif not is_present:
            drivers.discard(token)
        if robot is not None and not is_present:
            robot.ignored.discard(token)
            robot.driverless_us = now_us
        if robot is None and not drivers:
            del self._drivers[token.robot]

    def _is_full(self, table: Sized, limit: int) -> bool:
        if len(table) >= limit:
            self._full[id(table)] = table, limit
        return len(table) >= limit

    def needs_tokens(self) -> bool:
        """Return True, once, if there is room for ignored tokens. The caller then watches all tokens again."""
        has_room = any(len(table) < limit for table, limit in self._full.values())
        if has_room:
            self._full.clear()
        return has_room

    def on_status(self, robot: str, status: Status, *, is_mine: bool, sent: int, now_us: int) -> None:
        """Note a status of a robot in which this service has a part.

        Args:
            robot: robot id.
            status: its newest status.
            is_mine: True if the lease holder is the session of this service.
            sent: commands of this session so far.
            now_us: monotonic clock.
        """
        one = self.robots.get(robot)
        if one is None:
            return
        human = status.holder is not None and status.holder.source != "vision"
        needs_no_driver = human or status.state in (State.STOPPED, State.FAULT) or bool(status.stream.camera_fault)
        if one.status_us != _UNKNOWN:
            # Without statuses the link was cut, also for the driver, so its silence does not count.
            gap_us = max(0, now_us - one.status_us - STATUS_GAP_US)
            one.active_us, one.mine_us = min(now_us, one.active_us + gap_us), min(now_us, one.mine_us + gap_us)
        # A driver that hangs sends no commands and returns no credit. Rejected commands show that it works.
        refused = sum(count for reason, count in status.refused.items() if reason in OF_DRIVERS)
        stream, arrived = status.stream, status.accepted + refused
        answered = stream.sent - stream.credit_timeouts
        is_first = one.frames == _UNKNOWN
        # A restart of the robot resets the counters. Counts before this part belong to another driver.
        one.answered = answered if is_first else min(one.answered, stream.sent)
        answers = answered > one.answered + stream.window
        one.answered = answered if answers else one.answered
        if needs_no_driver or answers or arrived != one.arrived or is_first:
            one.worked_us, one.frames = now_us, stream.sent
        if stream.sent == one.frames and now_us - one.worked_us < NO_FRAMES_US:
            one.active_us = now_us
        one.arrived = arrived
        if answers or (status.holder is not None and not human and not is_mine):
            one.has_left = False
        if is_mine or needs_no_driver or sent == one.sent:
            one.mine_us = now_us
        if is_mine:
            one.tries, one.held, one.has_held = 0, sent, True
        one.sent, one.status_us = sent, now_us

    def needs_session(self, robot: str, now_us: int) -> bool:
        """Return True, at most once a second, if this service drives but the robot no longer accepts its session."""
        one = self.robots[robot]
        stale = one.is_not_mine or one.sent - one.held >= FRESH_COMMANDS
        # Without another driver the claim does not count, because a robot that lost a router ends all its sessions.
        before_us = one.changed_us if one.drivers else one.renewed_us
        if one.part is not SharingPart.DRIVE or not stale or _is_within_wait(before_us, one.tries, now_us):
            return False
        one.begin_session(now_us)
        one.changed_us = one.renewed_us = now_us
        one.tries += 1
        return True

    def is_about_to_drive(self, robot: str, now_us: int) -> bool:
        """Return True during the first second of a claim."""
        one = self.robots.get(robot)
        return (one is not None and one.part is SharingPart.CLAIM
                and now_us - one.changed_us < BETWEEN_CHANGES_US)

    def step(self, now_us: int) -> dict[str, SharingPart]:
        """Decide the part for each robot from now on. Returns the robots whose part changed."""
        if not self._is_up:
            return {}
        for token in tuple(self._ended):
            returns_us = ROBOT_RETURNS_US if isinstance(token, RobotToken) else SERVICE_RETURNS_US
            if now_us - self._up_us >= returns_us:
                self.on_token(token, False, now_us)
        if self._is_changed:
            self._choices, self._is_changed = assign(self.robots, self.services(), 3), False
        changed = {}
        for name, robot in self.robots.items():
            before = robot.part
            # Without another driver, a claim becomes DRIVE in the same step. A repeated claim needs a new token.
            while (part := self._next_part(name, robot, now_us)) is not robot.part:
                self._change(robot, part, now_us)
                if part is SharingPart.STANDBY:
                    break
            if part is not before:
                changed[name] = part
        return changed

    def _change(self, robot: SharedRobot, part: SharingPart, now_us: int) -> None:
        if part is SharingPart.CLAIM:
            robot.changed_us, robot.tries = now_us, robot.tries + 1
        if part is SharingPart.DRIVE:
            robot.ignored |= robot.drivers
            robot.has_held = False
            robot.begin_session(now_us)
        robot.has_left |= robot.part is SharingPart.DRIVE
        # Without a part, no status came, so old ones do not count. A standby knows that the driver is silent.
        if part is not SharingPart.CLAIM or robot.part is SharingPart.NONE:
            robot.begin_part()
        robot.part = part

    def _next_part(self, name: str, robot: SharedRobot, now_us: int) -> SharingPart:
        if robot.part is SharingPart.CLAIM and (not robot.others or robot.is_silent):
            return SharingPart.DRIVE
        watches = not self._is_leaving and (robot.has_left or self._is_choice(name))
        beside = SharingPart.STANDBY if watches else SharingPart.NONE
        if robot.part in (SharingPart.CLAIM, SharingPart.DRIVE):
            return beside if self._must_leave(name, robot) or robot.is_kept(now_us) else robot.part
        may_claim = not self._is_leaving and now_us - self._up_us >= SERVICE_RETURNS_US
        return SharingPart.CLAIM if may_claim and self._is_next(name, robot, now_us) else beside

    def _is_choice(self, name: str) -> bool:
        return self.own.name in self._choices[name] and not self.has_twin

    def _must_leave(self, name: str, robot: SharedRobot) -> bool:
        """Return True if another driver has the better claim."""
        # A silent driver counts again if it has the lease.
        others = robot.drivers if robot.is_not_mine else robot.others
        if self._is_leaving or robot.is_busy:
            return bool(others) and (self._is_leaving or robot.is_not_mine)
        return bool(others) and not {other.name for other in others}.isdisjoint(self._before(name))

    def _before(self, robot: str) -> list[str]:
        """Return the services that may claim a robot before this one, in order. Twins are adjacent."""
        first = self._choices[robot]
        order = first if self.own.name in first else [*first, *ranked(robot, self.services())]
        return [*order[: order.index(self.own.name)], *self._twins * [self.own.name]]

    def _is_next(self, name: str, robot: SharedRobot, now_us: int) -> bool:
        """Return True if it is the turn of this service to claim a robot."""
        owner, _, second = self._choices[name]
        is_owner = self.own.name == owner and not self.has_twin
        if not robot.drivers:
            if is_owner:
                return True
            # The order of all services takes long to compute for a thousand robots, and makes no difference.
            place = len(self._before(name)) if self.own.name in self._choices[name] else len(self._choices[name])
            return now_us - robot.driverless_us - NO_DRIVER_US >= NEXT_CHOICE_US * min(2, place - 1)
        if robot.is_silent:
            since_us = max(robot.active_us + SILENT_US, robot.driver_us)
            is_turn = self.own.name != second or robot.has_left or robot.status_us - since_us >= SECOND_STANDBY_US
        else:
            is_turn = is_owner and now_us - robot.driver_us >= SETTLED_US
        return is_turn and not _is_within_wait(robot.changed_us, robot.tries, now_us)


def _is_within_wait(changed_us: int, tries: int, now_us: int) -> bool:
    return now_us - changed_us < BETWEEN_CHANGES_US << min(max(0, tries - 1), MAX_DOUBLINGS)
