"""Stand-ins for camera hardware: a V4L2 device behind OpenCV's interface, picamera2, and pictures to give."""

import sys
import threading
import time
import types
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from sightline.protocol.errors import HardwareError

FPS = 60.0


def jpeg(width_px: int = 640, height_px: int = 480, shade: int = 90) -> bytes:
    """A plain grey JPEG."""
    picture = np.full((height_px, width_px, 3), shade, np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes()


def video(path: Path, pictures: int = 20, fps: float = 30.0, size=(160, 120)) -> Path:
    """A film whose pictures brighten one by one, by ten steps each, and begin again."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), fps, size)
    for count in range(pictures):
        writer.write(np.full((size[1], size[0], 3), (10 * count + 10) % 256, np.uint8))
    writer.release()
    return path


class FakeDevice:
    """What is plugged in: its formats, its pictures, its clock, its faults. `open` is the seam of `V4l2Camera`."""

    def __init__(self, **changes) -> None:
        self.formats = ["MJPG", "YUYV"]
        self.sizes = [(640, 480), (320, 240)]
        self.present = True
        self.frozen = False
        self.starting_s = 0.0
        self.damage: Callable[[bytes], bytes] = lambda data: data
        self.clock: Callable[[], float] = time.monotonic
        self.opened: list[FakeCapture] = []
        self.grabbed = self.retrieved = 0
        for name, value in changes.items():
            setattr(self, name, value)

    def open(self, path: Path) -> "FakeCapture":
        if not self.present:
            raise HardwareError(f"camera {path} is not there")
        self.opened.append(FakeCapture(self))
        return self.opened[-1]

    def is_released(self) -> bool:
        return all(capture.released for capture in self.opened)


class FakeCapture:
    """Shaped like `cv2.VideoCapture` on V4L2: raw buffers once CONVERT_RGB is 0, as measured on a real one."""

    def __init__(self, device: FakeDevice) -> None:
        self.device = device
        self.props = {cv2.CAP_PROP_FOURCC: 0, cv2.CAP_PROP_CONVERT_RGB: 1}
        self.format, self.size = device.formats[-1], device.sizes[0]
        self.released = False
        self.using = threading.Lock()
        self.next_s = time.monotonic() + device.starting_s
        self.stamp_ms = 0.0
        self.count = 0

    def set(self, prop: int, value: float) -> bool:
        self.props[prop] = value
        if prop == cv2.CAP_PROP_FOURCC:
            wanted = "".join(chr(int(value) >> shift & 0xFF) for shift in (0, 8, 16, 24))
            self.format = wanted if wanted in self.device.formats else self.format
        wanted_size = (self.props.get(cv2.CAP_PROP_FRAME_WIDTH), self.props.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if wanted_size in self.device.sizes:
            self.size = wanted_size
        return True

    def get(self, prop: int) -> float:
        return {
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*self.format)),
            cv2.CAP_PROP_FRAME_WIDTH: float(self.size[0]),
            cv2.CAP_PROP_FRAME_HEIGHT: float(self.size[1]),
            cv2.CAP_PROP_POS_MSEC: self.stamp_ms,
        }[prop]

    def grab(self) -> bool:
        with self.using:
            assert not self.released, "used after release"
            if self.device.frozen:
                time.sleep(0.1)
                return False
            self.next_s = max(self.next_s + 1 / FPS, time.monotonic())
            time.sleep(max(0.0, self.next_s - time.monotonic()))
            if not self.device.present:
                return False
            self.stamp_ms = self.device.clock() * 1000
            self.count += 1
            self.device.grabbed += 1
            return True

    def retrieve(self):
        with self.using:
            assert not self.released, "used after release"
            self.device.retrieved += 1
            if self.props[cv2.CAP_PROP_CONVERT_RGB] != 0:
                return True, np.zeros((self.size[1], self.size[0], 3), np.uint8)
            if self.format == "YUYV":
                return True, np.full((self.size[1], self.size[0], 2), 128, np.uint8)
            data = self.device.damage(jpeg(*self.size, shade=self.count % 200))
            return True, np.frombuffer(data, np.uint8)[None]

    def release(self) -> None:
        with self.using:
            self.released = True


def install_fake_picamera2(monkeypatch, cameras: int = 1) -> "types.SimpleNamespace":
    """Modules `picamera2` and `libcamera`, shaped like the real ones; the encoder's thread gives JPEGs."""
    seen = types.SimpleNamespace(cameras=[], frozen=False)

    class Output:
        def outputframe(self, frame, keyframe=True, timestamp=None, packet=None, audio=None):
            raise NotImplementedError

    class MJPEGEncoder:
        def __init__(self, bitrate=None):
            self.bitrate, self.firsttimestamp = bitrate, None

    class Picamera2:
        @staticmethod
        def global_camera_info():
            return [{"Num": number} for number in range(cameras)]

        def __init__(self, index):
            self.index, self.closed = index, False
            self.running = threading.Event()
            seen.cameras.append(self)

        def create_video_configuration(self, main, controls, transform):
            return {"main": main, "controls": controls, "transform": transform}

        def configure(self, configuration):
            self.configuration = configuration

        def start_recording(self, encoder, output):
            self.thread = threading.Thread(target=self._run, args=(encoder, output), daemon=True)
            self.running.set()
            self.thread.start()

        def _run(self, encoder, output):
            while self.running.is_set():
                time.sleep(1 / FPS)
                sensor_us = time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000 - 5_000
                encoder.firsttimestamp = encoder.firsttimestamp or sensor_us
                if not seen.frozen:
                    picture = jpeg(*self.configuration["main"]["size"])
                    output.outputframe(picture, True, sensor_us - encoder.firsttimestamp, None, False)

        def stop_recording(self):
            self.running.clear()
            self.thread.join()

        def close(self):
            self.closed = True

    for name, content in {
        "picamera2": {"Picamera2": Picamera2},
        "picamera2.encoders": {"MJPEGEncoder": MJPEGEncoder},
        "picamera2.outputs": {"Output": Output},
        "libcamera": {"Transform": lambda **turned: turned},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    return seen
