"""The hosts connected to a port: the system's table of TCP sockets, and reports of a host with too many connections."""

import socket
from contextlib import ExitStack

import pytest

from sightline.protocol.transports import diagnosis
from sightline.protocol.transports.diagnosis import connection_ends
from sightline.protocol.transports.flood_limits import limit_floods
from sightline.protocol.transports.zenoh.session import MAX_SESSIONS
from tests.fixtures.links import until
from tests.fixtures.ports import free_port

_ROWS = "  sl  local_address rem_address   st\n   0: {local} {remote} {state} 0 0 0 0\n"


@pytest.mark.parametrize(("table", "local", "remote", "host"), [
    ("tcp", "0100007F:1D17", "0701A8C0:C001", "192.168.1.7"),
    ("tcp6", "00000000000000000000000000000000:1D17", "0000000000000000FFFF00000701A8C0:C001", "192.168.1.7"),
    ("tcp6", "00000000000000000000000000000000:1D17", "000080FE000000000000000001000000:C001", "fe80::1"),
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
        assert reported == [
            "67 connections from 127.0.0.1, 22 new ones a second, more than the total limit of 64; "
            "end the program on this machine"
        ]
