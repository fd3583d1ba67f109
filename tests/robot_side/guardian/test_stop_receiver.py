"""The STOP receiver as a process: small, only the standard library, deaf to anything but a valid STOP."""

import errno
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from sightline.protocol.transports import stop_port
from sightline.protocol.transports.stop_datagram import (
    DATAGRAM_BYTES,
    Kind,
    StopDatagram,
    StopRequests,
    pack_stop,
    unpack_stop,
)
from sightline.protocol.transports.stop_port import StopPort, now_us, read_packets, send_packet
from sightline.robot_side.guardian import stop_forwarder, stop_receiver
from sightline.robot_side.guardian.stop_core import (
    DriverReport,
    Registration,
    pack_report,
    unpack_ignored,
    unpack_number,
)
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_port, need_ipv6

MAX_RSS_KIB = 15_000
SECRET = b"a secret of this site"
FOREIGN = """
import sys
import sightline.robot_side.guardian.stop_receiver, sightline.robot_side.guardian.stop_forwarder
names = {name.partition(".")[0] for name in sys.modules} - sys.stdlib_module_names - {"__main__", "_distutils_hack"}
print(*sorted(name for name in names if not name.startswith("__editable__")))
"""


class Driver:
    """A driver process that applies each STOP and reports it, as far as `turn` is called."""

    def __init__(self, process):
        self.near, self.applied, self.ignored = process.near, 0, {}

    def turn(self):
        for packet in read_packets(self.near):
            if packet.startswith(b"S"):
                self.applied = unpack_number(packet)
            elif packet.startswith(b"C"):
                for reason, count in unpack_ignored(packet)[0].items():
                    self.ignored[reason] = self.ignored.get(reason, 0) + count
        state = "STOPPED" if self.applied else "ACTIVE"
        send_packet(self.near, pack_report(DriverReport(self.applied, state, bool(self.applied), True)))


@pytest.fixture
def operator(request):
    family = getattr(request, "param", socket.AF_INET)
    if family is socket.AF_INET6:
        need_ipv6()
    with socket.socket(family, socket.SOCK_DGRAM) as one:
        one.setblocking(False)
        yield one


@pytest.fixture
def started():
    running = []

    def start(process):
        running.append(process)
        process.keep_alive(now_us())
        return process

    yield start
    for process in running:
        process.close()


def stop(operator, address, driver, requests):
    """Send STOP until the answer proves it."""

    def proven():
        for data in requests.datagrams():
            operator.sendto(data, address)
        time.sleep(0.005)
        driver.turn()
        while True:
            try:
                requests.on_datagram(operator.recv(2048))
            except OSError:
                return requests.is_stored

    return until(proven, START_S)


@pytest.mark.parametrize("secret", [b"", SECRET])
def test_receiver_answers_stop_and_stays_below_15_mb(started, operator, tmp_path, secret):
    file = tmp_path / "stop.secret"
    file.write_bytes(secret + b"\n")
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], str(file) if secret else ""))
    assert stop(operator, address, Driver(process), StopRequests("r1", secret, 7))
    status = Path(f"/proc/{process._process.pid}/status").read_text()
    assert int(status.partition("VmRSS:")[2].split()[0]) <= MAX_RSS_KIB


def test_both_processes_import_only_the_standard_library():
    done = subprocess.run([sys.executable, "-c", FOREIGN], capture_output=True, text=True, timeout=30, check=True)
    assert done.stdout.split() == ["sightline"]


def waiting_bytes(port):
    """Return the size of the datagrams that the UDP socket of `port` on this machine holds unread."""
    sockets = [line.split() for line in Path("/proc/net/udp").read_text().splitlines()[1:]]
    waiting, = (queues for _, local, _, _, queues, *_ in sockets if int(local.partition(":")[2], 16) == port)
    return int(waiting.partition(":")[2], 16)


def test_bad_datagrams_of_every_length_have_no_effect_but_a_count(started, operator):
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], ""))
    driver = Driver(process)
    assert stop(operator, address, driver, StopRequests("r1", b"", 7))
    operator.sendto(b"", address)  # it is counted after the last repetition of that STOP
    assert until(lambda: driver.turn() or driver.ignored, START_S)
    applied = driver.applied
    for length in range(1, 2001):
        operator.sendto(b"S" * length, address)
        if length % 20 == 0:  # its socket holds about 45 of the longest
            assert until(lambda: waiting_bytes(address[1]) == 0, START_S)
    for data in StopRequests("r2", b"", 7).datagrams():
        operator.sendto(data, address)

    def counted():
        driver.turn()
        return driver.ignored.get("OTHER_ROBOT") == 1

    assert until(counted, START_S)
    assert driver.ignored["MALFORMED"] == 2001 and driver.applied == applied
    with pytest.raises(BlockingIOError):
        operator.recv(2048)
    assert stop(operator, address, driver, StopRequests("r1", b"", 70))


def test_receiver_outlives_a_driver_process_and_ends_with_the_last_holder_of_its_pipe(started, operator):
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], ""))
    assert stop(operator, address, Driver(process), StopRequests("r1", b"", 7))
    operator.sendto(StopRequests("r1", b"", 70).datagrams()[0], address)  # no driver process lives
    later = Driver(process)
    assert until(lambda: later.turn() or later.applied, START_S)
    process.near.close()
    assert until(lambda: process._process.poll() == 0, START_S)


def test_receiver_serves_on_after_a_signal_to_all_processes_of_the_robot(started, operator):
    """A supervisor sends SIGTERM to all at once, and the wheels still turn."""
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], ""))
    driver = Driver(process)
    assert stop(operator, address, driver, StopRequests("r1", b"", 7))
    process._process.terminate()
    assert stop(operator, address, driver, StopRequests("r1", b"", 70)) and process._process.poll() is None


def test_a_killed_receiver_is_logged_and_started_again(started, operator, caplog):
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], ""))
    driver = Driver(process)
    assert stop(operator, address, driver, StopRequests("r1", b"", 7))
    process._process.kill()
    process._process.wait()
    process.keep_alive(now_us() + 2_000_000)
    assert stop(operator, address, driver, StopRequests("r1", b"", 70))
    assert caplog.messages == ["STOP receiver ended (-9); starting it again"]


def report_for(process, seconds, *, begin_us):
    """Let a robot at rest send its reports for `seconds`, while its guardian looks after the process."""
    for tenth in range(10 * seconds):
        send_packet(process.near, pack_report(DriverReport(0, "DISARMED", True, True)))
        process.keep_alive(begin_us + 100_000 * tenth)


def test_stopped_receiver_is_logged_and_started_again(started, operator, caplog):
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], ""))
    driver, begin_us = Driver(process), now_us() + 3_000_000
    assert stop(operator, address, driver, StopRequests("r1", b"", 7))
    assert until(lambda: process._unread_bytes() == 0, START_S)
    process.keep_alive(begin_us - 1_000_000)
    stopped = process._process
    stopped.send_signal(signal.SIGSTOP)
    report_for(process, 6, begin_us=begin_us)
    assert stopped.poll() is None and not caplog.messages, "the machine may be busy"
    report_for(process, 2, begin_us=begin_us + 6_000_000)
    assert stopped.wait(START_S) == -signal.SIGKILL
    report_for(process, 2, begin_us=begin_us + 8_000_000)
    assert caplog.messages == ["STOP receiver ended (stopped or hung); starting it again"]
    assert stop(operator, address, driver, StopRequests("r1", b"", 70))
    process._process.kill()
    process._process.wait()
    process.keep_alive(begin_us + 20_000_000)
    assert caplog.messages[1:] == ["STOP receiver ended (-9); starting it again"]


@pytest.mark.parametrize("behind_s", [1, 3, 4])
def test_receiver_that_is_late_but_reads_is_left_alone(started, operator, caplog, behind_s):
    address = ("127.0.0.1", free_port())
    process = started(stop_receiver.start("r1", [address], [], ""))
    driver, begin_us = Driver(process), now_us() + 1_000_000
    assert stop(operator, address, driver, StopRequests("r1", b"", 7))
    running = process._process
    for turn in range(3):
        running.send_signal(signal.SIGSTOP)
        report_for(process, 2 + behind_s, begin_us=begin_us + 10_000_000 * turn)
        running.send_signal(signal.SIGCONT)
        assert until(lambda: process._unread_bytes() == 0, START_S)
        process.keep_alive(begin_us + 10_000_000 * turn + 9_000_000)
    assert process._process is running and running.poll() is None and not caplog.messages


class Unread:
    """A process that does not read."""

    pid, returncode = 1, None

    def poll(self):
        return self.returncode

    def kill(self):
        self.returncode = -signal.SIGKILL

    wait = poll


@pytest.mark.parametrize("waiting", [1, 12, 30])
def test_start_that_takes_half_a_minute_is_left_alone_although_reports_wait(monkeypatch, waiting):
    monkeypatch.setattr(subprocess, "Popen", lambda *_arguments, **_options: Unread())
    process = stop_receiver.start("r1", [], [], "")
    for _ in range(waiting):
        send_packet(process.near, pack_report(DriverReport(0, "DISARMED", True, True)))
    lives, begin_us = [], 10_000_000
    for second in range(100):
        report_for(process, 1, begin_us=begin_us + second * 1_000_000)
        if process._process not in lives:
            lives.append(process._process)
        assert process._process.poll() is None or second % 31 == 30, "each start gets 30 s"
    assert len(lives) == 4
    while process._unread_bytes():
        process.far.recv(100)
    process.close()


def test_killed_forwarder_is_logged_by_its_own_name(started, caplog):
    process = started(stop_forwarder.start([], ""))
    process._process.kill()
    process._process.wait()
    process.keep_alive(now_us() + 2_000_000)
    assert caplog.messages == ["STOP forwarder ended (-9); starting it again"]


@pytest.mark.parametrize("number", [
    signal.SIGINT, signal.SIGQUIT, signal.SIGTSTP, signal.SIGHUP, signal.SIGTERM,
])
def test_a_signal_during_a_start_of_the_receiver_does_not_end_it(started, monkeypatch, number):
    """A traceback of its imports would be the last that the operator reads."""
    monkeypatch.setattr(stop_port, "_CHILD", "import time; time.sleep(30)")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ())
    process = started(stop_receiver.start("r1", [], [], ""))
    process._process.send_signal(number)
    with pytest.raises(subprocess.TimeoutExpired):
        process._process.wait(0.2)
    assert Path(f"/proc/{process._process.pid}/stat").read_text().split()[2] != "T"
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == before, "this process gets its keys again"


def test_a_port_in_use_is_reported_and_opened_later(started, operator):
    address = ("127.0.0.1", free_port())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(address)
        process = started(stop_receiver.start("r1", [address], [], ""))
        lines = []
        assert until(lambda: lines.extend(read_packets(process.near)) or lines, START_S)
        assert lines[0].startswith(b"LSTOP port 127.0.0.1:") and b"in use" in lines[0]
    assert stop(operator, address, Driver(process), StopRequests("r1", b"", 7))


@pytest.mark.parametrize("secret", [b"", SECRET])
@pytest.mark.parametrize(("operator", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")],
                         indirect=["operator"])
def test_behind_a_router_stop_is_forwarded_and_answered(started, operator, host, tmp_path, secret):
    file = tmp_path / "stop.secret"
    file.write_bytes(SECRET)
    name, router = str(file) if secret else "", (host, free_port())
    started(stop_forwarder.start([router], name))
    robot = started(stop_receiver.start("r1", [], [router], name))
    assert stop(operator, router, Driver(robot), StopRequests("r1", secret, 7))


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_router_of_a_name_with_both_families_gets_a_registration_on_its_own(monkeypatch, host):
    if host == "::1":
        need_ipv6()
    resolve, number = socket.getaddrinfo, free_port()
    pipe, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    router, port = stop_port._bound((host, number)), StopPort(pipe, [], outgoing=True)
    monkeypatch.setattr(socket, "getaddrinfo", lambda _name, *rest, **more: [
        one for address in ("::1", "127.0.0.1") for one in resolve(address, *rest, **more)])
    assert port.send_out(b"a registration", ("router.local", number)) == ""
    router.settimeout(5)
    assert router.recv(64) == b"a registration"
    for one in (pipe, theirs, router, *port._sockets.values()):
        one.close()


def test_router_that_cannot_be_addressed_is_logged_once():
    def denied(_data, _place):
        raise PermissionError(errno.EACCES, "Permission denied")

    lines = []
    pipe, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    port = StopPort(pipe, [], outgoing=True)
    port.log = lines.append
    receiver = stop_receiver.StopReceiver(port, "r1", b"", ())
    receiver._routers = [(("127.0.0.1", 7448), Registration("r1", b"", 5))]
    port._outgoing = {socket.AF_INET: SimpleNamespace(sendto=denied)}
    for _ in range(3):
        receiver._register()
    assert len(lines) == 1
    assert lines[0].startswith("STOP port 127.0.0.1:7448/udp of the router: Permission denied; trying again, ")
    for one in (pipe, theirs, *port._sockets.values()):
        one.close()


def test_answers_that_no_registration_awaits_are_counted():
    """Also at a robot that connects to routers, which awaits others."""
    pipe, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.setblocking(False)
    port = StopPort(pipe, [], outgoing=True)
    receiver = stop_receiver.StopReceiver(port, "r1", b"", ())
    receiver._routers = [(("127.0.0.1", 7448), Registration("r1", b"", first)) for first in (5, 50)]
    assert [unpack_stop(one.datagram()).counter for _, one in receiver._routers] == [7, 52]
    for counter in (5, 7, 52, 53):
        answer = pack_stop(StopDatagram(Kind.ANSWER, "r1", counter, b"x" * 16))
        assert receiver.on_datagram(answer, (0, ("127.0.0.1", 7448))) in ((), [])
    receiver.on_turn()
    assert [unpack_ignored(packet)[0] for packet in read_packets(theirs)] == [{"MALFORMED": 2}]
    for one in (pipe, theirs, *port._sockets.values()):
        one.close()


def test_with_keys_an_answer_that_is_sent_back_stops_nothing(started, operator, tmp_path):
    file = tmp_path / "stop.secret"
    file.write_bytes(SECRET)
    address = ("127.0.0.1", free_port())
    driver = Driver(started(stop_receiver.start("r1", [address], [], str(file))))

    def reflected():
        operator.sendto(pack_stop(StopDatagram(Kind.STOP, "r1", 7)), address)
        with suppress(OSError):
            operator.sendto(operator.recv(2048), address)
        driver.turn()
        return driver.ignored or driver.applied

    assert until(reflected, START_S)
    assert driver.ignored.keys() == {"MALFORMED"} and driver.applied == 0


def test_with_keys_datagrams_of_an_earlier_start_are_ignored(started, operator, tmp_path):
    file = tmp_path / "stop.secret"
    file.write_bytes(SECRET)
    address, recorded = ("127.0.0.1", free_port()), []

    class Recorder:
        def sendto(self, data, to):
            recorded.append(data)
            operator.sendto(data, to)

        recv = operator.recv

    first = started(stop_receiver.start("r1", [address], [], str(file)))
    assert stop(Recorder(), address, Driver(first), StopRequests("r1", SECRET, 7))
    first.close()
    second = started(stop_receiver.start("r1", [address], [], str(file)))
    driver = Driver(second)
    signed = [data for data in recorded if any(unpack_stop(data).challenge)]

    def ignored():
        for data in signed:
            operator.sendto(data, address)
        driver.turn()
        return driver.ignored.get("OTHER_SESSION")

    assert signed and len(signed[0]) == DATAGRAM_BYTES and until(ignored, START_S)
    assert driver.applied == 0
    forged = unpack_stop(signed[0])._replace(counter=9)
    operator.sendto(pack_stop(forged, b"another"), address)
    assert until(lambda: driver.turn() or "OTHER_SESSION" in driver.ignored, START_S) and driver.applied == 0
