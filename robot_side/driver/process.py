"""The control loop of the driver process. Shell."""

import logging
import math
import secrets
import select
import signal
import socket
import struct
import sys
import threading
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack, suppress
from functools import partial
from types import FrameType
from typing import Any, Final, Generic, cast

from sightline.protocol.channels import REQUEST, TWIST
from sightline.protocol.clock import heartbeat_us, monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.errors import HardwareError, RejectReason, SightlineError, WireError
from sightline.protocol.log import (
    RepeatLimiter,
    count_fault,
    fault_text,
    faults,
    report_ending,
    report_fault,
    slow_logged,
    start_log,
    start_log_thread,
)
from sightline.protocol.messages import State, StreamStatus
from sightline.protocol.transports.diagnosis import check_ports
from sightline.protocol.transports.endpoints import check_robot_id
from sightline.protocol.transports.stop_port import read_packets, send_packet
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.driver.persistence import LatchWriter, StopLatch, state_locked
from sightline.robot_side.driver.supervision import (
    DRIVER_PRIORITY,
    EXIT_SIGNALS,
    IGNORED_SIGNALS,
    limit_core_dump,
    request_real_time,
)
from sightline.robot_side.guardian.core import AT_REST, ENDING, FAILED, LOST, MOVING, REJECTS_US, STARTING
from sightline.robot_side.guardian.start import GuardianEnd, zero_of
from sightline.robot_side.guardian.stop_core import DriverReport, pack_report, unpack_ignored, unpack_number
from sightline.robot_side.pipe import DriverEnd
from sightline.robot_side.plugins import BATTERIES, DRIVES, RANGE_SENSORS, DeviceGroup, Port
from sightline.robot_side.ports import Battery, Drive, Ranges, RangeSensor, WheelAngles, check_scan, check_wheels
from sightline.robot_side.safety.battery import BatteryLevel
from sightline.robot_side.safety.guard import BlindZoneError, check_blind_zone
from sightline.robot_side.safety.limits import MIN_TICK_US, TICK_US

_log: Final = logging.getLogger(__name__)

# The driver process: owns gate and motors, is the parent of the network process, has no network. Shell.
#
# Motors keep their last speed, so their process must outlive every other fault. The network process may hang, die or
# hold its interpreter lock forever. This loop still reads its own clock 50 times a second and stops the wheels.
# It handles the signals of a terminal, so a KeyboardInterrupt or any other BaseException is an error of a plug-in.


_SHUTDOWN_US = 2_000_000
_MAX_CONFIG_BYTES = 1 << 20
# The process locks its memory, including stacks of usually 8 MB. Plug-in code needs a larger stack than this code.
_STACK_BYTES, _PLUGIN_STACK_BYTES = 256 * 1024, 1024 * 1024
_BATTERY_PERIOD_S = 1.0
_STOP_REPORT_US = 100_000
_REOPENS_US = 1_000_000
_INVALID: Final = (ValueError, KeyError, struct.error, WireError)
"""Errors for a packet of a broken process, which is restarted."""


def run(config: RobotConfig, guardian: GuardianEnd | None = None) -> int:
    """Run the robot until one of EXIT_SIGNALS or until the guardian is gone. The wheels are then at zero.

    Raises ConfigError, HardwareError or LinkError before any motion, and HardwareError if the drive failed to set the
    motors to zero at the end.
    """
    check_robot_id(config.robot)
    limit_core_dump()
    is_restart = guardian is not None and guardian.is_restart
    if not is_restart:
        check_ports(config.listen)  # before the devices: a second robot on these ports may own the devices, too
    with ExitStack() as last, ExitStack() as ending:
        with slow_logged(f"robot {config.robot}: waiting for the drive {config.motors.kind} to open"):
            drive: Drive = LostDrive(DRIVES, config.motors) if is_restart else DRIVES.build(config.motors)
        ending.callback(_close, "drive", drive)
        ranges: RangeSensor | None = None
        if (ranging := config.ranging) is not None:
            with slow_logged(f"robot {config.robot}: waiting for the range sensor {ranging.kind} to open"):
                ranges = LostRangeSensor(RANGE_SENSORS, ranging) if is_restart else RANGE_SENSORS.build(ranging)
            ending.callback(_close, "range sensor", ranges)
        threading.stack_size(_PLUGIN_STACK_BYTES)
        reader = None
        if (source := config.battery) is not None:
            reader = BatteryReader(LostBattery(BATTERIES, source) if is_restart else BATTERIES.build(source))
            ending.callback(reader.close)
        threading.stack_size(_STACK_BYTES)
        start_log_thread()
        driver = Driver(config, drive, ranges, reader, guardian)
        last.enter_context(state_locked(config.state_dir, config.robot))
        last.callback(driver.finish)  # once more, because closing devices and network process may take seconds
        threading.stack_size(_PLUGIN_STACK_BYTES)
        ending.callback(driver.latch_writer.close)
        ending.callback(driver.driver_end.close)
        ending.callback(driver.finish)
        if guardian is not None:
            guardian.wait()
        # Runs first, because the stack is last in, first out. However the loop ends, this sets the motors to zero.
        # If it fails, the guardian does it.
        ending.callback(_end, config, drive, guardian)
        return driver.loop()


class LostDevice(Generic[Port]):
    """A device of a driver process that died. Opens the device, or tries again; until then `status` shows the error.

    The cause of the death may be a plug that has all devices behind it. The robot then stays reachable, and sets the
    wheels to zero as soon as it can.
    """

    def __init__(self, group: DeviceGroup[Port], choice: PluginChoice) -> None:
        self._group, self._choice = group, choice
        self._device: Port | None = None
        self._why, self._due_us = "", 0
        with suppress(HardwareError):
            self._opened()

    def close(self) -> None:
        """Close the device if it is open."""
        if self._device is not None:
            cast(Any, self._device).close()

    def _opened(self) -> Port:
        """Return the device. Raises HardwareError until it opens. It tries once a second."""
        if self._device is None:
            if heartbeat_us() < self._due_us:
                raise HardwareError(self._why)
            self._due_us = heartbeat_us() + _REOPENS_US
            try:
                self._device = self._group.build(self._choice, is_last=False)
            except HardwareError as error:
                self._why = str(error)
                raise
        return self._device


class LostDrive(LostDevice[Drive]):
    """The drive of a driver process that died."""

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set the wheel speeds, see `Drive`."""
        self._opened().set(left_rad_s, right_rad_s)

    def wheels(self) -> WheelAngles | None:
        """Read the encoders, see `Drive`."""
        return self._opened().wheels()

    @staticmethod
    def zero(config: Mapping[str, Any]) -> None:
        """Do nothing: the guardian calls `zero` of the real drive."""


class LostRangeSensor(LostDevice[RangeSensor]):
    """The range sensor of a driver process that died."""

    def read(self) -> Ranges | None:
        """Take the newest scan, see `RangeSensor`."""
        return self._opened().read()


class LostBattery(LostDevice[Battery]):
    """The battery of a driver process that died."""

    def read(self) -> float:
        """Measure the voltage, see `Battery`."""
        return self._opened().read()


def _close(part: str, device: Drive | RangeSensor | Battery) -> None:
    """Close a device. The motors are at zero, so its exception is only reported."""
    try:
        device.close()
    except BaseException as error:
        report_fault(part, error)


def zero_motors(config: RobotConfig) -> int:
    """Set the motors to zero without gate or network, after a robot service has died.

    Raises ConfigError for a drive without `zero`, HardwareError if the motors may still turn.
    """
    zero, options = zero_of(config)
    _zero(config, partial(zero, options))
    return 0


def _end(config: RobotConfig, drive: Drive, guardian: GuardianEnd | None) -> None:
    """Set the motors to zero. The last heartbeat reports a failure to the guardian."""
    last_beat = FAILED
    try:
        _zero(config, partial(drive.set, 0.0, 0.0))
        last_beat = ENDING
    finally:
        if guardian is not None:
            guardian.beat(last_beat)


def _zero(config: RobotConfig, set_to_zero: Callable[[], None]) -> None:
    try:
        set_to_zero()
    except SightlineError:
        raise
    except BaseException as error:
        report_ending("drive", error)
        what = DRIVES.failed(config.drive, error)
        raise HardwareError(f"motors NOT set to zero: {what}; switch off their supply") from None


class BatteryReader:
    """Reads the battery once a second on a separate thread, because a slow device must not block the loop."""

    def __init__(self, battery: Battery) -> None:
        self._battery = battery
        self._closing = threading.Event()
        self.newest: tuple[float, int] | None = None
        """Voltage in V, and the time of its reading."""
        self._thread = threading.Thread(target=self._read_all, name="battery", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End after the current reading. It waits one second for a reading that hangs, and leaves its device open."""
        self._closing.set()
        self._thread.join(_BATTERY_PERIOD_S)

    def _read_all(self) -> None:
        try:
            self._read_until_closing()
        finally:
            _close("battery", self._battery)

    def _read_until_closing(self) -> None:
        while not self._closing.is_set():
            begin_us = monotonic_us()  # the age of a reading counts from its start, also if it hung
            try:
                self.newest = self._read(), begin_us
            except BaseException as error:
                if not self._closing.is_set():
                    report_fault("battery", error)
            self._closing.wait(_BATTERY_PERIOD_S)

    def _read(self) -> float:
        volts = float(self._battery.read())
        if not math.isfinite(volts):
            raise ValueError(f"invalid voltage {volts}: not finite")
        return volts


class Driver:
    """The control loop and its state."""

    def __init__(
        self, config: RobotConfig, drive: Drive, ranges: RangeSensor | None,
        battery_reader: BatteryReader | None = None, guardian: GuardianEnd | None = None,
    ) -> None:
        latch = StopLatch(config.state_dir, config.robot)
        self.latch_writer = LatchWriter(latch)
        self._drive = drive
        self._ranges = ranges
        self._battery_reader = battery_reader
        self._logged_level = BatteryLevel.SILENT
        self._driver_core = DriverCore(config, secrets.token_hex(4), stopped=latch.is_set())
        is_restart = guardian is not None and guardian.is_restart
        # The last process may have been disarmed, or have lost a human. Then only an operator may arm again.
        self._driver_core.gate.arms_itself &= not is_restart
        self._logged_state = self._driver_core.gate.state
        self._is_waiting_logged = self._is_ending_logged = False
        self._ending_since_us: int | None = None
        self._guardian = guardian
        self._commanded_us = 0
        """Time of the last tick for a command."""
        self._speeds_are_set = False
        self._rejects_since_us = 0
        """Time since which the drive rejects speeds; 0 if it accepted the last ones."""
        self._scan_layout: tuple[float, ...] = ()
        self._command_acks: list[ipc.CommandAck] = []
        self._rejection_limiter = RepeatLimiter()
        self._rejected_by_network: Counter[str] = Counter()
        self._faults_of_network: Counter[str] = Counter()
        self.driver_end = DriverEnd(config, self._driver_core.session, is_restart=is_restart)
        self._stops = guardian.stops if guardian else None
        self._stop_applied = 0
        """Number of the receiver's newest STOP that is latched."""
        self._stop_report, self._stop_report_us = b"", 0
        for number in EXIT_SIGNALS:
            signal.signal(number, self._on_signal)
        for number in IGNORED_SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, EXIT_SIGNALS)  # a guardian starts this process with them blocked

    def _on_signal(self, _number: int, _frame: FrameType | None) -> None:
        self._ending_since_us = self._ending_since_us or monotonic_us()

    def loop(self) -> int:
        """Tick when a command arrives, at most once in MIN_TICK_US, and 20 ms after the last tick.

        At 30 fps the next command arrives 13 ms after that second tick, so no tick is running then.
        """
        self._log_missing()
        # Deadlines use the clock of the heartbeats, so that a suspended robot is not late.
        deadline_us = heartbeat_us()
        is_pending = False
        while not self._ended():
            self._wait(min(deadline_us, self._commanded_us + MIN_TICK_US) if is_pending else deadline_us)
            arrived = self._drain()
            is_pending |= arrived
            now_us = heartbeat_us()
            if now_us >= deadline_us:
                self._driver_core.tick_late_max_us = max(self._driver_core.tick_late_max_us, now_us - deadline_us)
                deadline_us = max(deadline_us + TICK_US, now_us)
            elif is_pending and now_us - self._commanded_us >= MIN_TICK_US:
                self._commanded_us = now_us
                deadline_us = now_us + TICK_US
            else:
                if arrived:
                    self._answer()
                continue
            self._tick(monotonic_us())
            is_pending = False
        return self.driver_end.exit_code

    def finish(self) -> None:
        """Latch and answer the messages so far. The motors are at zero."""
        self._drain()
        now_us = monotonic_us()
        for message in self._driver_core.messages(now_us):
            self.driver_end.send(ipc.pack_message(ipc.PacketKind.PUBLISH, message))
        self.latch_writer.close()
        self._report_stop(now_us)

    def _log_missing(self) -> None:
        """Log missing capabilities of this robot before it moves."""
        for line in request_real_time(DRIVER_PRIORITY):
            self._log(line)

    def _ended(self) -> bool:
        if self.driver_end.failed_at_start:
            self._ending_since_us = self._ending_since_us or monotonic_us()
        if self._ending_since_us is None:
            return False
        self._driver_core.gate.disarm("shutting down")
        self._log_ending()
        return self._is_at_rest or monotonic_us() - self._ending_since_us > _SHUTDOWN_US

    def _log_ending(self) -> None:
        """Log once that the robot ends. A network process that failed at its start has printed the reason."""
        if not self._is_ending_logged and not self.driver_end.failed_at_start:
            self._is_ending_logged = self._is_waiting_logged = True
            self._logged_state = self._driver_core.gate.state
            self._log(f"{self._logged_state} (shutting down)")

    @property
    def _is_at_rest(self) -> bool:
        return self._driver_core.at_rest and self._speeds_are_set

    def _heartbeat(self) -> bytes:
        """Return the state of the wheels for the guardian."""
        rejects = self._rejects_since_us and heartbeat_us() - self._rejects_since_us >= REJECTS_US
        if rejects and not self._driver_core.at_rest:
            return LOST if self._ending_since_us is None else FAILED
        return AT_REST if self._is_at_rest else MOVING

    def _wait(self, deadline_us: int) -> None:
        timeout_s = max(0, deadline_us - heartbeat_us()) / 1e6
        readable = [self.driver_end.socket] if self.driver_end.socket else []
        if self._stops is not None:
            readable.append(self._stops)
        if self._guardian is not None:
            readable.append(self._guardian.heartbeats)
        ready = select.select(readable, [], [], timeout_s)
        if self._guardian is not None and self._guardian.heartbeats in ready[0] and self._guardian.is_gone():
            self._guardian = None
            self._log("the guardian is gone; shutting down")
            self._ending_since_us = self._ending_since_us or monotonic_us()

    def _tick(self, now_us: int) -> None:
        self._move()
        self._answer()
        self._driver_core.faults = faults() + self._faults_of_network
        self._driver_core.latch_failed = self.latch_writer.failed
        if self._guardian is not None:
            self._guardian.beat(self._heartbeat())
        for message in self._driver_core.messages(now_us):
            self.driver_end.send(ipc.pack_message(ipc.PacketKind.PUBLISH, message))
        self._keep_network(heartbeat_us())
        self._driver_core.network_restarts = max(0, self.driver_end.restarts)
        self.latch_writer.want(self._driver_core.gate.state is State.STOPPED)
        self._log_state(self._driver_core.gate.state, self._driver_core.gate.reason)
        self._log_battery(now_us)
        self._log_wheel(now_us)
        self._report_stop(now_us)

    def _keep_network(self, now_us: int) -> None:
        """Start the network process if it is not running."""
        # On a busy machine a start takes long, and the guardian would end a healthy loop. Meanwhile the wheels stand.
        guardian = self._guardian if self._is_at_rest and self.driver_end.is_start_due(now_us) else None
        if guardian is not None:
            guardian.beat(STARTING)
        self.driver_end.keep_alive(now_us, self._driver_core.gate.issued.last_seq("frame") + 1)
        if guardian is not None:
            guardian.beat(AT_REST)

    def _answer(self) -> None:
        """Send command acks after the wheels are set. The motion comes first, for the header of the next frame.

        Next: `robot_side/network/process.py`: `NetworkProcess._on_packet`.
        """
        self.driver_end.send_aside(ipc.pack_motion(self._driver_core.motion()))
        command_acks, self._command_acks = self._command_acks, []
        for ack in command_acks:
            self.driver_end.send(ipc.pack_command_ack(ack))

    def _move(self) -> None:
        """Run sensors, gate and motors. An error of a device stops the robot but not this loop.

        The gate's time is read after the sensors, so that a scan stamped at its reading is not from the future.
        Next: `robot_side/hardware/gpio.py`: `GpioDrive.set`.
        """
        wheels: WheelAngles | None = None
        scan: Ranges | None = None
        self._speeds_are_set = False
        before, part = self._driver_core.gate.applied, "drive"
        try:
            wheels = self._drive.wheels()
            check_wheels(wheels)
            part = "range sensor"
            scan = self._scanned()
            part = "control loop"
            if self._battery_reader is not None and self._battery_reader.newest is not None:
                self._driver_core.on_battery(*self._battery_reader.newest)
            speeds = self._driver_core.tick(monotonic_us(), wheels, scan)
        except BaseException as error:  # third-party code; a reading may have any type
            if isinstance(error, BlindZoneError) and not self._scan_layout:
                raise  # the first scan does not fit the configuration; without a scan the robot does not move
            self._fault(part, error)
            speeds = self._without_sensors()
        try:
            self._drive.set(*speeds)
            self._speeds_are_set, self._rejects_since_us = True, 0
            self._driver_core.gate.note_drive(before, is_taken=True)
        except BaseException as error:
            self._driver_core.gate.note_drive(before, is_taken=False)
            self._rejects_since_us = self._rejects_since_us or heartbeat_us()
            self._fault("drive", error)

    def _fault(self, part: str, error: BaseException) -> None:
        report_fault(part, error)
        self._driver_core.gate.fault(fault_text(part, error))

    def _without_sensors(self) -> tuple[float, float]:
        """Return the gate's ramp to zero, or zero if the gate fails too, because this loop must not end."""
        try:
            return self._driver_core.tick(monotonic_us(), None, None)
        except Exception as error:
            report_fault("control loop", error)
            self._driver_core.gate.halt(fault_text("control loop", error))
            return 0.0, 0.0

    def _scanned(self) -> Ranges | None:
        """Return the newest scan. Raises BlindZoneError for a sensor whose blind zone is too large for the guard."""
        scan = self._ranges.read() if self._ranges else None
        if scan is None:
            return None
        check_scan(scan)
        scan_layout = (scan.angle_min_rad, scan.angle_increment_rad, scan.range_min_m, float(len(scan.ranges_m)))
        if scan_layout != self._scan_layout:
            check_blind_zone(self._driver_core.config.guard, scan)
            self._scan_layout = scan_layout
        return scan

    def _log_state(self, state: State, reason: str) -> None:
        """Log each change of state in one line."""
        logged, self._logged_state = self._logged_state, state
        self._is_waiting_logged &= state is State.DISARMED
        if state is not logged and {state, logged} != {State.ACTIVE, State.DEGRADED}:
            self._log(f"{state} ({reason})")  # on a lossy link ACTIVE and DEGRADED alternate many times a second

    def _log_battery(self, now_us: int) -> None:
        """Log each change of level in one line."""
        battery = self._driver_core.battery
        if battery is None:
            return
        level, logged = battery.level(now_us), self._logged_level
        self._logged_level = level
        if level is not logged:
            volts = battery.volts(now_us)
            self._log(f"battery {level.value}" + (f" ({volts:.2f} V)" if volts is not None else ""))

    def _log_wheel(self, now_us: int) -> None:
        """Count what the encoders contradict, and log it at once, then ever more rarely."""
        if doubt := self._driver_core.doubtful_wheel:
            count_fault("encoder")
            if self._rejection_limiter.due("encoder", now_us):
                _log.warning("robot %s: %s", self._driver_core.config.robot, doubt)

    def _log(self, line: str) -> None:
        _log.info("robot %s: %s", self._driver_core.config.robot, line)

    # --- packets of the network process --------------------------------------------------------------------------

    def _drain(self) -> bool:
        """Handle packets of the network process and the STOP receiver. Returns True if a command was among them."""
        commanded = False
        for packet in read_packets(self._stops) if self._stops else ():
            with suppress(*_INVALID):
                commanded |= self._on_receiver_packet(packet)
        for packet in self.driver_end.packets():
            with suppress(*_INVALID):
                commanded |= self._on_packet(packet)
        return commanded

    def _on_receiver_packet(self, packet: bytes) -> bool:
        """Handle a packet of the STOP receiver. Returns True for a STOP. Next: `SafetyGate.stop`."""
        if packet.startswith(b"S"):
            self._driver_core.gate.stop("STOP by a datagram")
            self.latch_writer.want(True)
            self._stop_applied = unpack_number(packet)
            return True
        if packet.startswith(b"C"):
            counts, address = unpack_ignored(packet)
            self._driver_core.rejected_by_transport += Counter(counts)
            for reason, count in counts.items():
                self._log_rejection(address, reason, "a STOP datagram was ignored", count)
        elif packet.startswith(b"L"):
            self._log(packet[1:].decode())
        return False

    def _report_stop(self, now_us: int) -> None:
        """Send the state to the STOP receiver, when it changes and ten times a second."""
        if self._stops is None:
            return
        state, stored = self._driver_core.gate.state, self.latch_writer.is_stored
        report = pack_report(DriverReport(self._stop_applied, state.value, self._is_at_rest, stored))
        if report != self._stop_report or now_us - self._stop_report_us >= _STOP_REPORT_US:
            self._stop_report, self._stop_report_us = report, now_us
            send_packet(self._stops, report)

    def _on_packet(self, packet: bytes) -> bool:
        kind = ipc.packet_kind(packet)
        if kind is ipc.PacketKind.RAW:
            return self._on_raw(packet)
        if kind is ipc.PacketKind.ISSUED:
            self._driver_core.on_issued(*ipc.unpack_issued(packet))
        elif kind is ipc.PacketKind.STREAM:
            self._driver_core.stream = decode(StreamStatus, packet[1:])
            self.driver_end.on_camera(self._driver_core.stream.camera_fault)
        elif kind is ipc.PacketKind.REJECTED:
            self._on_rejected(ipc.unpack_counts(packet))
        elif kind is ipc.PacketKind.FAULTS:
            self._faults_of_network += Counter(ipc.unpack_counts(packet))
        elif kind is ipc.PacketKind.TOKEN:
            self._driver_core.on_token(*ipc.unpack_token(packet), monotonic_us())
        elif kind is ipc.PacketKind.READY:
            self._rejected_by_network.clear()
            self.driver_end.on_ready()
        return False

    def _on_rejected(self, counts: dict[str, int]) -> None:
        """Add new counts of this network process. They start at zero; the sums continue across its restarts."""
        more, self._rejected_by_network = Counter(counts) - self._rejected_by_network, Counter(counts)
        self._driver_core.rejected_by_transport += more
        for reason, count in more.items():
            self._log_rejection("the network", reason, "rejected by the transport", count)

    def _on_raw(self, packet: bytes) -> bool:
        message, rejection_before = ipc.unpack_message(packet), self._driver_core.gate.last_rejection
        if message.channel is TWIST:
            ack = self._driver_core.on_twist(message, monotonic_us())
            if ack is not None:
                self._command_acks.append(ack)
        elif message.channel is REQUEST:
            self._driver_core.on_request(message, monotonic_us())
            self.latch_writer.want(self._driver_core.gate.state is State.STOPPED)  # the loop may end before the tick
        rejection = self._driver_core.gate.last_rejection
        if rejection is not None and rejection is not rejection_before:
            self._log_rejection(rejection.source, rejection.reason, rejection.detail)
        return True

    def _log_rejection(self, source: str, reason: str, detail: str, times: int = 1) -> None:
        # A driver that sends commands before it is armed is a normal state. One line shows how it ends.
        if reason == RejectReason.DISARMED:
            if not (self._is_waiting_logged or self._driver_core.gate.arms_itself):
                self._is_waiting_logged, robot = True, self._driver_core.config.robot
                self._log(f"receives commands from {source}; waiting for `sightline arm {robot}`")
            return
        if count := self._rejection_limiter.due(reason, monotonic_us(), times):
            often = f" ({count} times)" if count > 1 else ""
            self._log(f"rejected {reason} from {source or 'an unknown source'}{often}: {detail}")


def main() -> None:
    """Run a driver process that a guardian started. The arguments are the descriptors of its sockets."""
    heartbeats, *stops = (socket.socket(fileno=int(number)) for number in sys.argv[1:])
    try:
        start_log(None, "robot")
        config = RobotConfig.model_validate_json(heartbeats.recv(_MAX_CONFIG_BYTES))
        sys.exit(run(config, GuardianEnd(heartbeats, *stops, is_restart=True)))
    except SightlineError as error:
        _log.error("%s", error)
        sys.exit(error.exit_code)
