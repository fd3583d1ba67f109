"""Faults are visible: each exception is logged once with its traceback, counted, and shown in `status`."""

import errno
import itertools
import threading
import time
from types import SimpleNamespace

import pytest

from sightline.protocol import log
from sightline.protocol.channels import STATUS
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.config import Config
from sightline.protocol.errors import HardwareError
from sightline.protocol.log import faults, report_fault
from sightline.protocol.messages import Status, StreamStatus
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver import process as driver_process
from sightline.robot_side.driver.persistence import StopLatch
from sightline.robot_side.network import process as network_process
from sightline.robot_side.network.process import NetworkProcess
from sightline.robot_side.pipe import CAMERA_EXIT, DriverEnd, NetworkSetup
from sightline.robot_side.ports import WheelAngles
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision
from tests.robot_side.driver.test_process_faults import BrokenDrive, driver  # noqa: F401  a fixture
from tests.robot_side.network.test_process import ROBOT, Camera, Link, Relay

SECOND_US = 1_000_000


def raised(error):
    try:
        raise error
    except BaseException as caught:
        return caught


def test_a_kind_is_logged_once_with_its_traceback_and_each_is_counted(caplog):
    for number in range(3):
        report_fault("camera", raised(ValueError(f"number {number}")))
    report_fault("camera", raised(TypeError("another")))
    report_fault("drive", raised(ValueError("of another part")))
    assert faults() == {"camera": 4, "drive": 1}
    assert caplog.messages == [
        "camera raised ValueError: number 0", "camera raised TypeError: another",
        "drive raised ValueError: of another part",
    ]
    assert all(record.levelname == "ERROR" and record.exc_info for record in caplog.records)


def test_kinds_without_bound_cost_no_memory():
    for number in range(200):
        report_fault(f"part {number}", ValueError())
    assert len(log._kinds) == log._MAX_KINDS


def test_a_thread_that_ends_by_an_exception_is_counted(caplog, monkeypatch):
    monkeypatch.setattr(threading, "excepthook", log._log_thread_error)
    thread = threading.Thread(target=lambda: 1 / 0, name="viewer")
    thread.start()
    thread.join()
    assert faults() == {"thread": 1}
    assert caplog.messages == ["thread viewer raised ZeroDivisionError: division by zero"]


def status_of(made):
    """The status that is published next."""
    made._driver_core._due_us.clear()
    sent = []
    made.driver_end.send = sent.append
    made._tick(10**9)
    messages = [ipc.unpack_message(packet) for packet in sent if ipc.packet_kind(packet) is ipc.PacketKind.PUBLISH]
    return decode(Status, next(one.payload for one in messages if one.channel is STATUS), 4096)


def test_exceptions_of_drive_and_range_sensor_are_in_the_status(driver, caplog, monkeypatch):  # noqa: F811
    monkeypatch.setattr(driver.driver_end, "keep_alive", lambda *_: None)
    BrokenDrive.fails, BrokenDrive.told = RuntimeError("no such motor"), (0.0, 0.0)
    driver._tick(20_000)
    driver._tick(40_000)
    BrokenDrive.fails = None

    class Ranges:
        def read(self):
            raise OSError("no such sensor")

    driver._ranges = Ranges()
    status = status_of(driver)
    assert status.faults == {"drive": 2, "range sensor": 1}
    shown = [one for one in caplog.records if one.levelname == "ERROR"]
    assert [one.message for one in shown] == ["drive raised RuntimeError: no such motor",
                                              "range sensor raised OSError: no such sensor"]


def test_a_doubtful_encoder_is_counted_each_time_and_logged_ever_more_rarely(driver, caplog, monkeypatch):  # noqa: F811
    monkeypatch.setattr(driver.driver_end, "keep_alive", lambda *_: None)
    times = itertools.count()
    now_us = monotonic_us()
    readings = [WheelAngles(0.0, 1000.0 * (turn % 2), now_us + 20_000 * turn) for turn in range(5)]
    monkeypatch.setattr(driver._drive, "wheels", lambda: readings[next(times) % 5])
    for turn in range(4):
        driver._tick(20_000 * turn)
    status = status_of(driver)
    assert status.faults == {"encoder": 3} and status.state != "FAULT"
    lines = [one.message for one in caplog.records if one.levelname == "WARNING"]
    assert lines == 2 * ["robot r1: right wheel jumped by 1e+03 rad; look for a loose wire, or a counter that wraps"]


@pytest.mark.parametrize(("slow", "waiting"), [
    ("DRIVES", "drive log"), ("RANGE_SENSORS", "range sensor sim"), ("", None)])
def test_a_device_that_takes_long_to_open_is_named_meanwhile(tmp_path, monkeypatch, caplog, slow, waiting):
    caplog.set_level("INFO")
    monkeypatch.setattr(log, "_SLOW_S", 0.02)
    monkeypatch.setattr(driver_process, "limit_core_dump", lambda: None)
    monkeypatch.setattr(driver_process, "check_ports", lambda _: None)

    class Device:
        def close(self):
            pass

    for name in ("DRIVES", "RANGE_SENSORS"):
        group = SimpleNamespace(build=lambda _, name=name: until(lambda: name != slow or caplog.messages) and Device())
        monkeypatch.setattr(driver_process, name, group)

    def fail(*_):
        raise HardwareError("opened")

    monkeypatch.setattr(driver_process, "start_log_thread", fail)
    config = RobotConfig(robot="car", drive=PluginChoice(kind="log"), range_sensor=PluginChoice(kind="sim"))
    with pytest.raises(HardwareError, match="opened"):
        driver_process.run(config)
    time.sleep(0.05)
    assert caplog.messages == ([f"robot car: waiting for the {waiting} to open"] if waiting else [])


class UnprintableError(RuntimeError):
    def __str__(self):
        raise ValueError("no text either")


@pytest.mark.parametrize(("error", "reason"), [
    (OSError("pin\udce9\x1b[2J\nis gone"), "drive raised OSError: pin??[2J is gone"),
    (UnprintableError(), "drive raised UnprintableError"), (SystemExit(3), "drive raised SystemExit: 3"),
    (ZeroDivisionError("division by zero"), "drive raised ZeroDivisionError: division by zero"),
    (HardwareError("no controller; plug it in"), "no controller; plug it in"), (HardwareError(), "HardwareError"),
])
def test_an_odd_exception_of_a_drive_ends_no_loop_and_is_in_the_status(driver, monkeypatch, error, reason):  # noqa: F811
    monkeypatch.setattr(driver.driver_end, "keep_alive", lambda *_: None)

    def fails(*_):
        raise error

    monkeypatch.setattr(driver._drive, "set", fails)
    status = status_of(driver)
    assert (status.state, status.reason, status.faults) == ("FAULT", reason, {"drive": 1})


def test_counts_of_network_processes_add_up_in_the_status(driver, monkeypatch):  # noqa: F811
    monkeypatch.setattr(driver.driver_end, "keep_alive", lambda *_: None)
    driver._on_packet(ipc.pack_counts(ipc.PacketKind.FAULTS, {"camera": 3}))
    driver._on_packet(bytes([ipc.PacketKind.READY]))
    driver._on_packet(ipc.pack_counts(ipc.PacketKind.FAULTS, {"camera": 1, "callback": 5}))
    assert status_of(driver).faults == {"camera": 4, "callback": 5}


def test_a_latch_that_a_full_disk_rejects_is_in_the_status(driver, caplog, monkeypatch):  # noqa: F811
    """The wheels are at zero, whatever the disk does."""
    monkeypatch.setattr(driver.driver_end, "keep_alive", lambda *_: None)

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(StopLatch, "write", full)
        driver._driver_core.gate.stop("STOP by operator")
        driver.latch_writer.want(True)
        assert until(lambda: faults()["STOP mark"] >= 2)
        status = status_of(driver)
        assert "not stored for a restart: No space left on device" in status.reason
        assert status.state == "STOPPED" and BrokenDrive.told == (0.0, 0.0)
    assert len([line for line in caplog.messages if "STOP mark" in line]) == 1, "one line for all tries"
    assert until(lambda: not driver.latch_writer.failed)
    assert "not stored" not in status_of(driver).reason


# --- the camera --------------------------------------------------------------------------------------------------


class Ended(BaseException):
    """In place of the end of the process."""


class PipeEnd:
    """The network process's end of the pipe; stores what is sent."""

    dropped_commands = 0

    def __init__(self):
        self.sent = []

    def send(self, packet):
        self.sent.append(packet)
        return True

    send_aside = send

    def motion(self, last):
        return last


@pytest.fixture
def process(tmp_path, monkeypatch):
    def end(code):
        raise Ended(code)

    monkeypatch.setattr(network_process.os, "_exit", end)
    monkeypatch.setattr(network_process.logging, "shutdown", lambda: None)
    monkeypatch.setattr(network_process, "_CAMERA_RETRY_S", 0.0)
    setup = NetworkSetup(config=RobotConfig(state_dir=tmp_path), session=ROBOT, first_seq=7)
    made = NetworkProcess(setup, PipeEnd(), Link(), Camera())
    made._relay = Relay()
    return made


def watched(process, from_us, until_us, step_us=50_000):
    for now_us in range(from_us, until_us, step_us):
        process._check_camera(now_us)


def reported(process):
    packets = [one for one in process._network_end.sent if ipc.packet_kind(one) is ipc.PacketKind.STREAM]
    return decode(StreamStatus, packets[-1][1:]).camera_fault


def nothing(_timeout_s):
    """A camera without images."""


def test_a_camera_without_an_image_for_2_s_is_named_and_its_process_ends(process):
    process.camera.read = nothing
    process._stream_one()
    watched(process, SECOND_US, 2_700_000)
    with pytest.raises(Ended) as ended:
        watched(process, 2_700_000, 3_200_000)
    assert ended.value.args == (CAMERA_EXIT,)
    assert reported(process) == "camera sim gives no image; its process was started again"


def test_a_camera_that_delivers_is_left_alone(process):
    process._network_core.may_capture = lambda *_: True
    for number in range(100):
        process._stream_one()
        process._check_camera(SECOND_US + 50_000 * number)


def test_a_process_that_stood_still_does_not_blame_its_camera(process):
    process.camera.read = nothing
    process._stream_one()
    watched(process, SECOND_US, 12 * SECOND_US, step_us=3 * SECOND_US)


UNPLUGGED = "camera /dev/video0 was unplugged; plug it in again"


def unplugged(_timeout_s):
    raise HardwareError(UNPLUGGED)


def test_a_camera_that_reports_its_own_loss_is_named_and_its_process_ends_after_2_s(process, caplog):
    caplog.set_level("INFO")
    process._network_core.may_capture = lambda *_: True
    process.camera.read = unplugged
    for number in range(34):
        process._stream_one()
        process._check_camera(SECOND_US + number * 50_000)
    process._report(1)
    assert reported(process) == UNPLUGGED and faults() == {"camera": 34}
    logged = [one for one in caplog.records if one.levelname == "ERROR"]
    assert [one.message for one in logged] == [f"camera raised HardwareError: {UNPLUGGED}"] and logged[0].exc_info
    del process.camera.read
    process._stream_one()
    process._report(1)
    assert reported(process) == "" and caplog.messages[1:] == [f"camera: {UNPLUGGED}", "camera: back"]
    process.camera.read = unplugged
    process._stream_one()
    with pytest.raises(Ended):
        watched(process, 3 * SECOND_US, 6 * SECOND_US)
    assert reported(process) == f"{UNPLUGGED}; its process was started again"


def test_a_loss_that_an_earlier_process_logged_is_only_counted(process, caplog):
    process.camera.read = unplugged
    process._setup = process._setup.model_copy(update={"camera_fault": f"{UNPLUGGED}; its process was started again"})
    process._camera_fault = process._setup.camera_fault
    process._stream_one()
    assert faults() == {"camera": 1} and not caplog.records


def test_exceptions_of_a_camera_are_reported_as_they_come_and_end_no_loop(process):
    process.camera.read = lambda _timeout_s: 1 / 0
    for times in (1, 2):
        for _ in range(times):
            process._stream_one()
        process._report(1)
    counts = [ipc.unpack_counts(one) for one in process._network_end.sent
              if ipc.packet_kind(one) is ipc.PacketKind.FAULTS]
    assert counts == [{"camera": 1}, {"camera": 2}]
    assert reported(process) == "camera raised ZeroDivisionError: division by zero"


@pytest.fixture
def main(tmp_path, monkeypatch):
    """Runs a network process whose `_run` raises; returns its exit code, and what it sent."""

    def run(error, *, is_restart):
        def fail(*_):
            raise error

        def end(code):
            raise Ended(code)

        setup = NetworkSetup(config=RobotConfig(state_dir=tmp_path), session=ROBOT, first_seq=7, is_restart=is_restart)
        pipe = PipeEnd()
        pipe.receive = setup.model_dump_json
        for name, value in {"_run": fail, "NetworkEnd": lambda *_: pipe, "start_log": lambda *_: None}.items():
            monkeypatch.setattr(network_process, name, value)
        monkeypatch.setattr(network_process.sys, "argv", ["network"])
        monkeypatch.setattr(network_process.signal, "signal", lambda *_: None)
        monkeypatch.setattr(network_process.signal, "pthread_sigmask", lambda *_: None)
        monkeypatch.setattr(network_process.logging, "shutdown", lambda: None)
        monkeypatch.setattr(network_process.os, "_exit", end)
        with pytest.raises(Ended) as ended:
            network_process.main()
        return ended.value.args[0], pipe.sent

    return run


def test_an_exception_that_ends_the_network_process_is_logged_and_counted(main, caplog):
    code, sent = main(ZeroDivisionError("two\nlines"), is_restart=True)
    assert (code, [ipc.unpack_counts(one) for one in sent]) == (1, [{"network process": 1}])
    assert caplog.messages == ["network process raised ZeroDivisionError: two lines"]


def test_what_ends_a_first_network_process_is_the_last_line_of_the_program_and_later_a_line_of_the_log(
    main, caplog, capsys
):
    assert main(HardwareError("no camera"), is_restart=False) == (3, [])
    assert (capsys.readouterr().err, caplog.messages) == ("error: no camera\n", [])
    assert main(HardwareError("no camera"), is_restart=True) == (3, [])
    assert (capsys.readouterr().err, caplog.messages) == ("", ["robot r1: no camera"])


@pytest.mark.own_process
def test_a_camera_that_hangs_at_the_first_start_ends_the_robot_with_its_name(monkeypatch, capsys):
    ended, going_on = [], threading.Event()

    class Hangs(HangingCamera):
        def __init__(self, _config):
            going_on.wait(5.0)

    def end(code):
        ended.append(code)
        going_on.set()

    monkeypatch.setattr(network_process, "_OPENS_WITHIN_S", 0.02)
    monkeypatch.setattr(network_process.os, "_exit", end)
    monkeypatch.setattr(network_process.CAMERAS.__class__, "build", lambda *_: Hangs(None))
    network_process._open_camera(PluginChoice(kind="v4l2"))
    assert ended == [3] and capsys.readouterr().err == (
        "error: camera v4l2 does not open within 0.02 s; unplug it and plug it in again\n"
    )
    monkeypatch.setattr(network_process, "_OPENS_WITHIN_S", 60.0)
    monkeypatch.setattr(network_process.CAMERAS.__class__, "build", lambda *_: None)
    network_process._open_camera(PluginChoice(kind="v4l2"))
    assert all(one.finished.is_set() for one in threading.enumerate() if isinstance(one, threading.Timer))


@pytest.mark.parametrize("odd", ["ball\udce9.jpg\x1b[2J", "two\nlines"])
def test_a_camera_with_an_odd_message_is_named_in_letters(process, odd):
    def fails(_timeout_s):
        raise OSError(odd)

    process.camera.read = fails
    process._stream_one()
    process._report(1)
    text = {"two\nlines": "two lines"}.get(odd, "ball?.jpg?[2J")
    assert reported(process) == f"camera raised OSError: {text}"


def test_each_restart_for_the_camera_waits_longer_until_an_image_came(tmp_path):
    end = DriverEnd(RobotConfig(state_dir=tmp_path), ROBOT)
    end.on_ready()
    end.on_camera("no image")
    waits_s = []
    for _ in range(7):
        end._on_exit(CAMERA_EXIT, 1)
        waits_s.append(end._camera_patience_us / 1e6)
    assert waits_s == [4, 8, 16, 32, 60, 60, 60] and end._camera_fault == "no image"
    end.on_camera("")
    assert end._camera_patience_us == 2 * SECOND_US


class HangingCamera:
    """Delivers five images, then hangs in `read`."""

    class Config(Config):
        """Nothing to set."""

    live = False
    model = Camera.model

    def __init__(self, _config):
        self.left = 5

    def read(self, _timeout_s):
        self.left -= 1
        time.sleep(60.0 if self.left < 0 else 0.05)
        return network_process.Picture(b"jpeg", time.monotonic_ns() // 1000)

    def close(self):
        pass


@pytest.mark.slow
def test_a_camera_that_hangs_is_in_the_status_and_its_process_is_started_again(tmp_path):
    camera = PluginChoice(kind=f"{__name__}:HangingCamera").model_dump()
    with RobotProcess(tmp_path, camera=camera) as robot:
        robot.wait_until_on()
        before = robot.network_pid()
        with Vision(robot.endpoint) as vision:
            driver, shown = robot.driver_pid(), []

            def named():
                message = vision.status_slot.take(0.2)
                if message is not None:
                    shown.append(decode(Status, message.payload, 4096))
                return shown and "gives no image" in shown[-1].stream.camera_fault

            assert until(named, 20), shown[-1:]
            assert until(lambda: robot.network_pid() != before, 10)
        assert robot.driver_pid() == driver
