"""A minimal Sightline robot without Sightline: bare `websockets` or bare `zenoh`, printed wheels. Shell.

    python examples/minimal_robot.py ws 9090 examples/pictures       sightline vision --connect ws://127.0.0.1:9090
    python examples/minimal_robot.py zenoh 7447 examples/pictures    sightline vision --connect tcp/127.0.0.1:7447

Numbers in comments are clauses of protocol/README.md. What is left out: ranks, guests and losing a human (6.1, 6.2,
4.6), ramps, ten seconds of HOLD (6.3), the window (7.4: one frame), most checks of a header's fields (2.8), a latch
that survives a restart, tokens and certificates (13).
"""

import itertools
import json
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from minimal_gate import SESSION, Gate, Header, digest_of

ROBOT = "r1"
CAMERA = {"width_px": 320, "height_px": 240, "fx_px": 190.68, "fy_px": 190.68, "cx_px": 160.0, "cy_px": 120.0}
PERIOD_US = {"frame": 33_000, "status": 100_000, "camera": 500_000}
CREDIT_US = 500_000
Message = tuple[str, Header, bytes]


def now_us() -> int:
    return time.monotonic_ns() // 1000


class Robot:
    """Processes messages on any transport."""

    def __init__(self, pictures: list[bytes]) -> None:
        self.gate, self.pictures, self.lock = Gate(), itertools.cycle(pictures), threading.Lock()
        self.seq, self.due_us = Counter[str](), dict.fromkeys(PERIOD_US, 0)
        self.sent: tuple[int, int] | None = None  # the frame in flight, and its time: no credit (7.2)

    def due(self) -> Iterator[Message]:
        """Yield the messages that are due now."""
        now = now_us()
        if self.sent and now - self.sent[1] > CREDIT_US:  # 7.5
            self.sent = None
        for channel in [one for one, due in self.due_us.items() if now >= due and not (one == "frame" and self.sent)]:
            self.due_us[channel] = now + PERIOD_US[channel]
            header = self.stamp(channel, now)
            self.gate.issue(channel, header["seq"], now)
            if channel == "frame":
                header["applied"] = self.gate.wheels(now)
                self.sent = (header["seq"], now)
                yield channel, header, next(self.pictures)
            else:
                yield channel, header, json.dumps(CAMERA if channel == "camera" else self.gate.status(now)).encode()

    def stamp(self, channel: str, now: int) -> Header:
        self.seq[channel] += 1
        return {"v": 1, "session": SESSION, "seq": self.seq[channel], "t_us": now}

    def receive(self, channel: str, header: Header, payload: bytes) -> Iterator[Message]:
        """Handle a message. Yields the reply, if there is one."""
        with self.lock:
            if channel == "twist":
                self.gate.offer(header, payload, now_us())
            if channel in ("twist", "ack"):
                self.credit(header.get("echo"))
            if channel == "request":
                yield from self.answer(header, json.loads(payload))

    def credit(self, echo: Any) -> None:
        """Return the credit for a message that cites this frame or a newer one (7.2)."""
        ours = isinstance(echo, dict) and echo.get("session") == SESSION
        if ours and self.sent and self.sent[0] <= echo["seq"] <= self.seq["frame"]:
            self.sent = None

    def answer(self, header: Header, request: Header) -> Iterator[Message]:
        """Yield one reply to each valid request (8.1)."""
        now = now_us()
        wrong = self.gate.request(request["verb"], header, now)
        self.gate.refused[wrong.partition(":")[0]] += bool(wrong)
        to = digest_of(header["source"], header["session"])
        reply = {"to": to, "id": request["id"], "ok": not wrong, "detail": wrong or "done"}
        reply["state"] = self.gate.status(now)["state"]
        yield "reply", self.stamp("reply", now), json.dumps(reply).encode()


def unpack(message: bytes, role: str) -> Message:
    """Split a block with the channel in the header, or with a separate object for the channel (14.6)."""
    size = int.from_bytes(message[:2], "big")
    block = message[2 : 2 + size].decode()
    first, end = json.JSONDecoder().raw_decode(block)
    header = json.loads(block[end:]) if block[end:].strip() else first
    if len(block) != size or size > 576:
        raise ValueError("a block that is cut or too long")
    return first["channel"], {"source": first.get("source", role), **header}, message[2 + size :]


def serve_websocket(robot: Robot, port: int) -> None:
    """Serve one client at a time (clause 14)."""
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.server import ServerConnection, serve
    from websockets.typing import Subprotocol

    busy = threading.Lock()

    def send_all(connection: ServerConnection, messages: Iterator[Message]) -> None:
        for channel, header, payload in messages:
            block = json.dumps({"channel": channel, **header}, separators=(",", ":")).encode()  # 14.6
            connection.send(len(block).to_bytes(2, "big") + block + payload)

    def talk(connection: ServerConnection) -> None:
        hello = json.loads(connection.recv(timeout=2))  # 14.5
        if hello.get("v", 1) != 1 or hello.get("robot") != ROBOT:
            connection.close(1008, f"this is robot {ROBOT}, protocol 1")
            return
        wants = ["twist", "ack", "request"]
        connection.send(json.dumps({"v": 1, "robot": ROBOT, "role": "robot", "session": SESSION, "wants": wants}))
        while True:
            send_all(connection, robot.due())
            try:
                message = connection.recv(timeout=0.005)
            except TimeoutError:
                continue
            if isinstance(message, bytes):  # a text is a new hello, which changes nothing for this robot
                try:
                    send_all(connection, robot.receive(*unpack(message, hello.get("role", ""))))
                except (KeyError, RecursionError, TypeError, ValueError):
                    robot.gate.refused["MALFORMED"] += 1

    def handle(connection: ServerConnection) -> None:
        if not busy.acquire(blocking=False):
            connection.close(1001, "one client at a time; connect again")
            return
        try:
            with suppress(ConnectionClosed, TimeoutError, AttributeError, RecursionError, TypeError, ValueError):
                talk(connection)
        finally:
            busy.release()

    serve(
        handle, "127.0.0.1", port, subprotocols=[Subprotocol("sightline.v1")], origins=[None], compression=None,
        max_size=2048, open_timeout=2, ping_interval=1, ping_timeout=1, close_timeout=1,
    ).serve_forever()  # fmt: skip


def serve_zenoh(robot: Robot, port: int) -> None:
    """Serve on Zenoh (clause 16)."""
    import zenoh

    prefix = f"sightline/{ROBOT}/"
    config = {"mode": "router", "listen": {"endpoints": [f"tcp/127.0.0.1:{port}"]},
              "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}}}
    encoding = {"frame": zenoh.Encoding.IMAGE_JPEG}

    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
        def send_all(messages: Iterator[Message]) -> None:
            for channel, header, payload in messages:
                session.put(prefix + channel, payload, attachment=json.dumps(header).encode(),
                            encoding=encoding.get(channel, zenoh.Encoding.APPLICATION_JSON),
                            congestion_control=zenoh.CongestionControl.DROP)

        def on_sample(sample: zenoh.Sample) -> None:
            channel, _, source = str(sample.key_expr).removeprefix(prefix).partition("/")
            try:
                header = json.loads(sample.attachment.to_bytes()) if sample.attachment else {}
                if header.get("source") == source:  # 1.3
                    send_all(robot.receive(channel, header, sample.payload.to_bytes()))
            except (AttributeError, KeyError, RecursionError, TypeError, ValueError):
                robot.gate.refused["MALFORMED"] += 1

        subscribers = [session.declare_subscriber(f"{prefix}{one}/*", on_sample) for one in ("twist", "ack", "request")]
        frames = session.declare_publisher(prefix + "frame")
        while subscribers:
            if frames.matching_status:  # 3.4: without a subscriber, no frame is sent
                send_all(robot.due())
            time.sleep(0.005)


def main() -> None:
    if len(sys.argv) != 4 or sys.argv[1] not in ("ws", "zenoh") or not sys.argv[2].isdecimal():
        sys.exit(__doc__)
    kind, port, folder = sys.argv[1:]
    robot = Robot([path.read_bytes() for path in sorted(Path(folder).glob("*.jpg"))])
    carry = {"ws": serve_websocket, "zenoh": serve_zenoh}[kind]
    threading.Thread(target=carry, args=(robot, int(port)), daemon=True).start()
    before = (0.0, 0.0)
    while True:  # the wheels have a separate loop: whatever the network does, they stop
        wheels = robot.gate.wheels(now_us())
        if wheels != before:
            print(f"wheels {wheels[0]:.3f} {wheels[1]:.3f}", flush=True)
            before = wheels
        time.sleep(0.02)


if __name__ == "__main__":
    main()
