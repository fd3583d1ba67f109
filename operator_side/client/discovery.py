"""Finds robots and vision services: at given endpoints, on this machine, or by multicast. Shell."""

from __future__ import annotations

import socket
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from sightline.operator_side.client.requests import read_report
from sightline.operator_side.client.status import status_line
from sightline.protocol.errors import ConfigError, LinkError, SightlineError, WireError
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT, parse_zenoh_endpoint
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.security import ROBOT_ROLE
from sightline.protocol.transports.tokens import MAX_ROBOTS, DriverToken, RobotToken, Token, VisionToken
from sightline.protocol.transports.zenoh.discovery import Discovered, discover, find_listeners
from sightline.protocol.transports.zenoh.presence import MAX_PEERS, PeerInfo

_ROLE_WIDTH = 9


def lines(found: Discovered) -> Iterator[str]:
    """Format a line for each robot, then for each other peer."""
    statuses, peers, shared = found.statuses, found.peers, shared_robots(found.tokens)
    robots = {peer.presence.robot: peer for peer in peers if peer.presence.role == ROBOT_ROLE}
    for robot in sorted(_robots(found)):
        state = _status_words(robot, statuses[robot]) if robot in statuses else f"{robot}: no status"
        services = f"; {_services(*shared[robot])}" if robot in shared else ""
        yield f"{ROBOT_ROLE:{_ROLE_WIDTH}} {state}{_about(robots.get(robot))}{services}"
    for peer in peers:
        name = peer.presence.robot
        if peer.presence.role == ROBOT_ROLE and peer is not robots[name]:
            yield f"{ROBOT_ROLE:{_ROLE_WIDTH}} {name}: a second robot has this id{_about(peer)}; end one of them"
        elif peer.presence.role != ROBOT_ROLE:
            yield f"{peer.presence.role:{_ROLE_WIDTH}} of {peer.presence.robot}{_about(peer)}"
    if len(peers) >= MAX_PEERS:
        yield f"{MAX_PEERS} peers are listed, which is the limit; versions of other robots are not known"
    if found.left_out:
        yield f"{found.left_out} more robots are not listed; the limit is {MAX_ROBOTS}"


def _robots(found: Discovered) -> set[str]:
    """Return the robots with a status, an answer or a token."""
    answered = (peer.presence.robot for peer in found.peers if peer.presence.role == ROBOT_ROLE)
    return {*found.statuses, *answered, *(token.robot for token in found.tokens if isinstance(token, RobotToken))}


def as_object(found: Discovered) -> dict[str, Any]:
    """Return the robots and the other peers as JSON types, for scripts."""
    shared = shared_robots(found.tokens)
    robots = [_status_object(name, found.statuses[name]) if name in found.statuses
              else {"robot": name, "error": "no status"} for name in sorted(_robots(found))]
    for robot in robots:
        if robot["robot"] in shared:
            robot["driven_by"], robot["standby"] = shared[robot["robot"]]
    return {"robots": robots, "peers": [_peer_object(peer) for peer in found.peers], "left_out": found.left_out}


def shared_robots(tokens: Collection[Token]) -> dict[str, tuple[str, str]]:
    """Return the services of each shared robot: the one that drives it, and the standby; "" for a missing one."""
    weights = {token.name: token.weight for token in tokens if isinstance(token, VisionToken)}
    if not weights:
        return {}
    from sightline.vision_side.serving.assignment import assign

    robots = [token.robot for token in tokens if isinstance(token, RobotToken)]
    drivers = {token.robot: token.name for token in tokens if isinstance(token, DriverToken)}
    return {
        robot: (drivers.get(robot, ""), next((one for one in choices if one != drivers.get(robot)), ""))
        for robot, choices in assign(robots, weights).items()
    }


def _services(driver: str, standby: str) -> str:
    words = f"service {driver}" if driver else "no service drives it"
    return f"{words}, standby {standby}" if standby else words


def _about(peer: PeerInfo | None) -> str:
    if peer is None:
        return "  (no version reported)"
    one = peer.presence
    where = f"  {one.software} on {one.host or 'an unnamed machine'}, round trip {peer.round_trip_us / 1000:.1f} ms"
    return f"{where}; {one.about}" if one.about else where


def _peer_object(peer: PeerInfo) -> dict[str, Any]:
    one = peer.presence
    return {
        "role": one.role, "robot": one.robot, "session": one.session, "software": one.software, "host": one.host,
        "up_s": round(one.up_us / 1e6, 1), "round_trip_ms": round(peer.round_trip_us / 1000, 3),
        "clock_ahead_ms": round(peer.ahead_us / 1000, 3), **({"about": one.about} if one.about else {}),
    }


def _status_words(robot: str, message: Message) -> str:
    try:
        return status_line(robot, read_report(message).status)
    except WireError as error:
        return f"{robot}: invalid status: {error.detail}"


def _status_object(robot: str, message: Message) -> dict[str, Any]:
    try:
        return {"robot": robot, **read_report(message).status.model_dump(mode="json")}
    except WireError as error:
        return {"robot": robot, "error": error.detail}


# --- at given endpoints, on this machine, or on the network ------------------------------------------------------


SCOUT_S: Final = 0.4
"""Duration of a multicast search. Peers answer within milliseconds, but it is repeated, because Wi-Fi loses many."""
_PROBE_S: Final = 0.2
_PLACES: Final = 16
"""Security limit: number of queried places, even if more peers answer."""


@dataclass(frozen=True, slots=True)
class DiscoveryReport:
    """For each place its robots and peers, or its error."""

    places: dict[str, Discovered | SightlineError]

    def lines(self) -> Iterator[str]:
        """Format lines for the terminal, with the place if there are several."""
        for place, found in self.places.items():
            if isinstance(found, SightlineError):
                yield f"{place}: {found}"
                continue
            for line in lines(found):
                yield line if len(self.places) == 1 else f"{place}: {line}"

    def as_object(self) -> dict[str, Any]:
        """Return the robots and peers of all places as JSON types, and the error of each failed place."""
        whole: dict[str, Any] = {"robots": [], "peers": [], "left_out": 0, "places": list(self.places), "errors": {}}
        for place, found in self.places.items():
            if isinstance(found, SightlineError):
                whole["errors"][place] = str(found)
                continue
            rows = as_object(found)
            whole["left_out"] += rows["left_out"]
            for name in ("robots", "peers"):
                whole[name] += [{**row, "at": place} for row in rows[name]]
        return whole


def discover_all(connect: Sequence[str] | None, seconds: float, secure: str) -> DiscoveryReport:
    """Query the given endpoints. Without them query this machine, then the peers that answer a multicast.

    Raises:
        ConfigError: an endpoint is invalid.
        LinkError: no robot found; the error names the places.
    """
    if connect:
        return _checked(DiscoveryReport({", ".join(connect): discover(_of_zenoh(connect), seconds, secure)}), seconds)
    if _listens(DEFAULT_ENDPOINT):
        endpoint = DEFAULT_ENDPOINT.replace("tcp/", "tls/") if secure else DEFAULT_ENDPOINT
        return _checked(DiscoveryReport({endpoint: discover([endpoint], seconds, secure)}), seconds)
    places = find_listeners(SCOUT_S)[:_PLACES]
    if not places:
        raise LinkError(f"no robot at {DEFAULT_ENDPOINT}, and no answer to a multicast after {SCOUT_S:g} s; "
                        "give the address: sightline robots --connect tcp/ROBOT:7447")
    with ThreadPoolExecutor(len(places), "discovery") as pool:
        found = list(pool.map(lambda place: _queried(place, seconds, secure), places))
    return _checked(DiscoveryReport(dict(zip(places, found, strict=True))), seconds)


def _checked(report: DiscoveryReport, seconds: float) -> DiscoveryReport:
    if any(isinstance(found, Discovered) and (found.peers or _robots(found)) for found in report.places.values()):
        return report
    errors = "; ".join(report.lines())  # without a robot or peer, only errors have a line
    raise LinkError(
        errors or f"no robot at {', '.join(report.places)} after {seconds:g} s; start one: sightline robot"
    )


def _of_zenoh(connect: Sequence[str]) -> Sequence[str]:
    for endpoint in connect:
        if "://" in endpoint:
            raise ConfigError(f"{endpoint} is the address of one robot; run: sightline status --connect {endpoint}")
    return connect


def _queried(place: str, seconds: float, secure: str) -> Discovered | SightlineError:
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
