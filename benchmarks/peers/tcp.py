"""A bare TCP exchange: length and stamp, JPEG out; a line of text back. Shell.

The robot sends from one thread and receives in another; the vision service answers one image at a time. It follows no
project: it is the shortest code with Python's `socket` module.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from typing import IO, TYPE_CHECKING, Final

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

HEAD: Final = struct.Struct("<IQ")
"""Size of the JPEG, and the capture time in microseconds, which identifies the answer."""


def robot(film: RecordedFrames, tally: Tally, port: int) -> None:
    """Serve one vision service."""
    with socket.create_server(("127.0.0.1", port)) as server:
        connection, _ = server.accept()
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    threading.Thread(target=_listen, args=(connection.makefile("rb"), tally), name="twists", daemon=True).start()
    while True:
        time.sleep(film.next_in_s())
        t_us, jpeg = film.shoot()
        tally.capture(t_us)
        connection.sendall(HEAD.pack(len(jpeg), t_us) + jpeg)


def _listen(lines: IO[bytes], tally: Tally) -> None:
    for line in lines:
        linear, angular, t_us = line.split(b"|")
        float(linear), float(angular)
        tally.validate(int(t_us))


def vision(detector: Vision, port: int) -> None:
    """Answer the robot at `port`."""
    connection = socket.create_connection(("127.0.0.1", port))
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    frames = connection.makefile("rb")
    while True:
        size, t_us = HEAD.unpack(frames.read(HEAD.size))
        answer = detector.answer(t_us, frames.read(size))
        connection.sendall(f"{answer}|{t_us}\n".encode())
