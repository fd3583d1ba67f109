"""`Fleet`: one service for each robot of a fleet, in fair turns. Shell.

    sightline vision --robot 'r*' --listen tcp/0.0.0.0:7447
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack

from sightline.protocol.channels import Channel
from sightline.protocol.log import report_fault
from sightline.protocol.transports.link import FleetLink, Link, LinkWrapper, Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.plugin_calls import close_detector
from sightline.vision_side.detect.port import Detector
from sightline.vision_side.detect.registry import configured_detector, waits_for_service
from sightline.vision_side.serving.service import LogLine, Service, ServiceCounts, open_service

_LONGEST_WAIT_S = 0.2


class _NotifyingLink(LinkWrapper):
    """A link whose subscriptions set `bell` when a message has arrived."""

    def __init__(self, link: Link, bell: threading.Event) -> None:
        super().__init__(link)
        self._bell = bell

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        def ring(message: Message) -> None:
            callback(message)
            self._bell.set()

        super().subscribe(channel, ring)


class Fleet:
    """A service for each robot that is received. One turn gives every robot with something new its turn.

    With a detector that waits for another service, each robot has its own detector and thread: an answer that one of
    them waits for keeps no other waiting.
    """

    def __init__(
        self, config: VisionConfig, fleet_link: FleetLink, report: LogLine, detector: Detector | None = None
    ) -> None:
        """Create the fleet. `detector` (default: that of `config`) serves every robot that has no separate one."""
        self._config, self._fleet_link, self._report = config, fleet_link, report
        self._waits_for_service = waits_for_service(config)
        self._detector = detector or configured_detector(config)
        self._bell, self._ending = threading.Event(), threading.Event()
        self._threads: list[threading.Thread] = []
        self._failed: Exception | None = None
        self.services: dict[str, Service] = {}
        fleet_link.on_new_robot(self._bell.set)

    def serve(self, ending: threading.Event) -> None:
        """Serve until `ending` is set."""
        try:
            while not ending.is_set():
                self._bell.wait(_LONGEST_WAIT_S)
                self._bell.clear()
                self.turn()
        finally:
            self._end()
        if self._failed is not None:  # in closing
            raise self._failed
        for robot, service in self.services.items():
            skipped = dict(service.skipped) or "none"
            self._report(f"vision: {robot}: ended after {service.answered} frames; skipped: {skipped}")

    def counts(self) -> list[ServiceCounts]:
        """Count the frames of each robot so far; from any thread."""
        return [service.counts() for service in list(self.services.values())]

    def turn(self) -> None:
        """Add new robots, and answer at most one frame of each robot without a thread of its own.

        So no robot waits longer than one round, however many frames another one sends.
        """
        for robot in self._fleet_link.robots():
            if robot not in self.services:
                self._add_robot(robot)
            if not self._waits_for_service:
                self.services[robot].turn(0.0)
        if self._failed is not None:
            raise self._failed

    def _add_robot(self, robot: str) -> None:
        config = self._config.model_copy(update={"robot": robot})
        link = self._fleet_link.link(robot)
        if not self._waits_for_service:
            notifying = _NotifyingLink(link, self._bell)
            self.services[robot] = open_service(config, notifying, self._report_of(robot), self._detector)
            return
        own = configured_detector(config) if self.services else None
        service = self.services[robot] = open_service(config, link, self._report_of(robot), own or self._detector)
        thread = threading.Thread(target=self._serve_one, args=(service, own), name=f"vision {robot}", daemon=True)
        self._threads.append(thread)
        thread.start()

    def _serve_one(self, service: Service, own: Detector | None) -> None:
        """Run a robot's thread, and close its `own` detector at the end. An error ends the whole fleet."""
        try:
            with ExitStack() as ending:
                ending.callback(close_detector, own)
                while not self._ending.is_set():
                    service.turn(_LONGEST_WAIT_S)
        except Exception as error:
            report_fault("vision", error)
            self._failed = error
            self._bell.set()

    def _end(self) -> None:
        """End the robots' threads together; one whose detector hangs is left behind."""
        self._ending.set()
        until_s = time.monotonic() + _LONGEST_WAIT_S + self._config.detector.deadline_s
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))

    def _report_of(self, robot: str) -> LogLine:
        return lambda line: self._report(line.replace("vision: ", f"vision: {robot}: ", 1))
