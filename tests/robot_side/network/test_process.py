"""The network process: the driver process knows a frame before it leaves, and one thread at a time uses the credit."""

import itertools
import signal
import socket
import subprocess
import sys
import zlib
from asyncio import CancelledError
from pathlib import Path

import pytest

from sightline.protocol.channels import ACK, CAMERA, FRAME
from sightline.protocol.codec import decode, encode
from sightline.protocol.config import Config
from sightline.protocol.messages import AnswerHeader, CameraModel, Echo, FrameHeader, Holder, StreamStatus
from sightline.protocol.transports.link import Message
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.supervision import EXIT_SIGNALS
from sightline.robot_side.network import process as network_process
from sightline.robot_side.network.process import NetworkProcess
from sightline.robot_side.pipe import DriverEnd, NetworkEnd, NetworkSetup
from sightline.robot_side.ports import Picture
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint

ROBOT = "0000000a"
MODEL = CameraModel(width_px=320, height_px=240, fx_px=200.0, fy_px=200.0, cx_px=160.0, cy_px=120.0)


class Camera:
    """Delivers one image per call."""

    model, live = MODEL, True
    t_us = 0

    def read(self, timeout_s):
        self.t_us += 1_000_000
        return Picture(b"jpeg", self.t_us)

    def close(self):
        pass


class Link:
    """A link with a listener. Runs `on_publish` while a message leaves."""

    def __init__(self):
        self.rejected, self.dropped = {}, {}
        self.on_publish = lambda channel, header: None
        self.published = []

    def has_listener(self, channel):
        return True

    def publish(self, channel, header, payload):
        self.published.append(channel)
        self.on_publish(channel, header)


class Relay:
    def look(self):
        pass


@pytest.fixture
def ends(tmp_path):
    """The pipe's end in the driver process and that in the network process, joined by real sockets."""
    waited, aside = (socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2))
    driver_end = DriverEnd(RobotConfig(state_dir=tmp_path), ROBOT)
    driver_end.socket, driver_end._aside = waited[0], aside[0]
    for end in (waited[0], aside[0]):
        end.setblocking(False)
    yield driver_end, NetworkEnd(waited[1], aside[1])
    for end in (*waited, *aside):
        end.close()


@pytest.fixture
def link():
    return Link()


@pytest.fixture
def process(tmp_path, ends, link):
    setup = NetworkSetup(config=RobotConfig(state_dir=tmp_path), session=ROBOT, first_seq=7)
    made = NetworkProcess(setup, ends[1], link, Camera())
    made._relay = Relay()
    return made


IMAGES = (b"", b"\0" * 9, b"jpeg", b"\x9d\x0a\xd9\x6d")
"""Two of them have a checksum of zero."""


@pytest.mark.parametrize("is_live", [True, False])
@pytest.mark.parametrize("image", IMAGES)
def test_only_images_of_a_live_camera_have_a_fingerprint_and_each_of_them_has_one(
    process, ends, monkeypatch, image, is_live
):
    monkeypatch.setattr(Camera, "live", is_live)
    monkeypatch.setattr(Camera, "read", lambda camera, _timeout_s: Picture(image, 1_000))
    process._stream_one()
    (packet,) = [one for one in ends[0].packets() if ipc.packet_kind(one) is ipc.PacketKind.ISSUED]
    fingerprint = ipc.unpack_issued(packet)[2]
    assert (fingerprint != 0) == is_live
    assert not is_live or fingerprint == (zlib.crc32(image) or fingerprint)


def issued(driver_end):
    packets = [packet for packet in driver_end.packets() if ipc.packet_kind(packet) is ipc.PacketKind.ISSUED]
    return [ipc.unpack_issued(packet)[:2] for packet in packets]


def test_driver_process_has_recorded_a_frame_when_it_is_published(process, ends, link):
    known = []

    def on_publish(channel, header):
        if channel is FRAME:
            frame = decode(FrameHeader, header)
            known.append(((frame.seq, frame.t_us), issued(ends[0])))

    link.on_publish = on_publish
    process._stream_one()
    assert known == [((7, 1_000_000), [(7, 1_000_000)])]


def test_frame_that_the_driver_process_has_no_room_for_is_not_published(process, ends, link):
    while ends[1].send_aside(ipc.pack_issued(1, 1, 0)):
        pass
    process._stream_one()
    assert link.published == [CAMERA]


class LockedCore:
    """Stands for the network core. Notes for each call whether the lock was held."""

    def __init__(self, process):
        self._process = process
        self.motion = ipc.RobotMotion()
        self.locked = {}

    image_fault = ""

    def _note(self, name):
        self.locked[name] = self._process._lock.locked()

    def adapt(self, camera):
        pass

    def may_capture(self, now_us, listening):
        self._note("may_capture")
        return True

    def wait_us(self, now_us):
        self._note("wait_us")
        return 0

    def early_us(self, now_us):
        self._note("early_us")
        return 0

    def on_camera(self, picture, now_us):
        self._note("on_camera")

    def announce_camera(self, model, now_us):
        self._note("announce_camera")

    def on_command_ack(self, ack, now_us):
        self._note("on_command_ack")

    def on_ack(self, message, now_us):
        self._note("on_ack")

    def status(self, *_counts):
        self._note("status")
        return StreamStatus()


def answered(process):
    echo = Echo(channel="frame", session=ROBOT, seq=7, t_us=1_000_000)
    header = AnswerHeader(source="viewer", session="0000000c", seq=1, echo=echo)
    process._on_ack(Message(ACK, "viewer", encode(header), b""))


def commanded(process):
    vision = Holder(source="vision", session="0000000b")
    process._on_packet(ipc.pack_command_ack(ipc.CommandAck(vision, 7, 0, vision)))


@pytest.mark.parametrize(("act", "names"), [
    (commanded, {"on_command_ack"}), (answered, {"on_ack"}), (lambda process: process._report(1), {"status"}),
    (lambda process: process._stream_one(), {"may_capture", "wait_us", "early_us", "on_camera", "announce_camera"}),
])  # fmt: skip
def test_each_use_of_the_credit_holds_the_lock(process, act, names):
    """Three threads use it: the camera loop, the driver's packets and the link's callbacks."""
    process._network_core = core = LockedCore(process)
    act(process)
    assert core.locked == dict.fromkeys(names, True)
    assert not process._lock.locked(), "and gives it back"


TYPE, VALUE = "camera raised TypeError: ", "camera raised ValueError: "


@pytest.mark.parametrize(("change", "fault"), [
    ({"read": lambda _: b"jpeg"}, TYPE + "read() returned bytes; expected Picture or None"),
    ({"read": lambda _: Picture(memoryview(b"jpeg"), 1)},
     TYPE + "Picture.jpeg is memoryview; expected bytes | bytearray"),
    ({"read": lambda _: Picture("jpeg", 1)}, TYPE + "Picture.jpeg is str; expected bytes | bytearray"),
    ({"read": lambda _: Picture(b"jpeg", 1.5)}, TYPE + "Picture.t_us is float; expected int"),
    ({"read": lambda _: Picture(b"jpeg", 1, 0)}, VALUE + "Picture.scale_percent is 0; expected 1 to 100"),
    ({"read": lambda _: Picture(b"jpeg", 1, 50.0)}, TYPE + "Picture.scale_percent is float; expected int"),
    ({"model": None}, TYPE + "model is NoneType; expected CameraModel"),
    ({"model": {"width_px": 320}}, TYPE + "model is dict; expected CameraModel"),
    ({"read": lambda _: Picture(b"jpeg", True)}, TYPE + "Picture.t_us is bool; expected int"),
    ({"read": lambda _: Picture(b"jpeg" * 200_000, 1)}, "image of 800000 bytes; at most 400000 (max_frame_bytes)"),
    ({"read": lambda _: Picture(b"jpeg", -1)}, "the time of the image is not after that of the one before"),
])
def test_wrong_image_is_a_fault_of_the_camera_and_ends_nothing(process, link, monkeypatch, caplog, change, fault):
    monkeypatch.setattr(network_process, "_CAMERA_RETRY_S", 0.0)
    for name, value in change.items():
        setattr(process.camera, name, value)
    process._stream_one()
    process._stream_one()
    status = process._network_core.status(1, camera_fault=process._camera_fault)
    assert (status.camera_fault, FRAME in link.published) == (fault, False)
    assert sum(fault in line for line in caplog.messages) <= 2 and "camera" in caplog.text
    for name in change:
        delattr(process.camera, name)
    process._stream_one()
    assert FRAME in link.published and not process._network_core.image_fault


@pytest.mark.parametrize("error", [SystemExit(9), CancelledError("odd"), GeneratorExit("odd")])
def test_camera_that_raises_no_usual_exception_is_a_fault_and_logged(process, link, monkeypatch, caplog, error):
    def fail(_):
        raise error

    monkeypatch.setattr(network_process, "_CAMERA_RETRY_S", 0.0)
    monkeypatch.setattr(process.camera, "read", fail, raising=False)
    process._stream_one()
    fault = f"camera raised {type(error).__name__}: {error}"
    assert process._camera_fault == fault and fault in caplog.text
    monkeypatch.undo()
    process._stream_one()
    assert FRAME in link.published and not process._camera_fault


@pytest.mark.parametrize(("now_us", "slept_s", "waited_s"), [
    (1_001_000, [0.028_999], []), (1_029_998, [0.000_001], []), (1_029_999, [], [0.091_001]),
])
def test_camera_loop_wakes_for_an_answer_only_once_a_frame_is_due(process, monkeypatch, now_us, slept_s, waited_s):
    """Nine tenths of 33.3 ms after the capture. The first credit returns after 120 ms."""
    clock, slept, waited = [1_001_000], [], []
    monkeypatch.setattr(network_process, "monotonic_us", lambda: clock[0])
    monkeypatch.setattr(network_process.time, "sleep", lambda seconds: slept.append(round(seconds, 6)))
    monkeypatch.setattr(process._credit, "wait", lambda seconds: waited.append(round(seconds, 6)))
    process._stream_one()
    clock[0] = now_us
    process._stream_one()
    assert (slept, waited) == (slept_s, waited_s)


def test_process_survives_exit_signals_and_its_child_ends_by_sigterm():
    """A camera plug-in may run a program of its own."""
    code = """if True:
        import os, subprocess, sys
        from sightline.robot_side.driver.supervision import EXIT_SIGNALS
        from sightline.robot_side.network import process
        process._ignore_exit_signals()
        for number in EXIT_SIGNALS:
            os.kill(os.getpid(), number)
        child = subprocess.Popen([sys.executable, "-c", "print('runs', flush=True); import time; time.sleep(30)"],
                                 stdout=subprocess.PIPE)
        child.stdout.readline()
        child.terminate()
        print(child.wait(10))
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=False)
    assert done.stdout == f"{-signal.SIGTERM}\n", done.stderr


@pytest.mark.parametrize("number", EXIT_SIGNALS)
def test_signal_during_a_start_of_the_network_process_does_not_end_it(tmp_path, monkeypatch, number):
    """Whatever it does then, e.g. importing, a traceback would be the last that the operator reads."""
    monkeypatch.setattr(ipc, "_command", lambda _ends: [sys.executable, "-c", "import time; time.sleep(30)"])
    driver_end = DriverEnd(RobotConfig(state_dir=tmp_path), ROBOT)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    driver_end.keep_alive(1, 0)
    started = driver_end._process
    started.send_signal(number)
    with pytest.raises(subprocess.TimeoutExpired):
        started.wait(0.3)
    assert Path(f"/proc/{started.pid}/stat").read_text().split()[2] != "T"
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before, "the driver gets its keys again"
    started.kill()
    driver_end.close()


class OddCamera:
    """Its library ends the program, or is interrupted."""

    class Config(Config):
        """The error."""

        error: str

    def __init__(self, config):
        raise {"KeyboardInterrupt": KeyboardInterrupt, "SystemExit": SystemExit}[config.error]("odd")


@pytest.mark.parametrize("error", ["KeyboardInterrupt", "SystemExit"])
def test_start_that_a_camera_ends_names_its_exception(tmp_path, capfd, error):
    camera = PluginChoice(kind=f"{__name__}:OddCamera", options={"error": error})
    end = DriverEnd(RobotConfig(listen=(free_endpoint(),), state_dir=tmp_path, camera=camera), "00000001")
    now_us = itertools.count(0, 20_000)

    def failed():
        end.keep_alive(next(now_us), 0)
        return not list(end.packets()) and end.failed_at_start

    assert until(failed, START_S)
    assert end.exit_code and f"raised {error}: odd" in capfd.readouterr().err
