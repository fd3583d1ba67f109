"""One WebSocket request per image, as openpi does it: the robot sends it, waits, and applies the answer. Shell.

The vision is an asyncio server that computes inside its handler; compression is off and messages are binary, as in
`packages/openpi-client/src/openpi_client/websocket_client_policy.py` and
`src/openpi/serving/websocket_policy_server.py` of github.com/Physical-Intelligence/openpi at 15a9616a. openpi
packs the fields with msgpack, this file with `struct`.
"""

from __future__ import annotations

import asyncio
import struct
import time
from typing import TYPE_CHECKING, Final

from websockets.asyncio.server import ServerConnection, serve
from websockets.sync.client import connect

if TYPE_CHECKING:
    from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

STAMP: Final = struct.Struct("<Q")
ANSWER: Final = struct.Struct("<Qdd")


def robot(film: RecordedFrames, tally: Tally, port: int) -> None:
    """Send one image at a time to the vision service at `port`."""
    connection = connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None)
    while True:
        time.sleep(film.next_in_s())
        t_us, jpeg = film.shoot()
        tally.capture(t_us)
        connection.send(STAMP.pack(t_us) + jpeg)
        answer = connection.recv()
        ANSWER.unpack(answer if isinstance(answer, bytes) else answer.encode())
        tally.validate(t_us)


def vision(detector: Vision, port: int) -> None:
    """Serve answers at `port`."""
    asyncio.run(_serve(detector, port))


async def _serve(detector: Vision, port: int) -> None:
    async def handle(connection: ServerConnection) -> None:
        async for message in connection:
            data = message if isinstance(message, bytes) else message.encode()
            (t_us,) = STAMP.unpack_from(data)
            linear, angular = detector.answer(t_us, data[STAMP.size :]).split("|")
            await connection.send(ANSWER.pack(t_us, float(linear), float(angular)))

    async with serve(handle, "127.0.0.1", port, compression=None, max_size=None) as server:
        await server.serve_forever()
