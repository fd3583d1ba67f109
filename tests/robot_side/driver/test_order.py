"""The order of messages between the driver process and its network process: issued frames before commands, motion
before results, and no wake-up for a message that can wait."""

import select
import signal
import socket
import threading
from asyncio import CancelledError

import pytest

from sightline.protocol.channels import REQUEST, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.log import faults
from sightline.protocol.messages import AnswerHeader, Echo, Request, RequestHeader, Verb
from sightline.protocol.transports.link import Message
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.persistence import StopLatch
from sightline.robot_side.driver.process import BatteryReader, Driver
from sightline.robot_side.driver.supervision import EXIT_SIGNALS, IGNORED_SIGNALS
from sightline.robot_side.guardian.start import GuardianEnd
from sightline.robot_side.pipe import DriverEnd, NetworkEnd
from sightline.robot_side.safety.limits import SafetyConfig
from tests.fixtures.links import until

SEQ, T_US = 7, 1_000


class StillDrive:
    """A drive without an encoder."""

    def set(self, left_rad_s, right_rad_s):
        pass

    def wheels(self):
        return None

    def close(self):
        pass


@pytest.fixture
def ends(tmp_path):
    """The driver's hold on its child and the child's on its driver, joined by real sockets."""
    waited, aside = (socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) for _ in range(2))
    child = DriverEnd(RobotConfig(state_dir=tmp_path), "0a0a0a0a")
    child.socket, child._aside = waited[0], aside[0]
    child.on_ready()
    for end in (waited[0], aside[0]):
        end.setblocking(False)
    yield child, NetworkEnd(waited[1], aside[1])
    for end in (*waited, *aside):
        end.close()


@pytest.fixture
def driver(tmp_path, ends):
    handlers = {number: signal.getsignal(number) for number in (*EXIT_SIGNALS, *IGNORED_SIGNALS)}
    config = RobotConfig(state_dir=tmp_path, safety=SafetyConfig(auto_arm=True))
    made = Driver(config, StillDrive(), None)
    made.driver_end = ends[0]
    yield made
    made.latch_writer.close()
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("is_restart", [False, True])
def test_only_the_first_driver_process_arms_itself(driver, is_restart):
    with socket.socket() as heartbeats:
        end = GuardianEnd(heartbeats, is_restart=is_restart)
        made = Driver(driver._driver_core.config, StillDrive(), None, None, end)
        made.latch_writer.close()
    assert made._driver_core.gate.arms_itself is not is_restart


def answer(session, seq=SEQ, t_us=T_US):
    echo = Echo(channel="frame", session=session, seq=seq, t_us=t_us)
    header = AnswerHeader(source="vision", session="0b0b0b0b", seq=1, echo=echo, compute_us=900)
    return Message(TWIST, "vision", encode(header), b"0.1|0")


def test_frame_announced_after_its_answer_is_still_read_first(ends):
    child, parent = ends
    parent.forward(answer("0a0a0a0a"))
    parent.send_aside(ipc.pack_issued(SEQ, T_US, 0))
    assert [ipc.packet_kind(packet) for packet in child.packets()] == [ipc.PacketKind.ISSUED, ipc.PacketKind.RAW]


def test_all_frames_are_read_before_a_portion_of_commands(ends):
    child, parent = ends
    for seq in range(100):
        assert parent.send_aside(ipc.pack_issued(seq, T_US, 0))
    for _ in range(80):
        parent.forward(answer("0a0a0a0a"))
    kinds = [ipc.packet_kind(packet) for packet in child.packets()]
    assert kinds == [ipc.PacketKind.ISSUED] * 100 + [ipc.PacketKind.RAW] * 64
    assert [ipc.packet_kind(packet) for packet in child.packets()] == [ipc.PacketKind.RAW] * 16


def test_a_frame_that_leaves_does_not_wake_the_driver(ends):
    child, parent = ends
    parent.send_aside(ipc.pack_issued(SEQ, T_US, 0))
    assert select.select([child.socket], [], [], 0.05)[0] == []
    assert [ipc.packet_kind(packet) for packet in child.packets()] == [ipc.PacketKind.ISSUED]


def test_tick_does_not_wake_the_network_process_which_reads_the_newest_motion(ends):
    child, parent = ends
    for latency_us in (1, 2, 3):
        child.send_aside(ipc.pack_motion(ipc.RobotMotion(latency_us=latency_us)))
    assert select.select([parent._waited], [], [], 0.05)[0] == []
    assert parent.motion(ipc.RobotMotion()).latency_us == 3
    assert parent.motion(ipc.RobotMotion(latency_us=4)).latency_us == 4, "nothing new: the last stays"


def test_unread_motions_do_not_block_and_the_next_are_received(ends):
    child, parent = ends
    for latency_us in range(5000):
        child.send_aside(ipc.pack_motion(ipc.RobotMotion(latency_us=latency_us)))
    assert parent.motion(ipc.RobotMotion()).latency_us < 5000
    child.send_aside(ipc.pack_motion(ipc.RobotMotion(latency_us=5001)))
    assert parent.motion(ipc.RobotMotion()).latency_us == 5001


def test_frame_permitted_by_a_result_carries_its_latency(driver, ends, monkeypatch):
    _, parent = ends
    driver._driver_core.gate.arms_itself = False
    told = []
    monkeypatch.setattr(driver.driver_end, "send_aside", lambda packet: told.append(ipc.unpack_motion(packet)))
    monkeypatch.setattr(driver.driver_end, "send", told.append)
    assert driver._driver_core.gate.latency_us is None
    monkeypatch.setattr("sightline.robot_side.driver.process.monotonic_us", lambda: T_US + 4_000)
    _arm(driver)
    parent.send_aside(ipc.pack_issued(SEQ, T_US, 0))
    parent.forward(answer(driver._driver_core.session))
    assert driver._drain()
    driver._tick(T_US + 4_000)
    motion, judged, *published = told
    judged = ipc.unpack_command_ack(judged)
    assert motion.latency_us == 4_000 and judged.seq == SEQ and judged.compute_us == 900
    assert {ipc.packet_kind(packet) for packet in published} == {ipc.PacketKind.PUBLISH}, "it waits for no message"


def test_command_result_is_sent_before_the_next_tick(driver, ends):
    _, parent = ends
    parent.send_aside(ipc.pack_issued(SEQ, T_US, 0))
    parent.forward(answer(driver._driver_core.session))
    assert driver._drain()
    driver._answer()
    assert ipc.unpack_command_ack(parent.receive()).seq == SEQ
    driver._answer()
    assert select.select([parent._waited], [], [], 0.05)[0] == [], "once"


def _arm(driver):
    """Bring the gate to HOLD as its own table would; how it arms is tested with the gate."""
    from sightline.robot_side.safety.states import Event

    driver._driver_core.gate._go(Event.ARM, "armed for the test")


def test_stop_is_passed_to_the_disk_thread_before_the_next_tick(driver, ends, tmp_path):
    """The loop may end before that tick, on a signal that came with it."""
    status = Echo(channel="status", session=driver._driver_core.session, seq=0, t_us=monotonic_us())
    driver._driver_core.gate.issued.add("status", status.seq, status.t_us)
    header = RequestHeader(source="operator", session="0c0c0c0c", seq=1, echo=status)
    ends[1].forward(Message(REQUEST, "operator", encode(header), encode(Request(id=1, verb=Verb.STOP))))
    driver._drain()
    driver.latch_writer.close()
    assert StopLatch(tmp_path, driver._driver_core.config.robot).is_set()


class HungBattery:
    """Its second reading hangs until `go_on`, and then gives an old voltage."""

    def __init__(self):
        self.readings, self.go_on, self.closed_by = 0, threading.Event(), ""

    def read(self):
        self.readings += 1
        if self.readings > 1:
            assert self.go_on.wait(10.0)
        return 7.4

    def close(self):
        self.closed_by = threading.current_thread().name


def test_hanging_reading_has_the_age_of_its_start_and_its_thread_closes_the_device(monkeypatch):
    monkeypatch.setattr("sightline.robot_side.driver.process._BATTERY_PERIOD_S", 0.01)
    battery = HungBattery()
    reader = BatteryReader(battery)
    assert until(lambda: battery.readings == 2)
    monkeypatch.setattr("sightline.robot_side.driver.process._BATTERY_PERIOD_S", 10.0)  # no third reading
    begun_us, first = monotonic_us(), reader.newest
    battery.go_on.set()
    assert until(lambda: reader.newest != first)
    assert reader.newest[1] <= begun_us
    reader.close()
    assert until(lambda: battery.closed_by == "battery")


@pytest.mark.parametrize("error", [OSError("no such battery"), CancelledError("odd")])
def test_each_failed_reading_of_the_battery_is_counted_and_its_close_too(monkeypatch, error):
    monkeypatch.setattr("sightline.robot_side.driver.process._BATTERY_PERIOD_S", 0.01)

    readings, before = [], faults()["battery"]

    class Gone:
        def read(self):
            readings.append(12.0)
            if len(readings) <= 3:
                raise error
            return readings[-1]

        def close(self):
            raise error

    reader = BatteryReader(Gone())
    assert until(lambda: reader.newest)
    reader.close()
    assert until(lambda: not reader._thread.is_alive())
    assert faults()["battery"] - before == 4
