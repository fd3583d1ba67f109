"""Run the pattern of the legacy article: base64 text over WebSocket, every second image, commands every 55.1 ms. Shell.

The robot's server uses asyncio here; that of the article polled every 100 ms and was even slower. The vision
function stores the newest text in a variable, which its main loop polls without a pause, as in the article.
"""

from __future__ import annotations

import asyncio
import base64
import threading
import time
from typing import TYPE_CHECKING, Final

from websockets.asyncio.server import ServerConnection, serve
from websockets.sync.client import ClientConnection, connect

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

COMMAND_PERIOD_S: Final = 0.0551


class RepeatedCommand:
    """The newest command, which a thread sends to the motors repeatedly."""

    def __init__(self, tally: Tally) -> None:
        self.command = ""
        self._tally = tally
        threading.Thread(target=self._run, name="peer", daemon=True).start()

    def _run(self) -> None:
        done = ""
        while True:
            time.sleep(COMMAND_PERIOD_S)
            command = self.command
            if command != done:
                done = command
                linear, angular, t_us = command.split("|")
                float(linear), float(angular)
                self._tally.validate(int(t_us))


def robot(film: RecordedFrames, tally: Tally, port: int) -> None:
    """Serve images to each client."""
    asyncio.run(_serve(film, tally, port))


async def _serve(film: RecordedFrames, tally: Tally, port: int) -> None:
    clients: set[ServerConnection] = set()
    wheels = RepeatedCommand(tally)

    async def receive(client: ServerConnection) -> None:
        clients.add(client)
        async for text in client:
            wheels.command = str(text)

    async with serve(receive, "127.0.0.1", port):
        odd = False
        while True:
            await asyncio.sleep(film.next_in_s())
            t_us, jpeg = film.shoot()
            tally.capture(t_us)
            odd = not odd
            for client in clients if odd else ():
                await client.send(f"{t_us} {base64.encodebytes(jpeg).decode()}")


class Newest:
    """The newest text, and whether it was processed."""

    def __init__(self, connection: ClientConnection) -> None:
        self.text = ""
        self.processed = True
        self._connection = connection
        threading.Thread(target=self._run, name="peer", daemon=True).start()

    def _run(self) -> None:
        for message in self._connection:
            self.text, self.processed = str(message), False


def vision(detector: Vision, port: int) -> None:
    """Answer the robot at `port`."""
    connection = connect(f"ws://127.0.0.1:{port}", compression=None)
    newest = Newest(connection)
    while True:
        if newest.processed:
            continue
        stamp, _, picture = newest.text.partition(" ")
        newest.processed = True
        answer = detector.answer(int(stamp), base64.decodebytes(picture.encode()))
        connection.send(f"{answer}|{stamp}")
