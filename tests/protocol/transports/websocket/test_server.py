"""Admission at a robot's WebSocket: sub-protocol, site, number, and the wait for an unidentified client."""

import socket
import time

import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from sightline.protocol.transports.endpoints import host_problem, origin_problem
from sightline.protocol.transports.websocket.framing import BAD_FRAMING
from sightline.protocol.transports.websocket.server import (
    CROSS_SITE,
    MAX_CLIENTS,
    MAX_HANDSHAKES,
    TOO_MANY_CLIENTS,
    WRONG_SUBPROTOCOL,
)
from tests.fixtures.links import hail, until
from tests.fixtures.websocket import V1, Robot, upgrade


@pytest.mark.parametrize("offer", [None, ["sightline.v2"], ["chat", "graphql-ws"]])
def test_client_without_the_sub_protocol_is_rejected(robot, offer):
    with pytest.raises(InvalidStatus) as refusal:
        connect(robot.endpoint, subprotocols=offer, legacy=True)
    assert refusal.value.response.status_code == 400
    assert b"offer the sub-protocol sightline.v1" in refusal.value.response.body
    assert robot.rejected == {WRONG_SUBPROTOCOL: 1}
    robot.still_serves()


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1", "file://"])
def test_page_of_another_site_is_rejected(robot, origin):
    with pytest.raises(InvalidStatus) as refusal:
        connect(robot.endpoint, origin=origin, **V1)
    assert refusal.value.response.status_code == 403
    assert b"differs from Host" in refusal.value.response.body
    assert robot.rejected == {CROSS_SITE: 1}
    robot.still_serves()


def test_page_of_the_robots_own_address_connects(robot):
    hailed = connect(robot.endpoint, origin=robot.endpoint.replace("ws://", "http://"), **V1)
    hailed.close()
    assert robot.rejected == {}


def test_foreign_host_name_of_this_address_is_rejected(robot):
    with socket.create_connection(robot.address) as near:
        near.sendall(upgrade("evil.example:9090", "Origin: http://evil.example:9090\r\n"))
        answer = near.recv(4096)
    assert answer.startswith(b"HTTP/1.1 403 ")
    assert b"connect by its address or .local name" in answer
    assert robot.rejected == {CROSS_SITE: 1}


@pytest.mark.parametrize("host", ["127.0.0.1:9090", "[::1]:9090", "10.0.0.7", "robot:9090", "Robot.local", "r.example"])
def test_names_that_no_foreign_site_can_own_are_hosts(host):
    assert host_problem([host], "R.example") == ""
    assert origin_problem([f"http://{host}"], host) == ""
    assert origin_problem([f"http://{host}x"], host)


@pytest.mark.parametrize("hosts", [[], ["a", "b"], ["evil.example"], ["127.0.0.1.evil.example:1"], ["a.local.example"]])
def test_other_hosts_are_a_problem(hosts):
    assert host_problem(hosts, "127.0.0.1")


def test_clients_over_the_limit_are_rejected(robot):
    guests = [hail(robot.endpoint, role="teleop") for _ in range(MAX_CLIENTS - 1)]  # one place is the healthy peer's
    with pytest.raises(InvalidStatus) as refusal:
        connect(robot.endpoint, **V1)
    assert refusal.value.response.status_code == 503
    assert b"16 clients are connected" in refusal.value.response.body
    assert robot.rejected == {TOO_MANY_CLIENTS: 1}
    robot.still_serves()
    guests.pop().close()
    assert until(lambda: _comes_in(robot))
    for guest in guests:
        guest.close()


def _comes_in(robot: Robot) -> bool:
    try:
        hail(robot.endpoint).close()
    except (InvalidHandshake, ConnectionClosed, OSError):  # no place yet
        return False
    return True


def test_silent_connections_are_few_and_short_lived(robot):
    silent = [socket.create_connection(robot.address) for _ in range(MAX_CLIENTS + MAX_HANDSHAKES + 8)]
    robot.still_serves()
    assert until(lambda: robot.rejected[TOO_MANY_CLIENTS] >= 8)
    silent[-1].settimeout(3)
    assert silent[-1].recv(1) == b""  # unheard, at once
    silent[0].settimeout(3)
    assert silent[0].recv(1) == b""  # after the two seconds of a handshake
    assert until(lambda: _comes_in(robot), 3)
    for connection in silent:
        connection.close()


def test_incomplete_request_ends_at_its_deadline(robot):
    with socket.create_connection(robot.address) as near:
        near.sendall(upgrade("127.0.0.1")[:60])
        near.settimeout(3)
        begin_s = time.monotonic()
        assert near.recv(1) == b""
        assert 1.5 < time.monotonic() - begin_s < 2.7
    robot.still_serves()


@pytest.mark.parametrize("request_host", ["127.0.0.1", "evil.example"])
def test_invalid_data_after_the_request_is_rejected(robot, request_host, capfd):
    with socket.create_connection(robot.address) as near:
        near.sendall(upgrade(request_host) + b"\xff\xff\xff\xff")
        near.settimeout(3)
        while near.recv(4096):
            pass
    assert until(lambda: robot.rejected == {BAD_FRAMING: 1})
    assert "Traceback" not in capfd.readouterr().err
    robot.still_serves()
