"""STOP by datagrams and by the link at the same time: either of both proves it, and neither holds up the other."""

import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import pytest

from sightline.operator_side.client import requests
from sightline.operator_side.client import stop as client
from sightline.operator_side.client.stop import StopSender, stop_robot
from sightline.protocol.errors import ConfigError, LinkError, RejectReason, WireError
from sightline.protocol.messages import State, Status
from sightline.protocol.transports import open as open_module
from sightline.protocol.transports import stop_port
from sightline.protocol.transports.stop_datagram import unpack_stop
from sightline.robot_side.guardian.stop_core import DriverReport, ReceiverCore, pack_report, unpack_number
from tests.fixtures.links import until
from tests.fixtures.ports import free_port, need_ipv6


class Robot:
    """A STOP receiver and a driver process, whose wheels need `turns_s` to zero, on a thread of this process."""

    def __init__(self, port, *, secret=b"", turns_s=0.0, stored=True, state="STOPPED"):
        self.core = ReceiverCore("r1", secret, b"c" * 16, 50)
        self.turns_s, self.stored, self.state = turns_s, stored, state
        self.reasons, self.stopped_s = [], 0.0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.02)
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        applied = 0
        while not self._ending.is_set():
            if packet := self.core.packet(0):
                applied, self.stopped_s = unpack_number(packet), self.stopped_s or time.monotonic()
                if self.state != "STOPPED":
                    applied = 0
            at_rest = bool(self.stopped_s) and time.monotonic() - self.stopped_s >= self.turns_s
            state = self.state if self.stopped_s else "ACTIVE"
            self.core.on_report(pack_report(DriverReport(applied, state, at_rest, at_rest and self.stored)), 0)
            try:
                data, place = self._socket.recvfrom(2048)
                self._socket.sendto(self.core.on_stop(data, unpack_stop(data), 0), place)
            except TimeoutError:
                continue
            except WireError as error:
                self.reasons.append(error.reason)

    def close(self):
        self._ending.set()
        self._thread.join()
        self._socket.close()


@pytest.fixture
def port():
    return free_port()


@pytest.fixture
def robot(port):
    made = []

    def start(**options):
        made.append(Robot(port, **options))
        return made[0]

    yield start
    for one in made:
        one.close()


@pytest.fixture
def link(monkeypatch):
    """Replace the link: `link.opens` raises, hangs, or returns a status."""

    class Links:
        def __init__(self):
            self.begun_s, self.status, self.error, self.hangs = 0.0, None, None, threading.Event()

        @contextmanager
        def open_link(self, _robot, **_options):
            self.begun_s = time.monotonic()
            if self.error:
                raise self.error
            yield self

    class LinkOperator:
        def __init__(self, links):
            self.links, self.report = links, None

        def stop(self, _on_slow, _timeout_s, is_proven):
            until(lambda: is_proven() or self.links.status, 5.0)
            return self.links.status

    links = Links()
    monkeypatch.setattr(open_module, "open_link", links.open_link)
    monkeypatch.setattr(requests, "Operator", LinkOperator)
    return links


def stop(port, secret_file="", timeout_s=5.0, on_slow=lambda: None):
    return stop_robot("r1", [f"tcp/127.0.0.1:{port - 1}"], "", str(secret_file), on_slow, timeout_s=timeout_s)


STOPPED = Status(state=State.STOPPED, reason="STOP by operator")


@pytest.mark.alone
def test_stop_returns_when_the_wheels_are_at_zero(robot, link, port):
    one = robot(turns_s=0.3)
    assert stop(port, on_slow=lambda: pytest.fail("slow"))
    assert time.monotonic() - one.stopped_s >= 0.3


@pytest.fixture
def busy(monkeypatch):
    """A robot on a busy machine has more time for its first answer."""
    monkeypatch.setattr(client, "_FIRST_S", 3.0)


def test_an_answered_datagram_needs_no_link(robot, link, port, busy):
    robot(turns_s=0.2)
    assert stop(port) and not link.begun_s


def test_status_of_the_link_does_not_overrule_a_robot_whose_wheels_are_not_at_zero(robot, link, port, busy):
    """The commanded zero may never have reached the motors."""
    robot(turns_s=60.0)
    link.status = STOPPED
    with pytest.raises(LinkError, match="did not confirm STOP within 2 s; cut its power by hand"):
        stop(port, timeout_s=2.0)


@pytest.mark.alone
def test_an_answer_without_wheels_at_zero_opens_the_link_after_a_second(robot, link, port, busy):
    one = robot(turns_s=2.0)
    assert stop(port) and 1.0 <= link.begun_s - one.stopped_s <= 1.3


def test_the_first_datagram_leaves_before_the_libraries_of_the_link_are_imported(port):
    """The process of the command ends at its first datagram, and prints what it has imported."""
    code = (
        "import os, sys\n"
        "def end(event, arguments):\n"
        "    if event == 'socket.sendto':\n"
        "        print(*{'pydantic', 'zenoh', 'websockets', 'numpy'} & set(sys.modules), flush=True)\n"
        "        os._exit(9)\n"
        "sys.addaudithook(end)\n"
        "from sightline.operator_side.cli import app\n"
        f"app.run(['stop', 'r1', '--connect', 'tcp/127.0.0.1:{port - 1}'])\n"
    )
    run = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True, timeout=30)
    assert (run.returncode, run.stdout) == (9, "\n"), run.stderr


def test_a_link_that_cannot_be_opened_does_not_matter(robot, link, port):
    link.error = LinkError("no answer")
    robot()
    assert stop(port)


def test_without_an_answer_the_status_of_the_link_proves_the_stop(link, port):
    link.status = STOPPED
    assert stop(port)


def test_without_an_answer_the_error_of_the_link_is_reported(link, port):
    link.error = LinkError("no answer from tcp/127.0.0.1:1")
    with pytest.raises(LinkError, match="no answer from tcp"):
        stop(port)


def test_a_stop_that_the_disk_does_not_store_is_reported(robot, link, port, monkeypatch):
    monkeypatch.setattr(client, "_STORED_S", 0.1)
    robot(stored=False)
    assert not stop(port)


def test_a_robot_that_goes_on_ends_in_an_error_and_a_warning(robot, link, port):
    robot(state="ACTIVE")
    slow = []
    with pytest.raises(LinkError, match=r"did not confirm STOP within 0\.5 s; cut its power by hand"):
        stop(port, timeout_s=0.5, on_slow=lambda: slow.append(1))
    assert slow == [1]


def test_robot_of_another_id_is_not_stopped_and_the_fix_is_named(robot, link, port):
    one = robot()
    with pytest.raises(LinkError, match=r"cut its power by hand; if 'r7' is not its id, `sightline robots` lists"):
        stop_robot("r7", [f"tcp/127.0.0.1:{port - 1}"], "", "", lambda: None, timeout_s=0.3)
    assert one.reasons and set(one.reasons) == {RejectReason.OTHER_ROBOT} and not one.stopped_s


def test_with_keys_the_secret_is_used(robot, link, port, tmp_path):
    (tmp_path / "stop.secret").write_text("a secret of this site\n")
    one = robot(secret=b"a secret of this site")
    assert stop(port, tmp_path / "stop.secret") and one.reasons == []


def test_keys_of_another_deployment_stop_nothing(robot, link, port, tmp_path):
    (tmp_path / "stop.secret").write_text("a secret of another site\n")
    one = robot(secret=b"a secret of this site")
    with pytest.raises(LinkError, match="did not confirm"):
        stop(port, tmp_path / "stop.secret", timeout_s=0.4)
    assert not one.stopped_s


def test_another_secret_is_reported_although_the_link_stops_the_robot(robot, link, port, tmp_path):
    (tmp_path / "stop.secret").write_text("a secret of another site\n")
    robot(secret=b"a secret of this site")
    link.status, reported = Status(state=State.STOPPED, reason="STOP"), []
    assert stop_robot("r1", [f"tcp/127.0.0.1:{port - 1}"], "", str(tmp_path / "stop.secret"), lambda: None,
                      on_other_secret=lambda: reported.append(1))
    assert reported == [1]


def test_a_missing_secret_is_named(robot, link, port):
    robot(secret=b"a secret of this site")
    with pytest.raises(LinkError, match=r"copy stop\.secret"):
        stop(port, timeout_s=0.4)


def test_options_without_keys_are_named_in_place_of_a_missing_secret(robot, link, port):
    robot(secret=b"a secret of this site")
    link.error = ConfigError("a tls/ endpoint needs keys; pass --secure DIR")
    with pytest.raises(ConfigError, match="pass --secure DIR"):
        stop(port)


@pytest.mark.parametrize("options", [{}, {"turns_s": 1.5}])
def test_options_without_keys_do_not_end_a_stop_that_the_robot_accepts(robot, link, port, options):
    robot(**options)
    link.error = ConfigError("a tls/ endpoint needs keys; pass --secure DIR")
    assert stop(port)


def test_without_the_secret_the_link_alone_proves_the_stop(robot, link, port, monkeypatch):
    monkeypatch.setattr(client, "_STORED_S", 60.0)
    robot(secret=b"a secret of this site")
    link.status = STOPPED
    assert stop(port)


def test_datagrams_that_never_show_the_stop_deny_no_disk(robot, link, port, monkeypatch):
    """The link shows it; a receiver without reports of its driver process cannot."""
    monkeypatch.setattr(client, "_STORED_S", 0.1)
    robot(state="ACTIVE")
    link.status = STOPPED
    assert stop(port)


def test_datagrams_go_on_until_the_sender_is_closed(robot, port):
    one = robot()
    with StopSender("r2", [f"tcp/127.0.0.1:{port - 1}"]) as sender:
        assert until(lambda: len(one.reasons) > 3)
        assert set(one.reasons) == {RejectReason.OTHER_ROBOT} and not sender.is_answered
    for thread in sender._threads:
        thread.join()
    count = len(one.reasons)
    time.sleep(0.1)
    assert len(one.reasons) == count


@pytest.fixture
def names(monkeypatch):
    """Names and their addresses, in the order of the resolver; an event in place of them ends without any."""
    resolve, known = socket.getaddrinfo, {}

    def getaddrinfo(name, *rest, **more):
        addresses = known.get(name, (name,))
        if isinstance(addresses, threading.Event):
            addresses.wait(5.0)
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return [one for address in addresses for one in resolve(address, *rest, **more)]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    return known


@pytest.mark.parametrize("listens", ["127.0.0.1", "::1"])
@pytest.mark.parametrize("order", [("::1", "127.0.0.1"), ("127.0.0.1", "::1")])
def test_each_family_of_a_name_gets_the_datagrams(port, names, listens, order):
    need_ipv6()
    names["robot.local"] = order
    with stop_port._bound((listens, port)) as robot, StopSender("r1", [f"tcp/robot.local:{port - 1}"]):
        robot.settimeout(5)
        assert unpack_stop(robot.recv(2048)).robot == "r1"


def test_first_address_of_a_family_is_used(names):
    names["robot.local"] = ("127.0.0.2", "127.0.0.1")
    assert client._resolve(("robot.local", 7448)) == [(socket.AF_INET, ("127.0.0.2", 7448))]


def test_scope_of_an_address_is_kept():
    need_ipv6()
    (family, place), = client._resolve(("fe80::1%lo", 7448))
    assert (family, place[1:]) == (socket.AF_INET6, (7448, 0, socket.if_nametoindex("lo")))


def test_a_name_that_does_not_resolve_delays_no_other_address(robot, port, names):
    names["robot.example"] = waiting = threading.Event()
    robot()
    with StopSender("r1", [f"tcp/robot.example:{port - 1}", f"tcp/127.0.0.1:{port - 1}"]) as sender:
        assert until(lambda: sender.is_stopped, 4.0) and not waiting.is_set()
    waiting.set()


def test_a_name_that_resolves_later_gets_the_datagrams(robot, port, names, monkeypatch):
    monkeypatch.setattr(client, "_RESOLVE_AGAIN_S", 0.01)
    names["robot.local"] = ()
    robot()
    with StopSender("r1", [f"tcp/robot.local:{port - 1}"]) as sender:
        assert not sender.wait(0.0)
        names["robot.local"] = ("127.0.0.1",)
        assert until(lambda: sender.is_stopped, 4.0)
