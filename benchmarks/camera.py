"""`sightline bench camera`: what passing a camera's own JPEGs through costs the network process. Shell (processes).

`python -m sightline.benchmarks.camera SECONDS` is the measured process: the V4L2 plug-in with its thread, and the
network process's own logic from a capture to a frame that is ready for the link, and back to its credit. The device is
a stand-in behind the plug-in's own seam, paced and filled as a real one; what it takes itself is left out.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from sightline.benchmarks.loop.pictures import write_pictures
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError
from sightline.protocol.messages import Holder
from sightline.robot_side.hardware.cameras.v4l2 import V4l2Camera, V4l2CameraConfig
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.network.stream import StreamConfig
from sightline.robot_side.pipe import CommandAck

BOUND_MS: Final = 0.1
MISSED_BOUND: Final = 3
"""Of the frames that a camera gives in the time; a few may fall to others on a shared machine."""
_SIZE: Final = (640, 480)
_FPS: Final = 30.0
_WARM_UP: Final = 30
_ANSWER_US: Final = 5_000


@dataclass(frozen=True, slots=True)
class PassThrough:
    """Processor time per frame, of all threads, kernel included, less what the stand-in for the device takes alone.

    `cpu_ms`: until the network process has the JPEG. `ready_ms`: until its frame is ready for the link and its credit
    has come back. `missed` frames did not come.
    """

    cpu_ms: float
    ready_ms: float
    jpeg_bytes: float
    missed: float


def measure_camera(seconds: float) -> PassThrough:
    """Run the measured process. Raises HardwareError with its last words if it fails."""
    command = [sys.executable, "-P", "-m", "sightline.benchmarks.camera", f"{seconds:g}"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise HardwareError(f"the measured process ended ({done.returncode}): {done.stderr.strip()[-300:]}")
    return PassThrough(**json.loads(done.stdout))


class StandIn:
    """Shaped like `cv2.VideoCapture` on a V4L2 device that gives MJPG; one JPEG every tick, copied as out of a buffer.

    Expects OpenCV, as the plug-in does.
    """

    def __init__(self, jpegs: list[bytes]) -> None:
        import cv2

        self._fixed = {
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"MJPG")),
            cv2.CAP_PROP_FRAME_WIDTH: float(_SIZE[0]), cv2.CAP_PROP_FRAME_HEIGHT: float(_SIZE[1]),
        }
        self._jpegs = jpegs
        self._count = 0
        self._due_s = time.monotonic()

    def set(self, _name: int, _value: float) -> bool:
        """Everything that the plug-in asks for is so already."""
        return True

    def get(self, name: int) -> float:
        """What is fixed, or the time of the capture in milliseconds."""
        return self._fixed.get(name, self._due_s * 1000)

    def grab(self) -> bool:
        """Wait for the next tick."""
        self._due_s = max(self._due_s + 1 / _FPS, time.monotonic())
        time.sleep(max(0.0, self._due_s - time.monotonic()))
        self._count += 1
        return True

    def retrieve(self) -> tuple[bool, Any]:
        """The capture's bytes in an array of its own."""
        import numpy as np

        return True, np.frombuffer(self._jpegs[self._count % len(self._jpegs)], np.uint8).copy()[None]

    def release(self) -> None:
        """Nothing to give back."""


def _pass_through(seconds: float, jpegs: list[bytes]) -> PassThrough:
    """A third of the time each: the stand-in alone, through the plug-in, and on to a frame that is ready."""
    device_ms, _ = _cpu_ms(partial(_take_one, StandIn(jpegs)), seconds / 3)
    camera = V4l2Camera(V4l2CameraConfig(), lambda _: StandIn(jpegs))
    try:
        sending = NetworkCore(StreamConfig(max_fps=_FPS), "00000001", 0, 400_000)
        read_ms, missed = _cpu_ms(lambda: camera.read(1.0) is not None, seconds / 3)
        ready_ms, missed_ready = _cpu_ms(partial(_send_one, camera, sending), seconds / 3)
    finally:
        camera.close()
    bytes_each = sum(map(len, jpegs)) / len(jpegs)
    return PassThrough(read_ms - device_ms, ready_ms - device_ms, bytes_each, missed + missed_ready)


def _cpu_ms(one_frame: Callable[[], bool], seconds: float) -> tuple[float, float]:
    """Processor time per frame, of all threads, and how many frames did not come."""
    for _ in range(_WARM_UP):
        one_frame()
    began_ns, ends_s = time.process_time_ns(), time.monotonic() + seconds
    frames = 0
    while time.monotonic() < ends_s:
        frames += one_frame()
    return (time.process_time_ns() - began_ns) / 1e6 / max(1, frames), max(0.0, seconds * _FPS - frames)


def _take_one(device: StandIn) -> bool:
    """What the device itself costs, whoever reads it."""
    return device.grab() and device.retrieve()[0]


def _send_one(camera: V4l2Camera, sending: NetworkCore) -> bool:
    """As the network process does it; a peer answers after some milliseconds. Whether a frame was made ready."""
    picture = camera.read(1.0)
    now_us = monotonic_us()
    if picture is None or not sending.may_capture(now_us, listening=True):
        return False
    sent = sending.on_camera(picture, now_us)
    if sent is None:
        return False
    peer = Holder(source="vision", session="00000002")
    sending.on_judged(CommandAck(peer, sent[0].seq, _ANSWER_US, peer), now_us + _ANSWER_US)
    return True


def main(seconds: float) -> None:
    """Measure in this process and print the figures as JSON."""
    with TemporaryDirectory(prefix="sightline-camera-") as name:
        write_pictures(Path(name), *_SIZE)
        jpegs = [path.read_bytes() for path in sorted(Path(name).glob("*.jpg"))]
    seen = _pass_through(seconds, jpegs)
    print(json.dumps(asdict(seen)))


if __name__ == "__main__":
    main(float(sys.argv[1]))
