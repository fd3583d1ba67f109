"""Zenoh without Sightline's protocol: publish every image, and three common ways to receive them. Shell.

`callback` computes in the subscriber's callback, as the example `z_sub` of github.com/eclipse-zenoh/zenoh-python at
116b38cd does. `ring` reads a ring channel of one image, which drops the older one, as the example `z_pull` there; that
one polls, `ring` waits. `newest` keeps the newest image in a variable and computes outside the callback, as
`computer-vision/object-detection` of github.com/eclipse-zenoh/zenoh-demos at c7d28557 does; there a pause of 50 ms
comes after each image, here the callback wakes the computation.

The session has defaults except for the endpoint; shared memory is off, as for every contestant.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from typing import TYPE_CHECKING, Final

import zenoh

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

STAMP: Final = struct.Struct("<Q")
FRAME: Final = "peer/frame"


def _session(where: str, port: int) -> zenoh.Session:
    return zenoh.open(
        zenoh.Config.from_json5(
            json.dumps(
                {
                    where: {"endpoints": [f"tcp/127.0.0.1:{port}"]},
                    "scouting": {"multicast": {"enabled": False}},
                    "transport": {"shared_memory": {"enabled": False}},
                }
            )
        )
    )


def robot(film: RecordedFrames, tally: Tally, port: int) -> None:
    """Publish images and listen for commands."""

    def on_command(sample: zenoh.Sample) -> None:
        linear, angular, t_us = sample.payload.to_string().split("|")
        float(linear), float(angular)
        tally.validate(int(t_us))

    with _session("listen", port) as session:
        session.declare_subscriber("peer/twist", on_command)
        pictures = session.declare_publisher(FRAME)
        while True:
            time.sleep(film.next_in_s())
            t_us, jpeg = film.shoot()
            tally.capture(t_us)
            pictures.put(STAMP.pack(t_us) + jpeg)


class _Answers:
    """Computes and publishes the answer to an image."""

    def __init__(self, detector: Vision, session: zenoh.Session) -> None:
        self._detector = detector
        self._commands = session.declare_publisher("peer/twist")

    def send(self, sample: zenoh.Sample) -> None:
        data = sample.payload.to_bytes()
        (t_us,) = STAMP.unpack_from(data)
        self._commands.put(f"{self._detector.answer(t_us, data[STAMP.size :])}|{t_us}")


def callback(detector: Vision, port: int) -> None:
    """Answer the robot at `port` in the callback."""
    with _session("connect", port) as session:
        session.declare_subscriber(FRAME, _Answers(detector, session).send)
        threading.Event().wait()


def ring(detector: Vision, port: int) -> None:
    """Answer the newest image of the channel."""
    with _session("connect", port) as session:
        answers = _Answers(detector, session)
        frames = session.declare_subscriber(FRAME, zenoh.handlers.RingChannel(1))
        while True:
            answers.send(frames.recv())


def newest(detector: Vision, port: int) -> None:
    """Answer the newest image outside the callback."""
    with _session("connect", port) as session:
        answers, arrived, kept = _Answers(detector, session), threading.Event(), {}

        def keep(sample: zenoh.Sample) -> None:
            kept["frame"] = sample
            arrived.set()

        session.declare_subscriber(FRAME, keep)
        while arrived.wait():
            arrived.clear()
            answers.send(kept["frame"])
