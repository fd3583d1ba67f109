"""Whatever breaks beside the driver's loop, the wheels end at zero: devices, disk, terminal, the child's packets."""

import array
import math
import os
import signal
import socket
import subprocess
import time
from asyncio import CancelledError
from contextlib import suppress
from types import SimpleNamespace

import pytest

from sightline.protocol.config import Config
from sightline.protocol.errors import HardwareError, WireError
from sightline.protocol.messages import STILL, Holder, Twist
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver import process
from sightline.robot_side.driver.persistence import LatchWriter, StopLatch
from sightline.robot_side.driver.process import Driver, run
from sightline.robot_side.driver.supervision import EXIT_SIGNALS, IGNORED_SIGNALS
from sightline.robot_side.guardian.core import (
    AT_REST,
    ENDING,
    FAILED,
    LOST,
    MOVING,
    STARTING,
    WATCHED,
    needs_zero,
    unpack_beat,
)
from sightline.robot_side.guardian.start import GuardianEnd
from sightline.robot_side.ports import Ranges, WheelAngles
from sightline.robot_side.safety.guard import BlindZoneError
from sightline.robot_side.safety.limits import SafetyConfig
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision, driving


class BrokenDrive:
    """Fails on request, and stores the last speeds of the motors."""

    class Config(Config):
        """Nothing to set."""

    told: tuple[float, float] | None = None
    fails: Exception | None = None
    reading: WheelAngles | None = None

    def __init__(self, config=None):
        BrokenDrive.told = (9.0, 9.0)  # as an earlier process left it

    def set(self, left_rad_s, right_rad_s):
        if BrokenDrive.fails and BrokenDrive.told == (0.0, 0.0):
            raise BrokenDrive.fails
        BrokenDrive.told = (left_rad_s, right_rad_s)

    def wheels(self):
        return BrokenDrive.reading

    def close(self):
        pass


@pytest.fixture
def driver(tmp_path):
    config = RobotConfig(
        drive=PluginChoice(kind=f"{__name__}:BrokenDrive"),
        listen=(free_endpoint(),),
        state_dir=tmp_path,
        safety=SafetyConfig(auto_arm=True),
    )
    handlers = {number: signal.getsignal(number) for number in (*EXIT_SIGNALS, *IGNORED_SIGNALS)}
    BrokenDrive.fails = BrokenDrive.reading = None
    made = Driver(config, BrokenDrive(), None)
    yield made
    made.latch_writer.close()
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize(
    "reading",
    [
        WheelAngles(math.nan, 0.0, 1),
        WheelAngles(math.inf, -math.inf, 1),
        WheelAngles(1e9, -1e9, 50_000),
    ],
)
def test_a_reading_that_is_not_a_number_stops_the_robot_not_the_loop(driver, reading):
    BrokenDrive.reading = WheelAngles(0.0, 0.0, 0)
    driver._tick(20_000)
    BrokenDrive.reading = reading
    for tick in range(5):
        driver._tick(1_000_000 + tick * 20_000)
        list(driver._driver_core.messages(1_000_000 + tick * 20_000))
    assert BrokenDrive.told == (0.0, 0.0)


@pytest.mark.parametrize("reading", [(0.0, 0.0, 1), 0.0, "0", {}])
def test_a_reading_of_another_type_is_a_fault_that_names_the_drive(driver, reading):
    BrokenDrive.reading = reading
    driver._tick(20_000)
    kind = type(reading).__name__
    reason = f"drive raised TypeError: wheels() returned {kind}; expected WheelAngles or None"
    assert (driver._driver_core.gate.state, driver._driver_core.gate.reason) == ("FAULT", reason)
    assert BrokenDrive.told == (0.0, 0.0)


def test_a_gate_that_cannot_be_stepped_is_a_fault_with_the_wheels_at_zero(driver, monkeypatch):
    """Neither with the sensors nor without: nothing that it holds may end the loop."""
    driver._driver_core.gate.applied = Twist(linear_mps=0.3, angular_rad_s=0.0)
    driver._driver_core.gate._ramp.force(driver._driver_core.gate.applied)
    driver._tick(20_000)
    assert BrokenDrive.told != (0.0, 0.0)

    def breaks(*_):
        raise ValueError("no such twist")

    with monkeypatch.context() as broken:
        broken.setattr(driver._driver_core, "tick", breaks)
        driver._tick(40_000)
        assert BrokenDrive.told == (0.0, 0.0)
        assert driver._driver_core.gate.state == "FAULT" and "no such twist" in driver._driver_core.gate.reason
    driver._tick(60_000)
    assert BrokenDrive.told == (0.0, 0.0), "it does not take up the speed of before"


@pytest.mark.parametrize("error", [
    OSError("unplugged"), ValueError("what"), RuntimeError(), SystemExit(9), CancelledError("odd"), GeneratorExit()])
def test_a_device_that_raises_anything_is_a_fault_and_logged(driver, error, caplog, monkeypatch):
    driver._tick(20_000)
    BrokenDrive.fails = error
    driver._tick(40_000)
    assert driver._driver_core.gate.state == "FAULT" and not driver._speeds_are_set
    BrokenDrive.fails = None

    def fail():
        raise error

    monkeypatch.setattr(driver, "_ranges", SimpleNamespace(read=fail))
    driver._tick(60_000)
    assert driver._speeds_are_set and BrokenDrive.told == (0.0, 0.0)
    name = type(error).__name__
    assert f"drive raised {name}" in caplog.text and f"range sensor raised {name}" in caplog.text


def test_sensor_that_turns_blind_after_its_first_scan_is_a_fault(driver, monkeypatch):
    scans = []
    monkeypatch.setattr(driver, "_ranges", SimpleNamespace(read=scans.pop))
    for least_m in (0.05, 9.0, 9.0, 0.05):
        scans.append(Ranges(20_000, 0.0, 0.1, least_m, 8.0, array.array("f", [math.inf] * 3)))
    for expected in ("DISARMED", "FAULT", "FAULT", "FAULT"):
        driver._tick(20_000)
        assert driver._driver_core.gate.state == expected and BrokenDrive.told == (0.0, 0.0)
    assert "blind below 9 m" in driver._driver_core.gate.reason


def test_sensor_that_is_blind_at_its_first_scan_ends_the_robot(driver, monkeypatch):
    scan = Ranges(20_000, 0.0, 0.1, 9.0, 8.0, array.array("f", [math.inf] * 3))
    monkeypatch.setattr(driver, "_ranges", SimpleNamespace(read=lambda: scan))
    with pytest.raises(BlindZoneError, match="blind below 9 m"):
        driver._tick(20_000)


def test_speeds_that_the_drive_did_not_take_are_not_shown_as_applied(driver, monkeypatch):
    """Neither STOP nor reset may count on a zero that never reached the motors."""
    gate, times_us = driver._driver_core.gate, iter(range(1_000_000, 4_000_000, 20_000))
    monkeypatch.setattr("sightline.robot_side.driver.process.monotonic_us", lambda: next(times_us))
    moving = gate.applied = Twist(linear_mps=0.3, angular_rad_s=0.0)
    gate._ramp.force(moving)
    driver._move()
    assert gate.applied.linear_mps > 0
    given, BrokenDrive.fails, BrokenDrive.told = gate.applied, OSError("unplugged"), (0.0, 0.0)
    gate.stop()
    for _ in range(100):
        driver._move()
        assert gate.applied == given and not driver._is_at_rest
    assert driver._driver_core.status(3_000_000).applied == (given.linear_mps, given.angular_rad_s)
    gate.applied = STILL
    with pytest.raises(WireError, match="the drive takes no speeds"):
        gate.reset(Holder(source="operator", session="0000000c"), 3_000_000)
    gate.applied = given
    BrokenDrive.fails = None
    driver._move()
    assert gate.applied == STILL and driver._is_at_rest


@pytest.mark.parametrize(("speed_mps", "expected"), [(0.3, LOST), (0.0, MOVING)])
def test_guardian_learns_of_a_drive_that_takes_no_speeds_for_100_ms_while_the_wheels_turn(
    driver, monkeypatch, speed_mps, expected
):
    now_us = [1_000_000]
    monkeypatch.setattr("sightline.robot_side.driver.process.heartbeat_us", lambda: now_us[0])
    driver._driver_core.gate.applied = Twist(linear_mps=speed_mps, angular_rad_s=0.0)
    BrokenDrive.fails, BrokenDrive.told = OSError("unplugged"), (0.0, 0.0)
    told = []
    for _ in range(6):
        driver._tick(now_us[0])
        told.append(driver._heartbeat())
        now_us[0] += 20_000
    assert told == [MOVING] * 5 + [expected]
    BrokenDrive.fails = None
    driver._tick(now_us[0])
    assert driver._heartbeat() == AT_REST


def test_first_speeds_may_have_reached_a_drive_that_raised(driver):
    gate = driver._driver_core.gate
    driver._tick(20_000)
    assert gate.applied == STILL
    BrokenDrive.fails = OSError("one wheel of two")
    gate._ramp.force(Twist(linear_mps=0.3, angular_rad_s=0.0))
    driver._tick(40_000)
    assert gate.applied.linear_mps > 0


@pytest.mark.parametrize("packet", [b"\xff", b"\x01", b"\x02", b"\x03{", bytes([ipc.PacketKind.RAW]) + b"x" * 40,
                                    bytes([ipc.PacketKind.TOKEN])])
def test_a_packet_that_is_invalid_is_dropped(driver, packet):
    driver.driver_end.packets = lambda: iter([packet])
    assert driver._drain() is False


@pytest.mark.parametrize("kind", [ipc.PacketKind.REJECTED, ipc.PacketKind.FAULTS])
@pytest.mark.parametrize("counts", [
    b"[]", b"null", b"1", b'"a"', b"[" * 100_000, b'{"a":[]}', b'{"a":1e400}', b'{"a":true}', b'{"a":-1}',
    b'{"a":%d}' % 2**53, b'{"\\ud800":1}', b'{"%s":1}' % (b"a" * 65),
    b"{%s}" % b",".join(b'"%d":1' % number for number in range(65)),
], ids=range(13))
def test_counts_of_a_broken_network_process_neither_end_the_loop_nor_spoil_the_status(driver, kind, counts):
    driver.driver_end.packets = lambda: iter([bytes([kind]) + counts])
    assert driver._drain() is False
    driver._tick(20_000)
    status = driver._driver_core.status(40_000)
    assert status.refused == {} and "a" not in status.faults


@pytest.fixture
def run_with(tmp_path, monkeypatch):
    """Run a robot whose loop is another one."""
    handlers = {number: signal.getsignal(number) for number in (*EXIT_SIGNALS, *IGNORED_SIGNALS)}
    BrokenDrive.fails = BrokenDrive.reading = None
    kind = PluginChoice(kind=f"{__name__}:BrokenDrive")

    def run_with(loop, guardian=None):
        monkeypatch.setattr(Driver, "loop", loop)
        return run(RobotConfig(drive=kind, listen=(free_endpoint(),), state_dir=tmp_path), guardian)

    yield run_with
    for number, handler in handlers.items():
        signal.signal(number, handler)


def unplug(_driver, error=None):
    """End the loop with a drive that takes no more speeds."""
    BrokenDrive.told, BrokenDrive.fails = (0.0, 0.0), error or OSError("unplugged")
    return 0


def test_motors_are_set_to_zero_after_every_end_of_the_loop(run_with):
    def breaks(_self):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run_with(breaks)
    assert BrokenDrive.told == (0.0, 0.0)


def test_drive_that_still_fails_at_the_end_gives_the_exit_code_that_calls_zero(run_with):
    """A guardian calls `zero` of the drive unless the code is 0."""
    with pytest.raises(HardwareError, match=r"motors NOT set to zero: .* OSError: unplugged; switch off") as error:
        run_with(unplug)
    assert needs_zero(error.value.exit_code, was_ready=True, was_running=False)


@pytest.mark.parametrize("error", [CancelledError("odd"), GeneratorExit("odd")])
def test_drive_that_raises_no_usual_exception_at_the_end_is_logged_too(run_with, error, caplog):
    caplog.set_level("INFO", "sightline")
    with pytest.raises(HardwareError, match=f"NOT set to zero: .* {type(error).__name__}"):
        run_with(lambda _driver: unplug(_driver, error))
    assert f"drive raised {type(error).__name__}" in caplog.text


@pytest.mark.parametrize(("loop", "beat"), [(lambda _driver: 0, ENDING), (unplug, FAILED)])
def test_last_heartbeat_permits_a_long_end_only_after_zero(run_with, loop, beat):
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        ours.send(WATCHED)
        with suppress(HardwareError):
            run_with(loop, GuardianEnd(theirs))
        ours.setblocking(False)
        assert unpack_beat(ours.recv(16))[0] == beat
        with suppress(BlockingIOError):
            assert ours.recv(16) == b"", "no other heartbeat follows"


class PluggedDevice:
    """A drive, range sensor and battery behind one plug. It stores its calls."""

    class Config(Config):
        """Nothing to set."""

    is_plugged = False
    calls: list[object]

    def __init__(self, _config):
        self.calls.append("open")
        if not self.is_plugged:
            raise HardwareError("no such device")

    @staticmethod
    def zero(config):
        pass

    def set(self, *speeds):
        self.calls.append(speeds)

    def wheels(self):
        return None

    def read(self):
        return 12

    def close(self):
        self.calls.append("close")


@pytest.fixture
def run_unplugged(tmp_path, monkeypatch):
    """Run a robot whose devices are not there when it starts, with another loop."""
    handlers = {number: signal.getsignal(number) for number in (*EXIT_SIGNALS, *IGNORED_SIGNALS)}
    BrokenDrive.fails = BrokenDrive.reading = None
    monkeypatch.setattr(PluggedDevice, "calls", [], raising=False)
    monkeypatch.setattr(PluggedDevice, "is_plugged", False)
    choice = PluginChoice(kind=f"{__name__}:PluggedDevice")
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def run_unplugged(loop, *groups, is_restart):
        monkeypatch.setattr(Driver, "loop", loop)
        ours.send(WATCHED)
        devices = {"drive": PluginChoice(kind=f"{__name__}:BrokenDrive"), **dict.fromkeys(groups, choice)}
        config = RobotConfig(listen=(free_endpoint(),), state_dir=tmp_path, **devices)
        return run(config, GuardianEnd(theirs, is_restart=is_restart))

    with ours, theirs:
        yield run_unplugged
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_restarted_driver_opens_each_device_as_soon_as_it_is_back(run_unplugged, monkeypatch):
    """A drive whose plug also has the range sensor was never set to zero, because the robot ended."""
    now_us = 60_000_000
    monkeypatch.setattr(process, "heartbeat_us", lambda: now_us)
    monkeypatch.setattr(process, "BatteryReader", lambda one: SimpleNamespace(read=one.read, close=one.close))

    def loop(driver):
        nonlocal now_us
        uses = [lambda: driver._drive.set(0.0, 0.0), driver._ranges.read, driver._battery_reader.read]
        for passed_us, opens in (0, 3), (999_999, 3), (1, 6), (500_000, 6):
            now_us += passed_us
            for use in uses:
                with pytest.raises(HardwareError, match="no such device"):
                    use()
            assert PluggedDevice.calls == ["open"] * opens
        PluggedDevice.is_plugged = True
        now_us += 500_000
        assert [use() for use in uses] == [None, 12, 12] and PluggedDevice.calls[6:] == ["open", (0, 0), "open", "open"]
        assert driver._drive.wheels() is None
        return 0

    assert run_unplugged(loop, "drive", "range_sensor", "battery", is_restart=True) == 0
    assert PluggedDevice.calls[10:] == [(0, 0), "close", "close", "close"]


@pytest.mark.parametrize("group", ["drive", "range_sensor", "battery"])
def test_first_driver_does_not_start_without_a_device(run_unplugged, group):
    with pytest.raises(HardwareError, match="no such device"):
        run_unplugged(lambda _driver: pytest.fail("it starts"), group, is_restart=False)


def test_device_that_is_still_absent_at_the_end_needs_no_close(run_unplugged):
    assert run_unplugged(lambda _driver: 0, "range_sensor", is_restart=True) == 0
    assert PluggedDevice.calls == ["open"]


@pytest.mark.parametrize("is_restart", [False, True])
def test_only_the_first_driver_ends_with_a_network_process_that_does_not_start(run_unplugged, is_restart):
    """Such as after a camera left together with the drive. Its robot could not be reached."""
    def loop(driver):
        driver.driver_end._on_exit(3, 0)
        return driver.driver_end.exit_code

    assert run_unplugged(loop, is_restart=is_restart) == (0 if is_restart else 3)


@pytest.mark.parametrize(("at_rest", "runs", "beats"), [
    (True, False, [AT_REST, STARTING, "start", AT_REST]), (True, True, [AT_REST]), (False, False, [MOVING, "start"]),
])
def test_start_of_the_network_process_may_wait_for_a_processor_only_at_rest(driver, monkeypatch, at_rest, runs, beats):
    done = []
    monkeypatch.setattr(driver, "_guardian", SimpleNamespace(beat=done.append))
    monkeypatch.setattr(driver.driver_end, "_start", lambda _first_seq: done.append("start"))
    monkeypatch.setattr(driver.driver_end, "_process", SimpleNamespace(poll=lambda: None) if runs else None)
    if not at_rest:
        driver._driver_core.gate.applied = Twist(linear_mps=0.3, angular_rad_s=0.0)
        driver._driver_core.gate._ramp.force(driver._driver_core.gate.applied)
    driver._tick(20_000)
    assert done == beats


def test_a_latch_that_cannot_be_written_is_tried_again_and_does_not_block(tmp_path, caplog):
    caplog.set_level("INFO", "sightline")
    latch = StopLatch(tmp_path / "state", "r1")
    (tmp_path / "state").rmdir()
    latch_writer = LatchWriter(latch)
    began_s = time.monotonic()
    latch_writer.want(stopped=True)
    assert time.monotonic() - began_s < 0.1
    assert until(lambda: "STOP mark is not kept" in caplog.text)
    (tmp_path / "state").mkdir()
    assert until(latch.is_set)
    latch_writer.close()


def test_a_terminal_that_hangs_up_while_moving_ends_after_zero(tmp_path):
    """The robot's output goes to a pipe whose reader has gone."""
    reading, writing = os.pipe()
    with RobotProcess(tmp_path) as robot:
        robot.process.terminate()
        robot.process.wait(5)
        robot.drive_log.unlink(missing_ok=True)
        command = [*robot.process.args]
        robot.process = subprocess.Popen(command, stdout=writing, stderr=subprocess.STDOUT)
        os.close(writing)
        with Vision(robot.endpoint):
            assert driving(robot)
            os.close(reading)
            robot.process.send_signal(signal.SIGHUP)
            assert robot.process.wait(5) == 0
        assert robot.speed() == 0.0
