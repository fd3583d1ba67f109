"""`Fleet`: one service for each robot of a fleet, in fair turns. Shell.

    sightline vision --robot 'r*' --listen tcp/0.0.0.0:7447
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from fnmatch import fnmatchcase

from sightline.protocol.channels import STATUS, Channel
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.log import report_fault
from sightline.protocol.messages import LeaseHolder, Stamp, Status
from sightline.protocol.transports.link import FleetLink, LatestSlot, Link, LinkWrapper, Message
from sightline.protocol.transports.tokens import DriverToken, RobotToken, SecondWatch, Token, VisionToken
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import close_detector
from sightline.vision_side.detect.port import Detector
from sightline.vision_side.detect.registry import configured_detector, waits_for_service
from sightline.vision_side.pipeline import SOURCE
from sightline.vision_side.serving.service import (
    DriverSession,
    LogLine,
    Observe,
    Service,
    ServiceCounts,
    ServingState,
    open_service,
)
from sightline.vision_side.serving.sharing import Sharing, SharingPart

_LONGEST_WAIT_S = 0.2
_CHANGES_FOR_S = 0.01
"""Part of a turn for new robots, and for robots that left. Each takes up to 4 ms, and the other robots wait."""
_FIRST_PAUSE_S, _LONGEST_PAUSE_S, _DOUBLINGS = 1.0, 30.0, 16
"""Pauses from the error of a robot's service to the next start. Each pause is twice the last one."""


class _NotifyingLink(LinkWrapper):
    """A link whose subscriptions call `notify` when a message has arrived."""

    def __init__(self, link: Link, notify: Callable[[], None]) -> None:
        super().__init__(link)
        self._notify = notify

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        def ring(message: Message) -> None:
            callback(message)
            self._notify()

        super().subscribe(channel, ring)


class Fleet:
    """A service for each present robot. One turn answers each robot that has a new message.

    An error in a robot's service ends only that service. It is logged and counted, and a new service starts after a
    pause. If the detector waits for another service, each robot has its own detector and thread, so that no robot
    waits for another robot's answer.
    """

    def __init__(
        self, config: VisionConfig, fleet_link: FleetLink, report: LogLine, detector: Detector | None = None
    ) -> None:
        """Create the fleet. `detector` (default: that of `config`) serves every robot without a separate detector."""
        self._config, self._fleet_link, self._report = config, fleet_link, report
        self._waits_for_service = waits_for_service(config)
        self._detector = detector or configured_detector(config)
        self._bell, self._ending = threading.Event(), threading.Event()
        self._threads: dict[str, threading.Thread] = {}
        self._links: dict[str, Link] = {}
        self._failed: deque[tuple[str, Exception]] = deque()
        """Errors of the threads of the robots."""
        self._starts_s: dict[str, float] = {}
        """Earliest start of the next service of a robot that failed."""
        self._restarts: Counter[str] = Counter()
        self.services: dict[str, Service] = {}
        fleet_link.on_new_robot(self._bell.set)

    def serve(self, ending: threading.Event, observe: Observe | None = None) -> None:
        """Serve until `ending` is set. `observe` receives the state."""
        state = ServingState(self.counts, ending, time.monotonic(),
                             lambda: not self._config.connect or self._fleet_link.connected)
        if observe is not None:
            observe(state)
        try:
            while state.turns():
                self._wait()
                self.turn()
        finally:
            self._end()
        for robot, service in self.services.items():
            skipped = dict(service.skipped) or "none"
            self._report(f"vision: {robot}: ended after {service.answered} frames; skipped: {skipped}")

    def _wait(self) -> None:
        self._bell.wait(_LONGEST_WAIT_S)
        self._bell.clear()

    def counts(self) -> list[ServiceCounts]:
        """Count the frames of each robot so far; from any thread."""
        services = list(self.services.items())
        return [replace(service.counts(), drives=not service.is_standby, restarts=self._restarts[robot])
                for robot, service in services]

    def turn(self) -> None:
        """Add new robots, and answer at most one frame of each robot without its own thread.

        So no robot waits longer than one round, even if another robot sends many frames. Raises ConfigError for an
        invalid configuration, which all robots share.
        """
        present = self._present()
        self._drop_left(present)
        self._add_new(present)
        for robot in present:
            if robot in self.services:
                self._attempt(robot, self._turn_of)
        while self._failed:
            self._on_error(*self._failed.popleft())

    def _drop_left(self, present: list[str]) -> None:
        """Drop robots that left, for a limited time per turn, see `_add_new`."""
        until_s = time.monotonic() + _CHANGES_FOR_S
        for robot in self._links.keys() - present:
            self._report_left(robot)
            self._drop(robot)
            self._starts_s.pop(robot, None)
            if time.monotonic() >= until_s:
                self._bell.set()
                return

    def _add_new(self, present: list[str]) -> None:
        """Add new robots for a limited time per turn. If a thousand come together, most wait for a later turn."""
        until_s = time.monotonic() + _CHANGES_FOR_S
        for robot in present:
            if robot not in self._links and time.monotonic() >= self._starts_s.get(robot, 0.0):
                self._attempt(robot, self._add_robot)
                if time.monotonic() >= until_s:
                    self._bell.set()
                    return

    def _attempt(self, robot: str, action: Callable[[str], None]) -> None:
        try:
            action(robot)
        except ConfigError:
            raise
        except Exception as error:
            self._failed.append((robot, error))

    def _report_left(self, robot: str) -> None:
        self._report(f"vision: {robot}: left")

    def _present(self) -> list[str]:
        """Return the robots to serve."""
        return self._fleet_link.robots()

    def _open(self, config: VisionConfig, link: Link, detector: Detector) -> Service:
        return open_service(config, link, self._report_of(config.robot), detector)

    def _on_message(self) -> None:
        self._bell.set()

    def _turn_of(self, robot: str) -> None:
        if not self._waits_for_service:
            self.services[robot].turn(0.0)

    def _on_error(self, robot: str, error: Exception) -> None:
        report_fault("vision", error, robot)
        self._drop(robot)
        pause_s = min(_FIRST_PAUSE_S * 2.0 ** min(self._restarts[robot], _DOUBLINGS), _LONGEST_PAUSE_S)
        self._restarts[robot] += 1
        self._starts_s[robot] = time.monotonic() + pause_s
        self._report(f"vision: {robot}: its service failed; a new one starts in {pause_s:.0f} s")

    def _drop(self, robot: str) -> None:
        """End the service of a robot. Its thread ends at its next turn."""
        self.services.pop(robot, None)
        self._threads.pop(robot, None)
        if link := self._links.pop(robot, None):
            link.close()

    def _add_robot(self, robot: str) -> None:
        config = self._config.model_copy(update={"robot": robot})
        link = self._links[robot] = self._fleet_link.link(robot)
        if not self._waits_for_service:
            notifying = _NotifyingLink(link, self._on_message)
            self.services[robot] = self._open(config, notifying, self._detector)
            return
        own = self._another_detector(config) if self.services else None
        service = self.services[robot] = self._open(config, link, own or self._detector)
        arguments = (robot, service, own)
        thread = threading.Thread(target=self._serve_one, args=arguments, name=f"vision {robot}", daemon=True)
        self._threads[robot] = thread
        thread.start()

    def _another_detector(self, config: VisionConfig) -> Detector:
        """Open the detector of one more robot. An error affects only that robot, because the first one has opened."""
        try:
            return configured_detector(config)
        except ConfigError as error:
            raise LinkError(str(error)) from error

    def _serve_one(self, robot: str, service: Service, own: Detector | None) -> None:
        """Run a robot's thread until its service is dropped, and close its `own` detector at the end."""
        try:
            with ExitStack() as ending:
                ending.callback(close_detector, own)
                while not self._ending.is_set() and self.services.get(robot) is service:
                    service.turn(_LONGEST_WAIT_S)
        except Exception as error:
            if self.services.get(robot) is service:
                self._failed.append((robot, error))
                self._bell.set()

    def _end(self) -> None:
        """End the threads of the robots together. It does not wait longer for a detector that hangs."""
        self._ending.set()
        until_s = time.monotonic() + _LONGEST_WAIT_S + self._config.detector.deadline_s
        for thread in self._threads.values():
            thread.join(max(0.0, until_s - time.monotonic()))

    def _report_of(self, robot: str) -> LogLine:
        return lambda line: self._report(line.replace("vision: ", f"vision: {robot}: ", 1))


# Several vision services that share robots. Shell; `sharing.py` decides.


_LONGEST_SHARED_WAIT_S = 0.02
_QUIET_US, _COUNTS_WITHIN_US = 30_000, 100_000
"""If the link ends, remote tokens end one after the other before the loss of the link is known, for 0.1 s with 200
robots. The end of a driver or service must count immediately, but not in that case. So it counts with the next message,
which shows that the link works. Without a message it counts after a time without further ends, or after a limit."""
_ROBOT_ENDS_AFTER_US, _MISSION_ENDS_AFTER_US = 500_000, 10_000_000
"""Time after which a robot without a token has left. A short loss of its link ends earlier. A robot with a requested
mission has longer, so that the mission continues, as it does without other services."""
_NEVER_US = 1 << 62
_LOOKS_EVERY_S, _TOKENS_COME_S = 60.0, 2.0
"""Time between two searches for robots of older releases, which have no token; and time for a new robot's token."""
_MAX_REPORTED = 256  # security limit: reported robots without a token
_HANDS_OVER_WITHIN_S = 0.6
_MAX_TOKENS = 20_000  # security limit: tokens for the next turn, and token ends that do not count yet


class SharedFleet(Fleet):
    """A fleet that drives its own robots and is standby for others, among other services of this kind."""

    def __init__(
        self, config: VisionConfig, fleet_link: FleetLink, report: LogLine, detector: Detector | None = None
    ) -> None:
        """Create the fleet, see `Fleet`. It is present from now on."""
        super().__init__(config, fleet_link, report, detector)
        self._tokens: deque[tuple[Token, bool, int]] = deque(maxlen=_MAX_TOKENS)
        """Token, presence, and time of the event."""
        self._ends_us: dict[Token, int] = {}
        """Tokens that ended -> end time, until the end counts."""
        self._newest_end_us = self._received_us = 0
        self._second_watch = SecondWatch(_MAX_TOKENS)
        self._end_second_watch: Callable[[], None] | None = None
        self._is_up, self._losses = True, fleet_link.losses
        self._statuses: dict[str, LatestSlot[Message]] = {}
        self._withdraw: dict[str, Callable[[], None]] = {}
        """Withdraws the driver token of a robot."""
        instance = secrets.token_hex(4)
        # The key of a token has three decimals.
        own = VisionToken(config.share.name or f"vision-{instance}", round(config.share.weight, 3), instance)
        named = () if set("*?") & set(config.robot) else (config.robot,)
        self.sharing = Sharing(own, named)
        self.sharing.on_link(True, monotonic_us())
        self._twin_reported = False
        fleet_link.watch_tokens(self._note)
        self._leave_services = fleet_link.declare_token(own)
        report(f"vision: shares robots as {own.name}, weight {own.weight:g}")

    def serve(self, ending: threading.Event, observe: Observe | None = None) -> None:
        """Serve until `ending` is set, see `Fleet`. Robots of older releases are reported."""
        threading.Thread(target=self._report_older, name="vision older robots", daemon=True).start()
        super().serve(ending, observe)

    def _report_older(self) -> None:
        """Report each robot without a token once, because no sharing service drives it."""
        reported: set[str] = set()
        while len(reported) < _MAX_REPORTED:
            found = [one for one in self._fleet_link.find_robots() - reported if one not in self.sharing.robots]
            if self._ending.wait(_TOKENS_COME_S):
                return
            for robot in found:
                if robot not in self.sharing.robots and fnmatchcase(robot, self._config.robot):
                    reported.add(robot)
                    self._report(f"vision: {robot}: not shared (no token); update it or pass --robot {robot}")
            if self._ending.wait(_LOOKS_EVERY_S):
                return

    def turn(self) -> None:
        """Decide the part in each robot, then serve the robots that this service drives."""
        now_us = monotonic_us()
        self._watch_link(now_us)
        self._take_tokens(now_us)
        self._recall_tokens(now_us)
        changed = self.sharing.step(now_us)
        super().turn()
        for robot, part in changed.items():
            self._log_part(robot, part)
        if self.sharing.has_twin and not self._twin_reported:
            self._twin_reported = True
            self._report(f"vision: another service is named {self.sharing.own.name}; it drives the robots. Give each "
                         "service its own --name")

    def _watch_link(self, now_us: int) -> None:
        """Note the loss and the return of the link to a router. Robots then have lost the driving sessions."""
        if self._config.listen:
            return
        if self._losses != self._fleet_link.losses:
            self._losses, self._is_up = self._fleet_link.losses, False
            self.sharing.on_link(False, now_us)
            self._take_tokens(now_us)
        if not self._is_up and self._fleet_link.connected:
            self._is_up = True
            self.sharing.on_link(True, now_us)
            for robot in tuple(self._withdraw):
                self._attempt(robot, self._drive_again)

    def _drive_again(self, robot: str) -> None:
        self._renew(robot)
        if not self.services[robot].is_standby:
            self._begin(self.services[robot])

    def _begin(self, service: Service) -> None:
        service.begin()
        self._bell.set()  # a frame may already wait

    def _take_tokens(self, now_us: int) -> None:
        """Process new tokens, and ends that count by now. While the link is lost, each end counts immediately."""
        while self._tokens:
            token, is_present, at_us = self._tokens.popleft()
            if is_present:
                is_back = self._ends_us.pop(token, None) is not None and self._is_up
                if is_back and isinstance(token, RobotToken) and token.robot in self._withdraw:
                    self._attempt(token.robot, self._drive_again)
                self.sharing.on_token(token, True, now_us)
            elif len(self._ends_us) < _MAX_TOKENS:
                self._ends_us[token] = self._newest_end_us = at_us
            else:
                self.sharing.on_token(token, False, now_us)
        for token in [one for one in self._ends_us if not self._is_up or self._counts_us(one) <= now_us]:
            del self._ends_us[token]
            self.sharing.on_token(token, False, now_us)

    def _counts_us(self, token: Token) -> int:
        """Return the time when the end of a token counts."""
        ended_us = self._ends_us[token]
        if not isinstance(token, RobotToken):
            if self._received_us > ended_us:
                return self._received_us
            return min(self._newest_end_us + _QUIET_US, ended_us + _COUNTS_WITHIN_US)
        if self.sharing.is_named(token.robot):
            return _NEVER_US
        service = self.services.get(token.robot)
        has_request = service is not None and service.has_request
        return ended_us + (_MISSION_ENDS_AFTER_US if has_request else _ROBOT_ENDS_AFTER_US)

    def _on_message(self) -> None:
        self._received_us = monotonic_us()
        super()._on_message()

    def _turn_of(self, robot: str) -> None:
        super()._turn_of(robot)
        now_us = monotonic_us()
        self._read_status(robot, self.services[robot], now_us)
        self._carry_out(robot, self.services[robot], now_us)

    def _end(self) -> None:
        """Hand over the robots, and end. An unclaimed robot applies its last command until it is too old."""
        self._leave_services()
        self.sharing.leave()
        until_s = time.monotonic() + _HANDS_OVER_WITHIN_S
        try:
            while self._withdraw and self.sharing.services() and time.monotonic() < until_s:
                self._wait()
                self.turn()
        finally:
            for robot in tuple(self._withdraw):
                self._withdraw_token(robot)
            super()._end()

    def _note(self, token: Token, is_present: bool) -> None:
        robot = token.robot if isinstance(token, RobotToken | DriverToken) else ""
        if not is_present:
            self._second_watch.on_end(token)
        if not robot or fnmatchcase(robot, self._config.robot):
            self._tokens.append((token, is_present, monotonic_us()))
            self._bell.set()

    def _recall_tokens(self, now_us: int) -> None:
        """Watch the tokens again, for a while, when there is room for ignored tokens."""
        if self._end_second_watch is not None and not self._second_watch.is_on(now_us):
            self._end_second_watch()
            self._end_second_watch = None
        if self._end_second_watch is None and self.sharing.needs_tokens():
            self._second_watch.begin(now_us)
            self._end_second_watch = self._fleet_link.watch_tokens(self._note_recalled)

    def _note_recalled(self, token: Token, is_present: bool) -> None:
        if is_present and self._second_watch.counts(token):
            self._note(token, True)

    def _wait(self) -> None:
        next_end_s = (min(map(self._counts_us, self._ends_us), default=_NEVER_US) - monotonic_us()) / 1e6
        self._bell.wait(min(max(0.001, next_end_s), _LONGEST_SHARED_WAIT_S))
        self._bell.clear()

    def _present(self) -> list[str]:
        return [name for name, robot in self.sharing.robots.items() if robot.part is not SharingPart.NONE]

    def _report_left(self, robot: str) -> None:
        self._report(f"vision: {robot}: {'has other services' if robot in self.sharing.robots else 'left'}")

    def _open(self, config: VisionConfig, link: Link, detector: Detector) -> Service:
        self._statuses[config.robot] = link.latest(STATUS)
        return open_service(config, link, self._report_of(config.robot), detector, is_standby=True)

    def _drop(self, robot: str) -> None:
        super()._drop(robot)
        self._statuses.pop(robot, None)
        self._withdraw_token(robot)

    def _read_status(self, robot: str, service: Service, now_us: int) -> None:
        message = self._statuses[robot].take()
        if message is None or robot not in self.sharing.robots:
            return
        try:
            stamp, status = decode(Stamp, message.header), decode(Status, message.payload, STATUS.max_payload_bytes)
        except WireError:
            return
        mine = LeaseHolder.of(SOURCE, service.sender.session) == status.holder
        self.sharing.on_status(robot, status, is_mine=mine, sent=service.sender.twists, now_us=now_us)
        self.sharing.robots[robot].is_busy = service.has_request
        if service.is_standby:
            service.note_status(stamp)
        elif self.sharing.needs_session(robot, now_us):
            self._renew(robot)

    def _carry_out(self, robot: str, service: Service, now_us: int) -> None:
        shared = self.sharing.robots.get(robot)
        part = shared.part if shared else SharingPart.NONE
        is_about_to_drive = self.sharing.is_about_to_drive(robot, now_us)
        if part is not SharingPart.DRIVE and not is_about_to_drive:
            service.rest()
        if is_about_to_drive:
            service.listen()  # before the token, so that this driver has frames when the former driver leaves
        if part in (SharingPart.CLAIM, SharingPart.DRIVE) and robot not in self._withdraw:
            self._renew(robot)
        if part is SharingPart.DRIVE and service.is_standby:
            self._begin(service)
        if part in (SharingPart.NONE, SharingPart.STANDBY):
            self._withdraw_token(robot)

    def _renew(self, robot: str) -> None:
        """Drive with a new session from now on. Its token is declared before its first command."""
        sender = DriverSession()
        token = DriverToken(robot, self.sharing.own.name, sender.proofs.token)
        self.sharing.add_own(token)
        withdraw = self._fleet_link.declare_token(token)
        self.services[robot].sender = sender
        self._withdraw_token(robot)
        self._withdraw[robot] = withdraw

    def _withdraw_token(self, robot: str) -> None:
        if withdraw := self._withdraw.pop(robot, None):
            withdraw()

    def _log_part(self, robot: str, part: SharingPart) -> None:
        if part is SharingPart.DRIVE:
            self._report(f"vision: {robot}: drives it")
        elif part is SharingPart.STANDBY:
            self._report(f"vision: {robot}: stands by")
