"""One robot on several endpoints of different kinds at once."""

import logging
import socket

import pytest

from sightline.protocol.channels import DETECTIONS, FRAME, STATUS, TWIST
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports import open as open_module
from sightline.protocol.transports.link import LinkWrapper
from sightline.protocol.transports.open import LinkGroup, Relay, open_link
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint


def test_peers_of_both_kinds_send_and_receive():
    zenoh, web = free_endpoint(), free_endpoint("ws://")
    with open_link("r1", listen=[zenoh, web], role="robot") as robot:
        assert not robot.connected and not LinkWrapper(robot).connected
        twists = robot.latest(TWIST)
        for endpoint in (zenoh, web):
            with open_link("r1", connect=[endpoint], role="vision") as peer:
                frames = peer.latest(FRAME)
                assert until(lambda: robot.has_listener(FRAME)) and robot.connected and LinkWrapper(robot).connected
                assert until(lambda taken=frames.take: robot.publish(FRAME, b"{}", b"jpeg") and taken(0.05))
                assert until(lambda say=peer.publish: say(TWIST, b"{}", b"0|0") and twists.take(0.05))
            assert until(lambda: not robot.has_listener(FRAME))
        assert not robot.publish(STATUS, b"{}", b"{}")


def test_failure_of_one_endpoint_closes_all():
    zenoh, web = free_endpoint(), free_endpoint("ws://")
    with open_link("r1", listen=[web]), pytest.raises(LinkError):
        open_link("r1", listen=[zenoh, web])
    with open_link("r1", listen=[zenoh, web]) as again:
        assert isinstance(again, LinkGroup)


@pytest.mark.parametrize("endpoint", ["ws:/127.0.0.1:1", "http://127.0.0.1:80", "wss//x:1", "ws://127.0.0.1:99999"])
def test_an_endpoint_that_is_invalid_is_named(endpoint):
    with pytest.raises(ConfigError, match="invalid endpoint"):
        open_link("r1", connect=[endpoint])


@pytest.mark.parametrize("endpoint", ["tcp/no-such-host.invalid:7447", "ws://no-such-host.invalid:9090"])
def test_host_name_that_does_not_resolve_is_reported(endpoint, monkeypatch):
    """Not as a robot that does not answer. Resolution fails here without a query, which may take seconds."""
    def fail(host, *_arguments, **_options):
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", fail)
    with pytest.raises(LinkError) as error:
        open_link("r1", connect=[endpoint], timeout_s=0.3)
    assert str(error.value) == (
        f"host 'no-such-host.invalid' in {endpoint} does not resolve; check the name or use an IP address"
    )


def test_links_of_several_robots_are_not_joined():
    with pytest.raises(ConfigError):
        LinkGroup([])


def test_open_that_waits_logs_its_addresses_once(caplog, monkeypatch):
    caplog.set_level(logging.INFO, "sightline")
    monkeypatch.setattr(open_module, "ANNOUNCED_AFTER_S", 0.05)
    ends = [free_endpoint(), free_endpoint()]
    with pytest.raises(LinkError):
        open_link("r1", connect=ends, role="operator", timeout_s=0.3)
    assert caplog.messages == [f"connecting to {ends[0]}, {ends[1]} ..."]


def test_open_that_is_answered_soon_logs_nothing(caplog):
    caplog.set_level(logging.INFO, "sightline")
    endpoint = free_endpoint()
    with open_link("r1", listen=[endpoint], role="robot"), open_link("r1", connect=[endpoint], role="operator"):
        pass
    assert not caplog.messages


@pytest.mark.parametrize(("scheme", "at_once"), [("tcp/", False), ("ws://", True)])
def test_robot_of_one_transport_wants_boxes_only_where_it_passes_them_on_itself(scheme, at_once):
    endpoint = free_endpoint(scheme)
    with (open_link("r1", listen=[endpoint], role="robot") as robot,
          open_link("r1", connect=[endpoint], role="vision") as vision,
          open_link("r1", connect=[endpoint], role="viewer") as viewer):
        Relay(robot)
        robot.subscribe(TWIST, lambda _: None)
        vision.has_listener(DETECTIONS)  # Zenoh answers this question before the next one
        assert until(lambda: vision.has_listener(TWIST))
        assert vision.has_listener(DETECTIONS) is at_once
        received = viewer.latest(DETECTIONS)
        assert until(lambda: vision.has_listener(DETECTIONS))
        assert until(lambda: vision.publish(DETECTIONS, b"{}", b"{}") and received.take(0.2) is not None)
