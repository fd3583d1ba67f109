"""Being found and finding, by multicast: a comfort for people, never a way that a service relies on. Shell.

Who listens beyond loopback answers on a group and port of Sightline's own, so that other Zenoh programs on the network
neither find it nor are found; it connects to nobody by itself. Explicit endpoints need none of this.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from typing import Any, Final

from protocol.errors import ConfigError
from protocol.transports.endpoints import check_endpoint

GROUP: Final = ("224.0.0.224", 7449)
"""Zenoh's own group, three ports above Zenoh's own port."""
MAX_LISTENERS: Final = 64
"""Security limit: no more answers than this are kept."""
NO_MULTICAST: Final = {"enabled": False}
LOOPBACK: Final = ("localhost", "127.", "::1")


def multicast_section(listen: Sequence[str]) -> dict[str, Any]:
    """Zenoh's `scouting/multicast`: on for who listens beyond loopback, which is an owner's decision."""
    if all(check_endpoint(endpoint)[1].startswith(LOOPBACK) for endpoint in listen):
        return NO_MULTICAST
    nobody: dict[str, list[str]] = {"router": [], "peer": [], "client": []}
    return {"enabled": True, "listen": True, "address": _address(), "autoconnect": nobody}


def find_listeners(seconds: float) -> list[str]:
    """An endpoint of each listener that answers within `seconds`; none where multicast does not work.

    Raises ConfigError if Zenoh is not installed.
    """
    try:
        import zenoh
    except ImportError:
        raise ConfigError("Zenoh is not installed: pip install 'sightline[zenoh]'") from None
    logging.getLogger("zenoh").addHandler(logging.NullHandler())
    answers: zenoh.handlers.RingChannel[zenoh.Hello] = zenoh.handlers.RingChannel(MAX_LISTENERS)
    config = {"scouting": {"multicast": {"enabled": True, "address": _address()}}}
    try:
        with zenoh.scout(answers, zenoh.WhatAmIMatcher("router"), zenoh.Config.from_json5(json.dumps(config))) as scout:
            time.sleep(seconds)
            hellos = iter(scout.try_recv, None)
            found = {str(hello.zid): [locator for text in hello.locators if (locator := _usable(text))]
                     for hello in hellos}
    except zenoh.ZError:  # no network at all
        return []
    return sorted(min(usable, key=lambda locator: "[" in locator) for usable in found.values() if usable)


def _usable(locator: str) -> str:
    text = str(locator).partition("?")[0].partition("#")[0]
    try:
        check_endpoint(text)
    except ConfigError:
        return ""
    return text


def _address() -> str:
    return f"{GROUP[0]}:{GROUP[1]}"
