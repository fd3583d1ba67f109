"""Record the messages of a robot for `bench network`. Shell.

    python -m sightline.benchmarks.network.watch ENDPOINT FILE [statuses]

It runs on the robot's side of the wire, so that it puts no load on the wire, and acknowledges nothing. Written at
SIGTERM as JSON: frames (seq, t_us, latency_us, bytes), statuses (t_us and the fields of `NOTED`), and over Zenoh, where
peers receive each other's messages, twists (`received_us`, t_us of the frame). With `statuses` only statuses.
"""

import json
import signal
import sys
import threading
from pathlib import Path
from typing import Any, Final

from sightline.benchmarks.loop.ours import ROBOT
from sightline.protocol.channels import FRAME, STATUS, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.messages import AnswerHeader, FrameHeader, Stamp, Status
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.open import open_link

NOTED: Final = ("t_us", "state", "frame_age_us", "accepted", "stale", "window", "timeouts", "speed", "quality", "scale",
                "sent")


class Notes:
    """All received messages, undecoded."""

    def __init__(self) -> None:
        self.frames: list[tuple[bytes, int]] = []
        self.statuses: list[tuple[bytes, bytes]] = []
        self.twists: list[tuple[int, bytes]] = []
        self.received = threading.Event()

    def frame(self, message: Message) -> None:
        """Store only the header and the size of a frame."""
        self.frames.append((message.header, len(message.payload)))

    def twist(self, message: Message) -> None:
        """Store a twist with its arrival time, by the common clock of all processes of this machine."""
        self.twists.append((monotonic_us(), message.header))

    def status(self, message: Message) -> None:
        """Store a status undecoded, to decode it at the end."""
        self.statuses.append((message.header, message.payload))
        self.received.set()

    def decoded(self) -> dict[str, list[tuple[Any, ...]]]:
        """Return the contents of the file."""
        return {
            "frames": [_frame_row(header, size) for header, size in self.frames],
            "statuses": [_status_row(header, payload) for header, payload in self.statuses],
            "twists": [(at_us, _answered_us(header)) for at_us, header in self.twists],
        }


def _frame_row(header: bytes, size: int) -> tuple[Any, ...]:
    frame = decode(FrameHeader, header)
    return frame.seq, frame.t_us, frame.latency_us, size


def _answered_us(header: bytes) -> int:
    return decode(AnswerHeader, header).echo.t_us


def _status_row(header: bytes, payload: bytes) -> tuple[Any, ...]:
    status = decode(Status, payload, STATUS.max_payload_bytes)
    stream = status.stream
    return (
        decode(Stamp, header).t_us, status.state.value, status.frame_age_us, status.accepted,
        status.refused.get("STALE", 0), stream.window, stream.credit_timeouts, max(map(abs, status.applied)),
        stream.quality_percent, stream.scale_percent, stream.sent,
    )


def main(endpoint: str, path: Path, only: str = "") -> None:
    """Record until SIGTERM."""
    ending, notes = threading.Event(), Notes()
    signal.signal(signal.SIGTERM, lambda *_: ending.set())
    secure = str(path.parent) if endpoint.startswith("ws") else ""
    with open_link(ROBOT, connect=[endpoint], role="operator", secure=secure) as link:
        link.subscribe(STATUS, notes.status)
        if only != "statuses":
            link.subscribe(FRAME, notes.frame)
            if not secure:
                link.subscribe(TWIST, notes.twist)
        notes.received.wait()
        print("watching", flush=True)
        while not ending.wait(0.1):
            pass
    path.write_text(json.dumps(notes.decoded()), "utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), *sys.argv[3:])
