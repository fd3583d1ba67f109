"""The hosts connected to a port: the system's table of TCP sockets, and reports of a host with too many connections."""

import os
import re
import socket
import struct
from contextlib import ExitStack
from pathlib import Path

import pytest

from sightline.protocol.transports import diagnosis, flood_limits
from sightline.protocol.transports.diagnosis import connection_ends, opened_connections, own_sockets
from sightline.protocol.transports.flood_limits import limit_floods
from sightline.protocol.transports.zenoh.session import MAX_SESSIONS, close_without_waiting
from tests.fixtures.links import until
from tests.fixtures.ports import free_port

_ROWS = "  sl  local_address rem_address   st\n   0: {local} {remote} {state} 0 0 0 0\n"


@pytest.mark.parametrize(("table", "local", "remote", "host"), [
    ("tcp", "0100007F:1D17", "0701A8C0:C001", "192.168.1.7"),
    ("tcp6", "00000000000000000000000000000000:1D17", "0000000000000000FFFF00000701A8C0:C001", "192.168.1.7"),
    ("tcp6", "00000000000000000000000000000000:1D17", "000080FE000000000000000001000000:C001", "fe80::1"),
    ("tcp", "0701A8C0:1D17", "0701A8C0:C001", "127.0.0.1"),
    ("tcp6", "0000000000000000FFFF00000701A8C0:1D17", "0000000000000000FFFF00000701A8C0:C001", "127.0.0.1"),
])  # fmt: skip
def test_remote_host_is_read_from_the_table(monkeypatch, tmp_path, table, local, remote, host):
    (tmp_path / table).write_text(_ROWS.format(local=local, remote=remote, state="01"))
    monkeypatch.setattr(diagnosis, "TABLES", tmp_path)
    assert list(connection_ends([0x1D17]).values()) == [host]
    assert connection_ends([0x1D18]) == {}


def test_row_that_the_table_repeats_counts_once(monkeypatch, tmp_path):
    row = _ROWS.format(local="0100007F:1D17", remote="0200007F:C001", state="01")
    (tmp_path / "tcp").write_text(row + row.splitlines()[-1] + "\n")
    monkeypatch.setattr(diagnosis, "TABLES", tmp_path)
    assert list(connection_ends([0x1D17]).values()) == ["127.0.0.2"]


@pytest.mark.parametrize("holds_back", [0, 10])
def test_each_opened_connection_is_counted_also_one_that_is_held_back(holds_back):
    with socket.create_server(("127.0.0.1", free_port())) as server, ExitStack() as ending:
        server.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, holds_back)
        for _ in range(3):
            before = opened_connections()
            ending.enter_context(socket.create_connection(server.getsockname()))
            assert until(lambda before=before: opened_connections() > before)


@pytest.mark.parametrize("text", [
    "", "Tcp: A B\n", "Tcp: A B\nTcp: 1\n", "Tcp: A\nTcp: 1\n", "Tcp: PassiveOpens\nTcp: x\n",
])
def test_count_of_another_system_is_unknown(monkeypatch, tmp_path, text):
    monkeypatch.setattr(diagnosis, "TABLES", tmp_path)
    assert opened_connections() is None
    (tmp_path / "snmp").write_text(text)
    (tmp_path / "netstat").write_text(text)
    assert opened_connections() is None


def test_the_table_is_read_only_after_a_new_connection(monkeypatch):
    opened, reads = [0], []
    monkeypatch.setattr(flood_limits, "opened_connections", lambda: opened[0])
    monkeypatch.setattr(flood_limits, "connection_ends", lambda *_: reads.append(1) or {})
    monkeypatch.setattr(flood_limits, "_CHECK_S", 0.01)
    monkeypatch.setattr(flood_limits, "_QUIET_US", 3_600_000_000)
    with limit_floods([f"ws://127.0.0.1:{free_port()}"], lambda _line: None):
        for count in (1, 2, 3):
            assert until(lambda count=count: len(reads) == count)
            assert not until(lambda count=count: len(reads) > count, 0.1)
            opened[0] += 1
        assert until(lambda: len(reads) == 4)
        monkeypatch.setattr(flood_limits, "_QUIET_US", 500_000)
        assert until(lambda: len(reads) >= 5), "and from time to time"


@pytest.mark.parametrize(("listen", "tables"), [
    (["tcp/0.0.0.0:7447", "ws://127.0.0.1:9090"], ["tcp"]), (["tcp/0.0.0.0:7447", "ws://[::1]:9090"], ["tcp", "tcp6"]),
    (["tcp/[::]:7447"], ["tcp", "tcp6"]), (["tls/robot.local:7447"], ["tcp", "tcp6"]),
])  # fmt: skip
def test_table_of_ipv6_is_read_only_for_an_end_that_may_have_such_an_address(monkeypatch, tmp_path, listen, tables):
    row = _ROWS.format(local="0100007F:1D17", remote="0200007F:C001", state="01")
    (tmp_path / "tcp").write_text(row)
    (tmp_path / "tcp6").write_text(row.replace("C001", "C002"))
    monkeypatch.setattr(diagnosis, "TABLES", tmp_path)
    monkeypatch.setattr(flood_limits, "_CHECK_S", 0.01)
    monkeypatch.setattr(flood_limits, "_defer", len)
    seen = []
    monkeypatch.setattr(flood_limits.FloodDetector, "sample", lambda _self, ends, *_: seen.append(ends) or [])
    with limit_floods(listen, lambda _line: None):
        assert until(lambda: seen)
    assert len(seen[0]) == len(tables)


def test_a_flood_of_connections_is_reported_once_with_its_address():
    reported = []
    with socket.create_server(("127.0.0.1", free_port()), backlog=MAX_SESSIONS * 2) as server, ExitStack() as ending:
        address = server.getsockname()
        ending.enter_context(limit_floods([f"tls/127.0.0.1:{address[1]}"], reported.append))
        for _ in range(MAX_SESSIONS):
            ending.enter_context(socket.create_connection(address))
        assert not until(lambda: reported, 1.2), f"as many as are accepted are not a flood: {reported}"
        for _ in range(3):
            ending.enter_context(socket.create_connection(address))
        assert until(lambda: reported, 3.0)
        (line,) = reported
        assert re.fullmatch(  # the table may be read before the last one is in it
            r"6[567] connections from 127\.0\.0\.1, 22 new ones a second, more than the total limit of 64; "
            r"end the program on this machine", line
        )


def linger(one):
    """Return whether a socket waits when it closes, and the time in seconds, which counts only then."""
    return struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))


def test_each_open_socket_of_this_process_is_found_and_can_be_chosen():
    place = ("127.0.0.1", free_port())
    with socket.create_server(place) as server, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        wanted = f"socket:[{os.fstat(server.fileno()).st_ino}]"
        assert [one.getsockname() for one in own_sockets(wanted.__eq__)] == [server.getsockname()]
        assert {server.getsockname(), other.getsockname()} <= {one.getsockname() for one in own_sockets()}


@pytest.mark.own_process
def test_a_number_that_became_a_file_does_not_stay_open(tmp_path):
    path = tmp_path / "file"
    with path.open("w") as file:
        assert list(own_sockets(str(path).__eq__)) == []
        kept = [link.name for link in Path("/proc/self/fd").iterdir() if link.exists() and link.samefile(path)]
        assert kept == [str(file.fileno())]


@pytest.mark.parametrize(("before", "after"), [((1, 10), (0, 10)), ((1, 3), (1, 3)), ((0, 0), (0, 0))])
def test_only_a_connection_with_the_time_to_linger_of_zenoh_is_changed(before, after):
    place = ("127.0.0.1", free_port())
    with socket.create_server(place), socket.create_connection(place) as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", *before))
        close_without_waiting()
        assert linger(one) == after
