"""Many robots in one process, for `bench network`: real sessions, real headers and credit, recorded images. Shell.

    python -m sightline.benchmarks.network.robots SETTINGS_AS_JSON

Forty robots with two processes each would overload two cores. Each robot here has its session, its
credit and its 10 Hz status; without a driver it counts every answer as accepted. Ages are from capture to the
answer's arrival. Written at SIGTERM as JSON: for each robot the answers (captured_us, age_us).
"""

import json
import secrets
import signal
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from random import Random
from typing import Any

from sightline.benchmarks.loop.pictures import camera_of
from sightline.protocol.channels import ACK, FRAME, STATUS, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import Config
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import AnswerHeader, Holder, Stamp, State, Status
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.network.stream import StreamConfig
from sightline.robot_side.pipe import CommandAck
from sightline.robot_side.ports import Picture

_STATUS_US = 100_000
_CONNECT_S = 15.0


class Settings(Config):
    """Number, rate, images and endpoints of the robots."""

    endpoint: str
    """Several are separated by commas."""
    robots: int
    fps: float
    pictures: Path
    notes: Path
    seed: int
    first: int = 1
    """Number of the first robot."""
    pause_s: float = 1.0
    """From the start to the first image."""


class PlayedRobot:
    """One robot. `play` does the due work and returns the time of its next call."""

    def __init__(self, name: str, link: Link, settings: Settings, due_us: int) -> None:
        self.name = name
        self.answers: list[tuple[int, int]] = []
        self._link = link
        self._jpegs = [path.read_bytes() for path in sorted(settings.pictures.glob("*.jpg"))]
        size = read_jpeg_size(self._jpegs[0])
        self._model = camera_of(size.width_px, size.height_px)
        self._session = secrets.token_hex(4)
        self._network_core = NetworkCore(StreamConfig(max_fps=settings.fps), self._session, 0, FRAME.max_payload_bytes)
        self._lock = threading.Lock()
        self._period_us = round(1e6 / settings.fps)
        self._due_us, self._status_due_us = due_us, 0
        self._ticks = self._statuses = 0
        for channel in (TWIST, ACK):
            link.subscribe(channel, self._on_answer)

    @property
    def record(self) -> Any:
        """Return the record of this robot."""
        return self.answers

    def play(self, at_us: int) -> int:
        """Publish an image when it is due and has credit, and a status ten times a second."""
        if at_us >= self._due_us:
            self._due_us += self._period_us
            self._ticks += 1
            self._see(at_us)
        if at_us >= self._status_due_us:
            self._status_due_us = at_us + _STATUS_US
            self._publish(at_us)
        return min(self._due_us, self._status_due_us)

    def _see(self, at_us: int) -> None:
        with self._lock:
            if not self._network_core.may_capture(at_us, self._link.has_listener(FRAME)):
                return
            sent = self._network_core.on_camera(Picture(self._jpegs[self._ticks % len(self._jpegs)], at_us), at_us)
            camera = self._network_core.announce_camera(self._model, at_us)
            if sent is not None:
                self._on_sent(sent[0].seq, at_us)
        for message in (camera, sent and sent[1]):
            if message is not None:
                self._link.publish(message.channel, message.header, message.payload)

    def _on_sent(self, seq: int, t_us: int) -> None:
        """Record a frame before it is sent."""

    def _publish(self, at_us: int) -> None:
        self._statuses += 1
        with self._lock:
            stream = self._network_core.status(at_us)
        stamp = Stamp(session=self._session, seq=self._statuses, t_us=at_us)
        self._link.publish(STATUS, encode(stamp), encode(Status(state=State.ACTIVE, reason="played", stream=stream)))

    def _on_answer(self, message: Message) -> None:
        at_us, header = monotonic_us(), decode(AnswerHeader, message.header)
        if header.echo.session != self._session:
            return
        who = Holder(source=header.source, session=header.session)
        with self._lock:
            self._network_core.on_command_ack(CommandAck(who, header.echo.seq, header.compute_us, who), at_us)
        self.answers.append((header.echo.t_us, at_us - header.echo.t_us))


def main(settings: Settings, kind: "type[PlayedRobot]" = PlayedRobot) -> None:
    """Play robots of `kind` until SIGTERM, and write their records."""
    ending, chance = threading.Event(), Random(settings.seed)
    signal.signal(signal.SIGTERM, lambda *_: ending.set())
    with ExitStack() as links:
        begin_us = monotonic_us() + round(settings.pause_s * 1e6)
        robots = [
            kind(name, links.enter_context(
                open_link(name, connect=settings.endpoint.split(","), role="robot", timeout_s=_CONNECT_S)
            ), settings, begin_us + round(chance.random() * 1e6 / settings.fps))
            for name in (f"r{number}" for number in range(settings.first, settings.first + settings.robots))
        ]
        print(f"playing {len(robots)} robots", flush=True)
        play(robots, ending)
    settings.notes.write_text(json.dumps({robot.name: robot.record for robot in robots}), "utf-8")


def play(robots: Sequence[PlayedRobot], ending: threading.Event) -> None:
    """Let every robot do its due work until `ending` is set."""
    while not ending.is_set():
        due_us = min(robot.play(monotonic_us()) for robot in robots)
        time.sleep(max(0, due_us - monotonic_us()) / 1e6)


if __name__ == "__main__":
    main(Settings.model_validate_json(sys.argv[1]))
