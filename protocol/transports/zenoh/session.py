"""Being found and finding, by multicast: a comfort for people, never a way that a service relies on. Shell.

Who listens beyond loopback answers on a group and port of Sightline's own, so that other Zenoh programs on the network
neither find it nor are found; it connects to nobody by itself. Explicit endpoints need none of this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from sightline.protocol.transports.endpoints import parse_zenoh_endpoint

MULTICAST_GROUP: Final = ("224.0.0.224", 7449)
"""Zenoh's own group, three ports above Zenoh's own port."""
MULTICAST_OFF: Final = {"enabled": False}
LOOPBACK: Final = ("localhost", "127.", "::1")


def multicast_section(listen: Sequence[str]) -> dict[str, Any]:
    """Zenoh's `scouting/multicast`: on for who listens beyond loopback, which is an owner's decision."""
    if all(parse_zenoh_endpoint(endpoint)[1].startswith(LOOPBACK) for endpoint in listen):
        return MULTICAST_OFF
    nobody: dict[str, list[str]] = {"router": [], "peer": [], "client": []}
    return {"enabled": True, "listen": True, "address": multicast_address(), "autoconnect": nobody}


def multicast_address() -> str:
    return f"{MULTICAST_GROUP[0]}:{MULTICAST_GROUP[1]}"
