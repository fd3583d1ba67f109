"""Run a minimal vision service without Sightline: bare `websockets` or bare `zenoh`. Add your detector in `look`.
Shell.

    sightline robot --listen ws://127.0.0.1:9090      python examples/minimal_vision.py ws://127.0.0.1:9090
    sightline robot --listen tcp/127.0.0.1:7447       python examples/minimal_vision.py tcp/127.0.0.1:7447

Numbers in comments are clauses of protocol/README.md. What is left out: the camera's model (10.1), most checks of a
header's fields (2.8), tokens and certificates (13), and the proofs that a robot with keys needs (6.6).
"""

import itertools
import json
import queue
import secrets
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

ROBOT, SOURCE, SESSION = "r1", "vision", secrets.token_hex(4)
MAX_PIXELS = 1920 * 1080
OTHER_SOF = {*range(0xC3, 0xD0)} - {0xC4, 0xC8, 0xCC}  # lossless, arithmetic ...: not supported (3.1)
COUNT = itertools.count(1)  # for all connections: one session, one count (2.5)
Header = dict[str, Any]
Answer = Callable[[str, Header, bytes], None]


def look(jpeg: bytes) -> tuple[float, float] | None:
    """Map an image to (m/s, rad/s), or to None to acknowledge it only. This one turns slowly on the spot."""
    width, height = jpeg_size(jpeg)
    return (0.0, 0.3) if 0 < width * height <= MAX_PIXELS else None  # 3.2: before any decoder reads it


def jpeg_size(jpeg: bytes) -> tuple[int, int]:
    """Read width and height from the frame header. Returns (0, 0) without one within 64 segments."""
    at = 2 if jpeg[:2] == b"\xff\xd8" else len(jpeg)
    for _ in range(64):
        kind, body = jpeg[at : at + 2], jpeg[at + 4 : at + 10]  # bits, height, width, components
        if kind in (b"\xff\xc0", b"\xff\xc1", b"\xff\xc2"):
            plain = len(body) == 6 and body[0] == 8 and body[5] in (1, 3)
            return (int.from_bytes(body[3:5], "big"), int.from_bytes(body[1:3], "big")) if plain else (0, 0)
        length = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if kind[:1] != b"\xff" or length < 2 or kind[1:] == b"\xda" or kind[1] in OTHER_SOF:
            return 0, 0
        at += 2 + length
    return 0, 0


def unpack(message: bytes) -> tuple[Header, bytes]:
    """Split a block with the channel in the header, or with a separate object for the channel (14.6)."""
    size = int.from_bytes(message[:2], "big")
    block = message[2 : 2 + size].decode()
    first, end = json.JSONDecoder().raw_decode(block)
    header = json.loads(block[end:]) if block[end:].strip() else first
    return {**header, "channel": first["channel"]}, message[2 + size :]


class Vision:
    """Answers each frame once: with a twist that cites it, or with an ack (4.5, 7.1)."""

    def __init__(self, answer: Answer) -> None:
        self.answer, self.robot_session, self.last, self.received_us = answer, "", (-1, -1), 0
        self.over: list[str] = []  # 2.5: earlier sessions of the robot, the newest first

    def frame(self, header: Header, jpeg: bytes) -> None:
        started = time.monotonic_ns()
        session, now = header["session"], (header["seq"], header["t_us"])
        if header.get("v", 1) != 1 or any(type(one) is not int or not 0 <= one < 2**53 for one in now):  # 2.2, 2.4
            return
        silent_us = started // 1000 - self.received_us
        newer = now[0] > self.last[0] and 0 < now[1] - self.last[1] <= silent_us + 500_000  # 2.6: nor of the future
        newer |= session not in {self.robot_session, *self.over} or silent_us > 500_000
        twist = look(jpeg) if newer else None
        if newer:
            self.over = [one for one in dict.fromkeys([self.robot_session, *self.over]) if one != session][:8]
            self.robot_session, self.last, self.received_us = session, now, started // 1000
        echo = {"channel": "frame", **{name: header[name] for name in ("session", "seq", "t_us")}}  # 2.7
        stamp = {"v": 1, "source": SOURCE, "session": SESSION, "seq": next(COUNT), "echo": echo,
                 "compute_us": (time.monotonic_ns() - started) // 1000}
        text = b"" if twist is None else f"{twist[0]:.4f}|{twist[1]:.4f}".encode()  # 4.1, 4.2
        self.answer("ack" if twist is None else "twist", stamp, text)


def run_websocket(url: str) -> None:
    """Run on a WebSocket (clause 14)."""
    from websockets.sync.client import connect
    from websockets.typing import Subprotocol

    protocols = [Subprotocol("sightline.v1")]
    with connect(url, subprotocols=protocols, compression=None, max_size=1_100_000, proxy=None,
                 ping_interval=1, ping_timeout=1) as robot:
        def answer(channel: str, header: Header, payload: bytes) -> None:
            block = json.dumps({"channel": channel, **header}, separators=(",", ":")).encode()
            robot.send(len(block).to_bytes(2, "big") + block + payload)

        vision = Vision(answer)
        robot.send(json.dumps({"v": 1, "robot": ROBOT, "role": SOURCE, "session": SESSION, "wants": ["frame"]}))
        print("robot sent", robot.recv(timeout=2), flush=True)
        for message in robot:
            if isinstance(message, bytes):
                with suppress(KeyError, RecursionError, TypeError, ValueError):  # an invalid message ends nothing
                    header, payload = unpack(message)
                    if header["channel"] == "frame":
                        vision.frame(header, payload)


def run_zenoh(endpoint: str) -> None:
    """Run on Zenoh (clause 16). Its thread stores only the newest frame, and `look` reads it (1.5)."""
    import zenoh

    prefix = f"sightline/{ROBOT}/"
    config = {"mode": "client", "connect": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    newest: queue.Queue[zenoh.Sample] = queue.Queue(1)

    def put(sample: zenoh.Sample) -> None:
        with suppress(queue.Empty):
            newest.get_nowait()
        with suppress(queue.Full):
            newest.put_nowait(sample)

    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        def answer(channel: str, header: Header, payload: bytes) -> None:
            session.put(f"{prefix}{channel}/{SOURCE}", payload, attachment=json.dumps(header).encode(), express=True,
                        congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.REAL_TIME)

        vision, frames = Vision(answer), session.declare_subscriber(f"{prefix}frame", put)
        while frames:
            sample = newest.get()
            if str(sample.key_expr) == f"{prefix}frame" and sample.attachment:  # 1.3
                with suppress(KeyError, RecursionError, TypeError, ValueError):
                    vision.frame(json.loads(sample.attachment.to_bytes()), sample.payload.to_bytes())


def main() -> None:
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    if not sys.argv[1].startswith("ws"):
        run_zenoh(sys.argv[1])
    from websockets.exceptions import WebSocketException

    while True:  # 14.8
        with suppress(OSError, TimeoutError, WebSocketException):
            run_websocket(sys.argv[1])
        time.sleep(0.5)


if __name__ == "__main__":
    main()
