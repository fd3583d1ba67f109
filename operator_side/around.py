"""Who is there: at the endpoints that a person names, on this machine, or wherever the network answers. Shell."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from sightline.operator_side.client import discovery as around_text
from sightline.protocol.errors import ConfigError, LinkError, SightlineError
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint
from sightline.protocol.transports.zenoh.discovery import Discovered, discover, find_listeners
from sightline.robot_side.config import DEFAULT_ENDPOINT

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
            for line in around_text.lines(around.statuses, around.peers):
                yield line if len(self.places) == 1 else f"{place}: {line}"

    def as_object(self) -> dict[str, Any]:
        """For scripts: what all places gave together, and what each could not."""
        whole: dict[str, Any] = {"robots": [], "peers": [], "places": list(self.places), "errors": {}}
        for place, around in self.places.items():
            if isinstance(around, SightlineError):
                whole["errors"][place] = str(around)
                continue
            for name, rows in around_text.as_object(around.statuses, around.peers).items():
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
    with ThreadPoolExecutor(len(places)) as pool:
        return DiscoveryReport(dict(zip(places, pool.map(lambda place: _looked(place, seconds, secure), places), strict=True)))


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
