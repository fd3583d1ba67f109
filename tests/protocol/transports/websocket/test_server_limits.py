"""Places at a robot's WebSocket: viewers and idle unidentified clients never shut out a client that sends STOP."""

import os
import socket
import sys
import threading
from contextlib import ExitStack, suppress

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from sightline.protocol.channels import REQUEST
from sightline.protocol.codec import encode
from sightline.protocol.errors import LinkError
from sightline.protocol.messages import Request
from sightline.protocol.transports.security import ROLES, grants_of_role
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.server import (
    MAX_CLIENTS,
    MAX_HANDSHAKES,
    MAX_HANDSHAKES_PER_ADDRESS,
    RESERVED_SLOTS,
    TOO_MANY_CLIENTS,
    ConnectionLimits,
    may_control,
)
from tests.fixtures.links import hail, until
from tests.fixtures.ports import free_endpoint, port_of
from tests.fixtures.websocket import HELLO, V1, closed_with

WATCHERS = MAX_CLIENTS - RESERVED_SLOTS
TOKENS = {"operator": "operator_0123456789abc", "viewer": "viewerviewerviewer"}


def settled(places: ConnectionLimits, acts: bool) -> str:
    """Admit one more client; return the problem, or an empty text."""
    place = places.admit("10.0.0.1")
    problem = places.promote(place, acts)
    if problem:
        places.leave(place)
    return problem


# --- the places ------------------------------------------------------------------------------------------------------


def test_drivers_operators_and_robots_may_control():
    assert {role for role in ROLES if may_control(grants_of_role(role))} == {"robot", "vision", "operator"}


def test_last_places_are_reserved_for_clients_that_control():
    places = ConnectionLimits()
    assert [settled(places, False) for _ in range(WATCHERS)] == [""] * WATCHERS
    assert "12 clients watch, which is the limit" in settled(places, False)
    assert [settled(places, True) for _ in range(RESERVED_SLOTS)] == [""] * RESERVED_SLOTS
    for acts in (True, False):
        assert "16 clients are connected, which is the limit" in settled(places, acts)


def test_client_that_controls_takes_any_place():
    places = ConnectionLimits()
    assert [settled(places, True) for _ in range(MAX_CLIENTS)] == [""] * MAX_CLIENTS
    assert places.problem(True) == places.problem(False) != ""


def test_unidentified_clients_are_limited_per_address_and_in_total():
    places, given = ConnectionLimits(), []
    for number in range(MAX_HANDSHAKES // MAX_HANDSHAKES_PER_ADDRESS):
        given += [places.admit(f"10.0.0.{number}") for _ in range(MAX_HANDSHAKES_PER_ADDRESS)]
        assert places.admit(f"10.0.0.{number}") is None
    assert None not in given
    assert places.admit("10.0.0.99") is None
    places.leave(given[0])
    assert places.admit("10.0.0.99") is not None


def test_promoted_client_frees_its_unidentified_place():
    places = ConnectionLimits()
    assert [settled(places, True) for _ in range(2 * MAX_HANDSHAKES_PER_ADDRESS)] == [
        ""
    ] * 2 * MAX_HANDSHAKES_PER_ADDRESS
    assert places.admit("10.0.0.1") is not None


# --- over sockets ----------------------------------------------------------------------------------------------------


def test_any_number_of_viewers_leaves_room_for_a_stop(robot):
    asked = robot.link.latest(REQUEST)
    with ExitStack() as ending:
        for _ in range(WATCHERS):
            ending.enter_context(hail(robot.endpoint, role="viewer", wants=["status"]))
        with connect(robot.endpoint, **V1) as late:
            late.send(str(HELLO).replace("'", '"'))
            code, reason = closed_with(late)
        assert (code, reason.partition(":")[0]) == (1013, "12 clients watch, which is the limit")
        assert robot.rejected == {TOO_MANY_CLIENTS: 1}
        with open_websocket("r1", connect=robot.endpoint, role="operator") as person:
            person.publish(REQUEST, b"", encode(Request(id=1, verb="stop")))
            assert b'"stop"' in asked.take(2).payload
        robot.still_serves()


def test_a_guest_may_steer_and_is_not_a_viewer(robot):
    with ExitStack() as ending:
        for _ in range(WATCHERS):
            ending.enter_context(hail(robot.endpoint, role="viewer", wants=["status"]))
        open_websocket("r1", connect=robot.endpoint, role="guest", timeout_s=1).close()


def test_client_rejected_for_idle_connections_retries(robot):
    address = ("127.0.0.1", port_of(robot.endpoint))
    with ExitStack() as ending:
        for _ in range(MAX_HANDSHAKES_PER_ADDRESS):
            ending.enter_context(socket.create_connection(address))
        with pytest.raises(LinkError, match="it closed without an answer: too many connections, or it expects wss://"):
            open_websocket("r1", connect=robot.endpoint, role="operator", timeout_s=0.5)
        gone = threading.Timer(0.5, ending.pop_all().close)
        gone.start()
        with open_websocket("r1", connect=robot.endpoint, role="operator", timeout_s=5):
            gone.join()


def test_unread_log_does_not_block_clients(robot, monkeypatch):
    address = ("127.0.0.1", port_of(robot.endpoint))
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    with os.fdopen(reader, "rb"), ExitStack() as ending:
        monkeypatch.setattr(sys, "stderr", os.fdopen(writer, "w"))
        for _ in range(MAX_HANDSHAKES_PER_ADDRESS + 1):
            ending.enter_context(socket.create_connection(address))
        assert until(lambda: robot.rejected[TOO_MANY_CLIENTS])
        ending.close()
        open_websocket("r1", connect=robot.endpoint, role="operator", timeout_s=5).close()


def test_viewer_without_a_place_receives_the_reason_and_tries_again(robot):
    with ExitStack() as ending:
        viewers = [ending.enter_context(hail(robot.endpoint)) for _ in range(WATCHERS)]
        with pytest.raises(LinkError, match="12 clients watch, which is the limit"):
            open_websocket("r1", connect=robot.endpoint, role="viewer", timeout_s=0.5)
        assert robot.rejected[TOO_MANY_CLIENTS] >= 2
        viewers.pop().close()
        open_websocket("r1", connect=robot.endpoint, role="viewer").close()


def test_viewer_above_the_limit_with_a_token_is_rejected_by_http(keys):
    endpoint = free_endpoint("ws://")
    shown = {role: {"Authorization": f"Bearer {token}"} for role, token in TOKENS.items()}
    with open_websocket("r1", listen=endpoint, secure=keys) as robot, ExitStack() as ending:
        for _ in range(WATCHERS):  # whatever its hello claims
            viewer = ending.enter_context(connect(endpoint, additional_headers=shown["viewer"], **V1))
            viewer.send(str(HELLO | {"role": "operator"}).replace("'", '"'))
            viewer.recv(5)
        with pytest.raises(InvalidStatus) as refusal:
            connect(endpoint, additional_headers=shown["viewer"], **V1)
        assert refusal.value.response.status_code == 503
        assert b"12 clients watch, which is the limit" in refusal.value.response.body
        assert robot.rejected == {TOO_MANY_CLIENTS: 1}
        open_websocket("r1", connect=endpoint, role="operator", secure=keys).close()


def test_idle_unidentified_clients_take_only_the_places_of_their_own_address(robot):
    with ExitStack() as ending:
        for _ in range(MAX_CLIENTS + MAX_HANDSHAKES):
            ending.enter_context(socket.create_connection(robot.address, source_address=("127.0.0.2", 0)))
        expected = MAX_CLIENTS + MAX_HANDSHAKES - MAX_HANDSHAKES_PER_ADDRESS
        assert until(lambda: robot.rejected == {TOO_MANY_CLIENTS: expected}, 1)
        hail(robot.endpoint, role="operator").close()
        robot.still_serves()


def test_a_thread_that_cannot_start_costs_one_client_and_no_place(robot, monkeypatch):
    start, failed = threading.Thread.start, []

    def starts_late(thread) -> None:
        if thread.name == "websocket-peer" and len(failed) < 2 * MAX_HANDSHAKES_PER_ADDRESS:
            failed.append(thread)
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", starts_late)
    for _ in range(2 * MAX_HANDSHAKES_PER_ADDRESS):
        with socket.create_connection(robot.address, 3) as near:
            assert near.recv(1) == b""  # closed, not left to wait
    assert robot.rejected == {TOO_MANY_CLIENTS: 2 * MAX_HANDSHAKES_PER_ADDRESS}
    hail(robot.endpoint).close()
    robot.still_serves()
