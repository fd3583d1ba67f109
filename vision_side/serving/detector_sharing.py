"""Select which of several detector services serves a robot, and its replacement while it is silent. Pure.

Each service computes the same order of services for a robot (`assignment.ranked`) from the tokens of all services. The
first one serves the robot. A service stops serving a robot only after an earlier service in the order has answered it.
So a service that joins, or falsely claims to, leaves no robot without answers. The next two services receive the
answers for the robot. A later service subscribes only if the N services before it answer no robot for N seconds.
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
"""Security limit: stored tokens. After a flood of more, the caller watches all present tokens again."""
LEFT_US: Final = 10_000_000
"""Time without its token after which a robot has left. Its link, or the link of this service, may return before."""
_STANDING_BY: Final = 2
"""Number of standby services of a robot, after the service that serves it."""
SILENT_US: Final = 1_000_000
"""Time without an answer after which the next service receives frames, to see if any wait for an answer."""
SILENT_INTERVALS: Final = 10
"""The same time in intervals between answers, if they are frequent. So a slow stream is sent only once."""
LEAST_SILENT_US: Final = 300_000
UNANSWERED_US: Final = 200_000
"""Time for which frames get no answer before the next service serves the robot; at least twice the deadline of an
answer."""
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
    """State of one robot, as known to this service."""

    order: list[str]
    since_us: int
    serving: bool = False
    answered_us: dict[str, int] = field(default_factory=dict)
    """Time of the newest answer of each service."""
    interval_us: float = 0.0
    """Mean time between two answers; 0 if unknown."""
    silent: set[str] = field(default_factory=set)
    """Services that do not answer while others do."""
    frames_since_us: int | None = None
    """Time of the first frame of the watched stream."""
    frame_us: int = 0


class RobotTokens:
    """The robots that have a token, or had one recently. After a flood, the caller watches all tokens again."""

    def __init__(self, pattern: str, before: Iterable[str] = (), now_us: int = 0) -> None:
        """Create it. A robot of `before` leaves unless its token is reported again.

        Args:
            pattern: robots that count. A pattern without wildcards needs no token, for robots of older releases.
            before: robots that were known.
            now_us: time.
        """
        self._pattern = pattern
        self._ended_us: dict[str, int | None] = dict.fromkeys(before, now_us)
        """Robot -> time when its token ended, or None while it is present."""
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
        """Return the present robots, and forget robots that have left."""
        for robot in [one for one, at_us in self._ended_us.items() if at_us is not None and now_us - at_us >= LEFT_US]:
            del self._ended_us[robot]
        return list(self._ended_us)

    def needs_tokens(self, now_us: int) -> bool:
        """Return True if there is room for ignored tokens. The caller then watches all tokens again."""
        return self._left_out and len(self._ended_us) < MAX_ROBOTS and now_us - self._began_us >= LEFT_US


class Assignment:
    """The duties of one service in its group."""

    def __init__(self, own: DetectorToken, deadline_us: int = 0) -> None:
        """Create the duties of the service `own`. All services of the group answer within `deadline_us`."""
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
            if not self._second_watch.on_end(token):  # a token that it has reported may have ended
                self._second_watch.end()
                self._left_out = True
        elif len(self._tokens) < MAX_KEPT_TOKENS:
            self._tokens.add(token)
        else:
            self._left_out |= token not in self._tokens
        self._changed = True

    def needs_tokens(self, now_us: int) -> bool:
        """Return True, once, if there is room for ignored tokens. The caller then watches all tokens again."""
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
        """Use the tokens so far. Returns True if the set of present services has changed."""
        if not self._changed:
            return False
        self._changed, before = False, self._services.keys()
        # Sorted, so that every machine uses the same one of two tokens with one session.
        services = {one.session: one for one in sorted(self._tokens)} | {self._own.session: self._own}
        if services == self._services:
            return False
        self._services = services
        for name in self._answered_us.keys() - services.keys():
            del self._answered_us[name]
        # Without sharing no order is used, and the order of a flood of services takes long.
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
        """Return False if there are too many services. Then each service serves all robots."""
        return len(self._services) <= MAX_SERVICES

    def duty(self, robot: str, now_us: int) -> Duty:
        """Return the current duty of this service for a robot."""
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
        # This service does not receive the robot's answers. An earlier service that answers any robot works.
        return max(_answered_us(state), *(self._answered_us.get(name, 0) for name in before))

    def _before(self, state: _Robot) -> list[str]:
        return [name for name in _until(state.order, self._own.session) if name not in state.silent]


def _until(order: Iterable[str], name: str) -> list[str]:
    """Return the elements before `name`, or all without it."""
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
    """Return True if frames have come for at least `for_us`, and still come."""
    since_us = state.frames_since_us
    return since_us is not None and now_us - since_us >= for_us and now_us - state.frame_us <= _GAP_US
