"""Who is there, in words and as an object: `sightline robots`. Pure."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from sightline.operator_side.client.requests import read_report
from sightline.operator_side.client.status import status_line
from sightline.protocol.errors import WireError
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.zenoh.presence import PeerInfo
from sightline.protocol.transports.security import ROBOT_ROLE

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
