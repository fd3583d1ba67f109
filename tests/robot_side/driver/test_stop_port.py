"""A STOP that comes by the STOP port: latched as any other, answered, and not lost at the end of the process."""

import json
import socket
from contextlib import suppress

import pytest

from sightline.protocol.channels import REPLY, REQUEST
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Reply, Request, RequestHeader, State, Verb
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.stop_datagram import StopRequests
from sightline.protocol.transports.stop_port import StopProcess, read_secret
from sightline.robot_side import pipe as ipc
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.driver.persistence import StopLatch
from sightline.robot_side.driver.process import Driver
from sightline.robot_side.guardian.start import GuardianEnd, stop_receiver_of
from sightline.robot_side.guardian.stop_core import _REPORT, pack_number
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_port
from tests.fixtures.robot_process import RobotProcess, Vision


class Drive:
    """Wheels without a motor."""

    def set(self, left_rad_s, right_rad_s):
        self.speeds = left_rad_s, right_rad_s

    def wheels(self):
        return None


class Network:
    """The driver's end of the pipe: what arrives, and what was sent."""

    socket = None

    def __init__(self):
        self.arriving, self.sent = [], []

    def packets(self):
        arriving, self.arriving = self.arriving, []
        return iter(arriving)

    def send(self, packet):
        self.sent.append(packet)


@pytest.fixture
def driver(tmp_path, monkeypatch):
    for name in ("signal", "getsignal"):
        monkeypatch.setattr(f"sightline.robot_side.driver.process.signal.{name}", lambda *_: None)
    receiver = StopProcess("unused", {})
    made = Driver(RobotConfig(state_dir=tmp_path), Drive(), None, None, GuardianEnd(socket.socket(), receiver.near))
    made.driver_end = Network()
    made.far = receiver.far
    made.far.setblocking(False)
    yield made
    made.latch_writer.close()
    receiver.close()


def is_latched(driver):
    config = driver._driver_core.config
    return StopLatch(config.state_dir, config.robot).is_set()


def reports(driver):
    """All reports that the receiver has received: (number, state index, at rest, stored)."""
    found = []
    while True:
        try:
            found.append(_REPORT.unpack(driver.far.recv(64))[1:])
        except BlockingIOError:
            return found


def test_a_stop_is_latched_and_reported(driver):
    driver.far.send(pack_number(41))
    assert driver._drain()
    assert driver._driver_core.gate.state is State.STOPPED and "datagram" in driver._driver_core.gate.reason
    assert until(lambda: is_latched(driver) and driver.latch_writer.is_stored)
    driver._move()
    driver._report_stop(0)
    assert reports(driver) == [(41, 5, True, True)]


def test_a_state_is_reported_when_it_changes_and_ten_times_a_second(driver):
    for now_us in (0, 20_000, 40_000, 100_000, 120_000):
        driver._report_stop(now_us)
    assert len(reports(driver)) == 2
    driver._driver_core.gate.stop()
    driver._report_stop(140_000)
    assert [state for _, state, _, _ in reports(driver)] == [5]


def test_ignored_datagrams_are_counted_in_the_status(driver):
    driver.far.send(b"CMALFORMED 7 WRONG_KEY 2 10.0.0.9")
    assert not driver._drain()
    assert driver._driver_core.status(0).refused == {"MALFORMED": 7, "WRONG_KEY": 2}
    assert driver._driver_core.gate.state is State.DISARMED


@pytest.mark.parametrize("address", ["2a02:8109:9340:5a2c:d4f1:9c3b:7e21:aa0b", "fe80::d4f1:9c3b:7e21:aa0b%wlp0s20f3"])
def test_ignored_datagram_of_the_longest_address_is_counted_and_logged(driver, address, caplog):
    caplog.set_level("INFO", "sightline")
    driver.far.send(f"CMALFORMED 1 {address}".encode())
    assert not driver._drain()
    assert driver._driver_core.status(0).refused == {"MALFORMED": 1}
    assert f"rejected MALFORMED from {address}: a STOP datagram was ignored" in caplog.text


@pytest.mark.parametrize("packet", [b"S", b"S12", b"C", b"CMALFORMED", b"CMALFORMED x y", b"C\xff 1 y", b"L\xff", b"?"])
def test_invalid_packet_of_the_receiver_never_ends_the_loop(driver, packet):
    driver.far.send(packet)
    assert not driver._drain()
    assert (driver._driver_core.gate.state is State.STOPPED) == packet.startswith(b"S")


def request(verb):
    header = RequestHeader(source="operator", session="0a1b2c3d", seq=1)
    return ipc.pack_message(
        ipc.PacketKind.RAW, Message(REQUEST, "operator", encode(header), encode(Request(id=7, verb=verb)))
    )


@pytest.mark.parametrize("by_port", [False, True])
def test_a_stop_that_arrives_as_the_process_ends_is_latched_and_answered(driver, by_port):
    if by_port:
        driver.far.send(pack_number(41))
    else:
        driver.driver_end.arriving.append(request(Verb.STOP))
    driver.finish()
    assert is_latched(driver) and driver.latch_writer.is_stored
    if by_port:
        assert reports(driver)[-1][0] == 41
    else:
        sent = [ipc.unpack_message(packet) for packet in driver.driver_end.sent]
        [reply] = [decode(Reply, one.payload) for one in sent if one.channel is REPLY]
        assert reply.ok and reply.id == 7 and reply.state == State.STOPPED


def test_a_stop_that_arrives_while_devices_are_closed_is_latched_and_proven(driver):
    driver.finish()
    assert not is_latched(driver)
    driver.far.send(pack_number(42))
    driver.finish()
    assert is_latched(driver) and driver.latch_writer.is_stored and reports(driver)[-1][0] == 42


@pytest.mark.parametrize(("changes", "addresses", "routers"), [
    ({}, [["127.0.0.1", 7448]], []),
    ({"listen": ["tcp/0.0.0.0:7447", "ws://10.0.0.7:9090"]}, [["0.0.0.0", 7448], ["10.0.0.7", 9091]], []),
    ({"listen": [], "connect": ["tcp/hub.local:7447"]}, [], [["hub.local", 7448]]),
    ({"listen": ["ws-legacy://127.0.0.1:9091"]}, [["127.0.0.1", 7448]], []),
])  # fmt: skip
def test_the_port_is_beside_the_links(changes, addresses, routers):
    receiver = stop_receiver_of(RobotConfig(**changes))
    options = json.loads(json.dumps(receiver.options))
    receiver.close()
    assert options["addresses"] == addresses and options["routers"] == routers and options["secret_file"] == ""


def test_robot_that_could_not_open_its_stop_port_does_not_start():
    with pytest.raises(ConfigError, match=r"port 7448 in tcp/0\.0\.0\.0:7448: its STOP port would be 7449/udp"):
        stop_receiver_of(RobotConfig(listen=("tcp/0.0.0.0:7448",)))


def test_a_key_folder_without_the_secret_gets_one_line_with_the_command(tmp_path, caplog):
    assert stop_receiver_of(RobotConfig(secure=str(tmp_path))) is None
    [record] = caplog.records
    assert f"`sightline keys add {tmp_path} stop`" in record.getMessage()
    assert "copy it from where the keys were made" in record.getMessage()  # a secret of its own stops no robot
    (tmp_path / "stop.secret").write_text("a secret of this site")
    receiver = stop_receiver_of(RobotConfig(secure=str(tmp_path)))
    receiver.close()
    assert str(tmp_path / "stop.secret") in receiver.options["secret_file"]


@pytest.mark.parametrize("text", ["", "\n", "15 letters long\n"])
def test_empty_or_short_secret_closes_the_port_with_one_line(tmp_path, caplog, text):
    file = tmp_path / "stop.secret"
    file.write_text(text)
    assert stop_receiver_of(RobotConfig(secure=str(tmp_path))) is None
    [record] = caplog.records
    assert str(file) in record.getMessage() and f"`sightline keys add {tmp_path} stop`" in record.getMessage()
    with pytest.raises(ConfigError):  # as a receiver that starts again later reads it
        read_secret(str(file))


def test_unreadable_secret_is_one_line(tmp_path):
    with pytest.raises(ConfigError, match=r"stop\.secret: Is a directory; STOP works on the link only"):
        read_secret(str((tmp_path / "stop.secret").mkdir() or tmp_path / "stop.secret"))


def test_robot_stops_and_latches_by_the_port_alone(tmp_path):
    port = free_port()
    with RobotProcess(tmp_path, endpoint=f"tcp/127.0.0.1:{port}") as robot:
        robot.wait_until_on()
        with Vision(robot.endpoint):
            assert until(lambda: robot.speed() > 0, START_S)
            assert stop_by_port(("127.0.0.1", port + 1)).is_stored
            assert robot.speed() == 0
        assert (tmp_path / "state" / "r1.stopped").exists()


def stop_by_port(address):
    requests = StopRequests("r1", b"", 7)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.settimeout(0.02)

        def proven():
            for data in requests.datagrams():
                one.sendto(data, address)
            with suppress(TimeoutError):
                requests.on_datagram(one.recv(2048))
            return requests.is_stored

        assert until(proven, START_S)
    return requests
