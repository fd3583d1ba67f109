"""Which robots and visions are online: at given endpoints, on this machine, or by multicast. Shell."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from sightline.operator_side.client.requests import read_report
from sightline.operator_side.client.status import status_line
from sightline.protocol.errors import ConfigError, LinkError, SightlineError, WireError
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT, parse_zenoh_endpoint
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.security import ROBOT_ROLE
from sightline.protocol.transports.zenoh.discovery import Discovered, discover, find_listeners
from sightline.protocol.transports.zenoh.presence import PeerInfo

_ROLE_WIDTH = 9


def lines(statuses: dict[str, Message], peers: list[PeerInfo]) -> Iterator[str]:
    """A line for each: robots first, then who sees, steers or looks on."""
    robots = {peer.presence.robot: peer for peer in peers if peer.presence.role == ROBOT_ROLE}
    for robot in sorted({*statuses, *robots}):
        said = _status_words(robot, statuses[robot]) if robot in statuses else f"{robot}: says nothing of its state"
        yield f"{ROBOT_ROLE:{_ROLE_WIDTH}} {said}{_about(robots.get(robot))}"
    for peer in peers:
        if peer.presence.role != ROBOT_ROLE:
            yield f"{peer.presence.role:{_ROLE_WIDTH}} of {peer.presence.robot}{_about(peer)}"


def as_object(statuses: dict[str, Message], peers: list[PeerInfo]) -> dict[str, Any]:
    """The same for scripts."""
    return {
        "robots": [_status_object(name, statuses[name]) for name in sorted(statuses)],
        "peers": [_peer_object(peer) for peer in peers],
    }


def _about(peer: PeerInfo | None) -> str:
    if peer is None:
        return "  (does not say what it is)"
    said = peer.presence
    where = f"  {said.software} on {said.host or 'an unnamed machine'}, round trip {peer.round_trip_us / 1000:.1f} ms"
    return f"{where}; {said.about}" if said.about else where


def _peer_object(peer: PeerInfo) -> dict[str, Any]:
    said = peer.presence
    return {
        "role": said.role, "robot": said.robot, "session": said.session, "software": said.software, "host": said.host,
        "up_s": round(said.up_us / 1e6, 1), "round_trip_ms": round(peer.round_trip_us / 1000, 3),
        "clock_ahead_ms": round(peer.ahead_us / 1000, 3), **({"about": said.about} if said.about else {}),
    }


def _status_words(robot: str, message: Message) -> str:
    try:
        return status_line(robot, read_report(message).status)
    except WireError as error:
        return f"{robot}: not understood: {error.detail}"


def _status_object(robot: str, message: Message) -> dict[str, Any]:
    try:
        return {"robot": robot, **read_report(message).status.model_dump(mode="json")}
    except WireError as error:
        return {"robot": robot, "error": error.detail}


# Who is there: at the endpoints that a person names, on this machine, or wherever the network answers. Shell.


SCOUT_S: Final = 0.4
"""Who hears a multicast answers within some milliseconds; one is repeated within this, since Wi-Fi loses many."""
_PROBE_S: Final = 0.2
_PLACES: Final = 16
"""Security limit: no more places are looked at, however many answer."""


@dataclass(frozen=True, slots=True)
class DiscoveryReport:
    """What each place gave: those around it, or why not."""

    places: dict[str, Discovered | SightlineError]

    def lines(self) -> Iterator[str]:
        """For a person; the place is said where there is a choice."""
        for place, around in self.places.items():
            if isinstance(around, SightlineError):
                yield f"{place}: {around}"
                continue
            for line in lines(around.statuses, around.peers):
                yield line if len(self.places) == 1 else f"{place}: {line}"

    def as_object(self) -> dict[str, Any]:
        """For scripts: what all places gave together, and what each could not."""
        whole: dict[str, Any] = {"robots": [], "peers": [], "places": list(self.places), "errors": {}}
        for place, around in self.places.items():
            if isinstance(around, SightlineError):
                whole["errors"][place] = str(around)
                continue
            for name, rows in as_object(around.statuses, around.peers).items():
                whole[name] += [{**row, "at": place} for row in rows]
        return whole


def discover_all(connect: Sequence[str] | None, seconds: float, secure: str) -> DiscoveryReport:
    """Explicit endpoints first; without them this machine, and then whoever answers a multicast.

    Raises ConfigError for an endpoint that is none, LinkError if nobody is there, with what was tried.
    """
    if connect:
        return _someone(DiscoveryReport({", ".join(connect): discover(_of_zenoh(connect), seconds, secure)}), seconds)
    if _listens(DEFAULT_ENDPOINT):
        endpoint = DEFAULT_ENDPOINT.replace("tcp/", "tls/") if secure else DEFAULT_ENDPOINT
        return _someone(DiscoveryReport({endpoint: discover([endpoint], seconds, secure)}), seconds)
    places = find_listeners(SCOUT_S)[:_PLACES]
    if not places:
        raise LinkError(f"nobody listens at {DEFAULT_ENDPOINT}, and nobody answers a multicast within {SCOUT_S:g} s; "
                        "name where one listens: sightline robots --connect tcp/ROBOT:7447")
    with ThreadPoolExecutor(len(places), "discovery") as pool:
        return DiscoveryReport(
            dict(zip(places, pool.map(lambda place: _looked(place, seconds, secure), places), strict=True))
        )


def _someone(found: DiscoveryReport, seconds: float) -> DiscoveryReport:
    for place, around in found.places.items():
        if isinstance(around, Discovered) and not around.statuses and not around.peers:
            raise LinkError(f"no robot is heard at {place} within {seconds:g} s; start one: sightline robot")
    return found


def _of_zenoh(connect: Sequence[str]) -> Sequence[str]:
    for endpoint in connect:
        if "://" in endpoint:
            raise ConfigError(f"{endpoint} leads to one robot and nobody else: sightline status --connect {endpoint}")
    return connect


def _looked(place: str, seconds: float, secure: str) -> Discovered | SightlineError:
    try:
        return discover([place], seconds, secure)
    except SightlineError as error:
        return error


def _listens(endpoint: str) -> bool:
    _, host, port = parse_zenoh_endpoint(endpoint)
    try:
        socket.create_connection((host, port), _PROBE_S).close()
    except OSError:
        return False
    return True
