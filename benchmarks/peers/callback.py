"""Zenoh as its first example shows it: publish every image, compute in the subscriber's callback. Shell.

Default session but for the endpoint; shared memory is off, as for every contestant.
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
        tally.judge(int(t_us))

    with _session("listen", port) as session:
        session.declare_subscriber("peer/twist", on_command)
        pictures = session.declare_publisher("peer/frame")
        while True:
            time.sleep(film.next_in_s())
            t_us, jpeg = film.shoot()
            tally.capture(t_us)
            pictures.put(STAMP.pack(t_us) + jpeg)


def vision(eyes: Vision, port: int) -> None:
    """Answer the robot at `port`."""
    with _session("connect", port) as session:
        commands = session.declare_publisher("peer/twist")

        def on_frame(sample: zenoh.Sample) -> None:
            data = sample.payload.to_bytes()
            (t_us,) = STAMP.unpack_from(data)
            commands.put(f"{eyes.answer(t_us, data[STAMP.size :])}|{t_us}")

        session.declare_subscriber("peer/frame", on_frame)
        threading.Event().wait()
