"""`sightline robots` without an address: what the places that answer a multicast have, and what none of them has."""

import pytest

from sightline.operator_side.client import discovery
from sightline.operator_side.client.discovery import discover_all
from sightline.protocol.channels import STATUS
from sightline.protocol.errors import LinkError
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.tokens import RobotToken
from sightline.protocol.transports.zenoh.discovery import Discovered

PLACES = ["tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447"]
EMPTY = Discovered({}, [])
ROBOT = Discovered({"r1": Message(STATUS, "", b"", b"")}, [])


@pytest.fixture
def network(monkeypatch):
    """Robots and peers at each of two places, or its error."""
    found = {}

    def discover(connect, _seconds, _secure):
        if isinstance(found[connect[0]], LinkError):
            raise found[connect[0]]
        return found[connect[0]]

    monkeypatch.setattr(discovery, "_listens", lambda _endpoint: False)
    monkeypatch.setattr(discovery, "find_listeners", lambda _seconds: PLACES)
    monkeypatch.setattr(discovery, "discover", discover)
    return found


def test_places_without_a_robot_are_an_error_that_names_them(network):
    network.update(dict.fromkeys(PLACES, EMPTY))
    with pytest.raises(LinkError) as error:
        discover_all(None, 0.6, "")
    assert str(error.value) == f"no robot at {', '.join(PLACES)} after 0.6 s; start one: sightline robot"


def test_errors_of_places_without_a_robot_are_reported(network):
    network.update(zip(PLACES, [EMPTY, LinkError("pass --secure DIR")], strict=True))
    with pytest.raises(LinkError) as error:
        discover_all(None, 0.6, "")
    assert str(error.value) == f"{PLACES[1]}: pass --secure DIR"


def test_robot_with_only_a_token_is_listed(network):
    network.update(zip(PLACES, [EMPTY, Discovered({}, [], frozenset([RobotToken("r1")]))], strict=True))
    report = discover_all(None, 0.6, "")
    assert list(report.lines()) == [f"{PLACES[1]}: robot     r1: no status  (no version reported)"]
    assert report.as_object()["robots"] == [{"robot": "r1", "error": "no status", "at": PLACES[1]}]


@pytest.mark.parametrize("other", [EMPTY, LinkError("no answer")])
def test_robot_at_one_place_is_listed(network, other):
    network.update(zip(PLACES, [ROBOT, other], strict=True))
    lines = list(discover_all(None, 0.6, "").lines())
    assert lines[0].startswith(f"{PLACES[0]}: robot     r1: ") and len(lines) == (1 if other is EMPTY else 2)
