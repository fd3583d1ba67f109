"""The reachable addresses that a robot on every interface logs."""

import socket

import pytest

from sightline.robot_side.network import process as addresses
from sightline.robot_side.network.process import own_addresses, reachable_endpoints
from tests.fixtures.ports import free_port


@pytest.mark.parametrize(("endpoints", "said"), [
    (["tcp/0.0.0.0:7447"], ["tcp/10.0.0.7:7447", "tcp/192.168.1.20:7447"]),
    (["tls/[::]:7447"], ["tls/10.0.0.7:7447", "tls/192.168.1.20:7447"]),
    (["tcp/127.0.0.1:7447", "ws://0.0.0.0:9091"], ["ws://10.0.0.7:9091", "ws://192.168.1.20:9091"]),
    (["tcp/127.0.0.1:7447", "tcp/10.0.0.7:7447"], []), ([], []),
])  # fmt: skip
def test_only_wildcard_endpoints_are_listed_by_address(endpoints, said, monkeypatch):
    monkeypatch.setattr(addresses, "own_addresses", lambda: ["10.0.0.7", "192.168.1.20"])
    assert reachable_endpoints(endpoints) == said


def test_listed_addresses_belong_to_this_machine():
    for address in own_addresses():
        assert not address.startswith("127.")
        with socket.socket() as probe:
            probe.bind((address, free_port()))  # only an address of this machine can be bound


def test_machine_with_loopback_alone_lists_no_address(monkeypatch):
    monkeypatch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "nothing0")])
    assert own_addresses() == [] == reachable_endpoints(["tcp/0.0.0.0:7447"])
