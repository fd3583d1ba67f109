"""The kit reaches the STOP port of a host that listens on one of its addresses."""

import socket

import pytest

from sightline.conformance.raw_peers import RawStopPort
from sightline.protocol.errors import LinkError
from tests.fixtures.ports import free_port


@pytest.mark.parametrize("first", [socket.AF_INET, socket.AF_INET6])
def test_name_with_addresses_of_both_families_reaches_a_host_that_listens_on_one(monkeypatch, first):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as robot:
        number = free_port()
        robot.bind(("127.0.0.1", number))
        robot.settimeout(2)
        found = [(socket.AF_INET, 0, 0, "", ("127.0.0.1", number)), (socket.AF_INET6, 0, 0, "", ("::1", number))]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found if first == socket.AF_INET else found[::-1])
        with RawStopPort("tcp/robot.local:7447") as port:
            port.send(b"STOP")
            data, place = robot.recvfrom(9)
            robot.sendto(b"answer", place)
            assert (data, port.received()) == (b"STOP", [b"answer"])


def test_host_without_an_address_is_one_line():
    with pytest.raises(LinkError, match=r"^tcp/robot\.invalid:7447: .*; check the address$"):
        RawStopPort("tcp/robot.invalid:7447")
