"""Decides which of several detector services serves a robot, and the next choice while the first is silent. Pure.

Each service computes the same order of services for a robot (`assignment.ranked`) from the tokens of all. The first one
serves the robot. A service that serves a robot continues until one that is before it in the order has answered, so that
a service that joins, or only claims to, leaves no robot without answers. The next two receive the answers of a robot.
Each later one looks there only if it receives no answer of the services before it, to any robot, for its own number of
seconds.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from fnmatch import fnmatchcase
from typing import Final

from sightline.protocol.transports.tokens import MAX_ROBOTS, DetectorToken, SecondWatch
from sightline.vision_side.serving.assignment import ranked

MAX_SERVICES: Final = 64
"""Security limit: with more services, each one serves every robot."""
MAX_KEPT_TOKENS: Final = 1_000
"""Security limit: tokens that are stored. After a flood of more, the caller watches all that are present once more."""
LEFT_US: Final = 10_000_000
"""Time without its token after which a robot has left. Its link, or that of this service, may be back before."""
_STANDING_BY: Final = 2
"""Services that stand by for a robot, behind the one that serves it."""
SILENT_US: Final = 1_000_000
"""Time without an answer, after which the next service looks whether there are frames to answer."""
SILENT_INTERVALS: Final = 10
"""The same, in times between two answers, where they come often. A slow stream crosses the network once only."""
LEAST_SILENT_US: Final = 300_000
UNANSWERED_US: Final = 200_000
"""Time for which the next service receives frames that the one before does not answer, before it serves them; twice the
deadline of an answer at least."""
_SMOOTHING: Final = 0.1
_GAP_US: Final = 500_000
"""Longest time between two frames of one stream."""


class Duty(Enum):
    """The work of a service for a robot."""

    NOTHING = "nothing"
    STAND_BY = "receives the answers of the others"
    WATCH = "receives frames and answers of the others"
    SERVE = "receives and answers frames"


@dataclass(slots=True)
class _Robot:
    """One robot, as far as this service knows."""

    order: list[str]
    since_us: int
    serving: bool = False
    answered_us: dict[str, int] = field(default_factory=dict)
    """Time of the newest answer of each service."""
    interval_us: float = 0.0
    """Time between two answers; 0 if unknown."""
    silent: set[str] = field(default_factory=set)
    """Services that do not answer while others do."""
    frames_since_us: int | None = None
    """Time of the first frame of the stream that this service watches."""
    frame_us: int = 0


class RobotTokens:
    """The robots that have a token, or had one a moment ago. After a flood, the caller watches all once more."""

    def __init__(self, pattern: str, before: Iterable[str] = (), now_us: int = 0) -> None:
        """Create it. The robots in `before` leave unless their token is reported once more.

        Args:
            pattern: of the robots that count. One without wildcards needs no token, so that an older robot is served.
            before: robots that were known.
            now_us: time.
        """
        self._pattern = pattern
        self._ended_us: dict[str, int | None] = dict.fromkeys(before, now_us)
        """Robots, and when their token ended; None while it is present."""
        if not set("*?") & set(pattern):
            self._ended_us[pattern] = None
        self._began_us, self._left_out = now_us, False

    def on_token(self, robot: str, is_present: bool, now_us: int) -> None:
        """Note a robot's token that appeared or ended."""
        if robot == self._pattern or not fnmatchcase(robot, self._pattern):
            return
        if robot in self._ended_us or (is_present and len(self._ended_us) < MAX_ROBOTS):
            self._ended_us[robot] = None if is_present else now_us
        else:
            self._left_out |= is_present

    def present(self, now_us: int) -> list[str]:
        """Return the robots, and forget those that have left."""
        for robot in [one for one, at_us in self._ended_us.items() if at_us is not None and now_us - at_us >= LEFT_US]:
            del self._ended_us[robot]
        return list(self._ended_us)

    def needs_tokens(self, now_us: int) -> bool:
        """Return True if there is room for tokens that were left out: the caller watches all once more."""
        return self._left_out and len(self._ended_us) < MAX_ROBOTS and now_us - self._began_us >= LEFT_US


class Assignment:
    """The duties of one service among those of its group."""

    def __init__(self, own: DetectorToken, deadline_us: int = 0) -> None:
        """Create the duties of the service `own`, whose answers come within `deadline_us`, as those of the others."""
        self._own = own
        self._unanswered_us = max(UNANSWERED_US, 2 * deadline_us)
        self._tokens: set[DetectorToken] = set()
        self._left_out = self._changed = False
        self._second_watch = SecondWatch(MAX_KEPT_TOKENS)
        self._answered_us: dict[str, int] = {}
        """Time of the newest answer of each other service, to any robot."""
        self._services = {own.session: own}
        self._robots: dict[str, _Robot] = {}

    def on_token(self, token: DetectorToken, is_present: bool) -> None:
        """Note a token that appeared or ended. It counts from the next `update` on."""
        if not is_present:
            self._tokens.discard(token)
            if not self._second_watch.on_end(token):  # what it reports may have ended
                self._second_watch.end()
                self._left_out = True
        elif len(self._tokens) < MAX_KEPT_TOKENS:
            self._tokens.add(token)
        else:
            self._left_out |= token not in self._tokens
        self._changed = True

    def needs_tokens(self, now_us: int) -> bool:
        """Return True, once, if there is room for tokens that were left out: the caller watches them once more."""
        if self._second_watch.is_on(now_us) or not self._left_out or len(self._tokens) > MAX_SERVICES:
            return False
        self._left_out = False
        self._second_watch.begin(now_us)
        return True

    def on_recalled(self, token: DetectorToken) -> None:
        """Note a token of the second watch."""
        if self._second_watch.counts(token):
            self.on_token(token, True)

    def update(self, now_us: int) -> bool:
        """Use the tokens so far. Returns True if other services are present than before."""
        if not self._changed:
            return False
        self._changed, before = False, self._services.keys()
        # Sorted, so that of two tokens with one session the same one counts on every machine.
        services = {one.session: one for one in sorted(self._tokens)} | {self._own.session: self._own}
        if services == self._services:
            return False
        self._services = services
        for name in self._answered_us.keys() - services.keys():
            del self._answered_us[name]
        # Without sharing no order is used, and that of a flood would take long.
        for robot, state in self._robots.items() if self.is_shared else ():
            state.order = self._order(robot)
            for name in state.answered_us.keys() - set(state.order):
                del state.answered_us[name]
            state.silent &= set(state.order)
            state.since_us = now_us
        return services.keys() != before

    @property
    def services(self) -> int:
        """Return the number of services, this one included."""
        return len(self._services)

    @property
    def is_shared(self) -> bool:
        """Return True while the services divide the robots, False while there are too many and each serves all."""
        return len(self._services) <= MAX_SERVICES

    def duty(self, robot: str, now_us: int) -> Duty:
        """Return what this service does for a robot now."""
        if not self.is_shared:
            return Duty.SERVE
        state = self._state(robot, now_us)
        before = self._before(state)
        if not before:
            state.serving = True
        if state.serving:
            return Duty.SERVE
        stands_by = len(before) <= _STANDING_BY
        if now_us - self._received_us(state, before) < len(before) * (_silent_us(state) if stands_by else SILENT_US):
            state.frames_since_us = None
            return Duty.STAND_BY if stands_by else Duty.NOTHING
        if not _is_unanswered(state, now_us, self._unanswered_us):
            return Duty.WATCH
        state.silent.update(before)
        state.serving = True
        return Duty.SERVE

    def on_frame(self, robot: str, now_us: int) -> bool:
        """Note a frame. Returns True if this service answers it."""
        state = self._state(robot, now_us)
        if state.frames_since_us is None or now_us - state.frame_us > _GAP_US:
            state.frames_since_us = now_us
        state.frame_us = now_us
        return state.serving or not self.is_shared

    def on_answer(self, robot: str, service: str, now_us: int) -> bool:
        """Note an answer of another service. Returns False if that service does not share the robot."""
        if not self.is_shared:
            return True
        state = self._state(robot, now_us)
        if service not in state.order:
            return False
        gap_us = now_us - _answered_us(state)
        if state.answered_us and gap_us < SILENT_US:
            state.interval_us += (gap_us - state.interval_us) * (_SMOOTHING if state.interval_us else 1.0)
        state.answered_us[service] = self._answered_us[service] = now_us
        state.silent.discard(service)
        for one in _until(state.order, service):
            if now_us - state.answered_us.get(one, state.since_us) > SILENT_US:
                state.silent.add(one)
        if service in _until(state.order, self._own.session):
            state.serving = False
        return True

    def forget(self, robot: str) -> None:
        """Forget a robot that has left."""
        self._robots.pop(robot, None)

    def _state(self, robot: str, now_us: int) -> _Robot:
        if robot not in self._robots:
            self._robots[robot] = _Robot(self._order(robot), now_us)
        return self._robots[robot]

    def _order(self, robot: str) -> list[str]:
        fit = {name: one.weight for name, one in self._services.items() if fnmatchcase(robot, one.robots)}
        return ranked(robot, fit)

    def _received_us(self, state: _Robot, before: list[str]) -> int:
        """Return the time of the newest answer that counts for this robot."""
        if len(before) <= _STANDING_BY:
            return _answered_us(state)
        # It does not receive the robot's answers. That a service before it answers another robot shows that it works.
        return max(_answered_us(state), *(self._answered_us.get(name, 0) for name in before))

    def _before(self, state: _Robot) -> list[str]:
        return [name for name in _until(state.order, self._own.session) if name not in state.silent]


def _until(order: Iterable[str], name: str) -> list[str]:
    """Return what is before `name`, all without it."""
    before = []
    for one in order:
        if one == name:
            break
        before.append(one)
    return before


def _answered_us(state: _Robot) -> int:
    """Return the time of the newest answer, or of the newest change of services."""
    return max(state.since_us, *state.answered_us.values(), 0)


def _silent_us(state: _Robot) -> float:
    """Return the time without an answer after which a service is silent."""
    if not state.interval_us:
        return SILENT_US
    return min(max(LEAST_SILENT_US, SILENT_INTERVALS * state.interval_us), SILENT_US)


def _is_unanswered(state: _Robot, now_us: int, for_us: int) -> bool:
    """Return True if frames have come for a while, also now."""
    since_us = state.frames_since_us
    return since_us is not None and now_us - since_us >= for_us and now_us - state.frame_us <= _GAP_US
