"""Opens a Zenoh session with our settings and turns its errors into `LinkError`. Shell.

Who listens beyond loopback answers on a group and port of Sightline's own, so that other Zenoh programs on the network
neither find it nor are found; it connects to nobody by itself. Explicit endpoints need none of this.
"""

from __future__ import annotations

import json
import logging
import re
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, LinkError, SightlineError
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.diagnosis import connections, diagnose_tls, port_owner
from sightline.protocol.transports.endpoints import parse_zenoh_endpoint, with_send_buffer
from sightline.protocol.transports.security import RoleKeys, size_limit_section

if TYPE_CHECKING:
    import zenoh


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


# Opening a Zenoh session the way Sightline uses it, with its errors in words. Shell.  Shared memory is off because it
# hides the network, gossip because it finds strangers (who listens may be found by people, see `discovery.py`); a
# lease of 2 s tells of a silent link before a person wonders; a message over 1 MiB is refused before it is buffered.


LEASE_MS: Final = 2000
KEEP_ALIVES_PER_LEASE: Final = 50
"""One 40 ms after the last message. TCP learns from what follows that a packet was lost; of a last one that nothing
follows, a frame's end or a twist, it learns only by its timeout of 200 ms and more."""
MAX_MESSAGE_BYTES: Final = 1_048_576
HANDSHAKE_MS: Final = 3000
MAX_SESSIONS: Final = 64
"""At one who listens: a fleet of twenty robots, its visions, and the people who watch."""
_OVER_UDP: Final = ("udp", "quic")
_FLOOD_CHECK_S: Final = 0.5
_PROBE_TIMEOUT_S: Final = 0.3
RETRY: Final = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}


class _ClosedSession:
    """In place of a session that is closed; asked for anything, it raises ZError as that one would."""

    def __getattr__(self, name: str) -> Any:
        import zenoh

        raise zenoh.ZError("the session is closed")


CLOSED_SESSION: Final[Any] = _ClosedSession()
"""Who closes a session lets go of it at once. To free a router's stops every Python thread for up to 10 s where another
session of the process hears something meanwhile (eclipse-zenoh 1.10.2 waits for a task with the interpreter's lock in
hand), and if it is part of a cycle, the collector does that at any later time."""


def open_session(
    listen: Sequence[str], connect: Sequence[str], timeout_s: float, secured: RoleKeys | None = None
) -> zenoh.Session:
    """Open a session on checked endpoints; with `secured`, by mutual TLS, and whoever listens checks who may what.

    Raises ConfigError if Zenoh is not installed or an endpoint does not fit `secured`, LinkError if an endpoint cannot
    be listened on, or if there is only `connect` and nobody answers there within `timeout_s`.
    """
    if secured is not None:
        secured.check((*listen, *connect))
    elif keyless := next((one for one in (*listen, *connect) if one.startswith(("tls/", "quic/"))), ""):
        raise LinkError(f"refused at {keyless}: a {keyless.partition('/')[0]}/ endpoint needs keys; give --secure DIR")
    try:
        import zenoh
    except ImportError:
        raise ConfigError("Zenoh is not installed: pip install 'sightline-robot[zenoh]'") from None
    zenoh.init_log_from_env_or("off")  # RUST_LOG, see docs/how-to/secure-the-link.md
    logging.getLogger("zenoh").addHandler(logging.NullHandler())  # else Python prints its warnings to the terminal
    try:
        return _open(session_config(listen, connect, timeout_s, secured))
    except zenoh.ZError as error:
        raise _error_of(str(error), listen, connect, timeout_s, secured) from None


def _open(config: dict[str, Any]) -> zenoh.Session:
    """Open it; where multicast is what fails, without it."""
    import zenoh

    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        if config["scouting"]["multicast"] == MULTICAST_OFF:
            raise
    config["scouting"]["multicast"] = MULTICAST_OFF
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def session_config(
    listen: Sequence[str], connect: Sequence[str], timeout_s: float, secured: RoleKeys | None = None
) -> dict[str, Any]:
    """The Zenoh configuration. Who listens is a router and reaches `connect` in the background, else a client."""
    config = _session_config(listen, connect, timeout_s)
    if secured is not None:
        config["transport"]["link"]["tls"] = secured.tls_section()
        if listen:  # a client has one peer, whoever listens, and that one judges
            config["access_control"] = secured.access_section()
            config["low_pass_filter"] = size_limit_section()
    return config


def _session_config(listen: Sequence[str], connect: Sequence[str], timeout_s: float) -> dict[str, Any]:
    return {
        "mode": "router" if listen else "client",
        "listen": {"endpoints": [with_send_buffer(endpoint) for endpoint in listen], "exit_on_failure": True},
        "connect": {
            "endpoints": [with_send_buffer(endpoint) for endpoint in connect],
            "timeout_ms": -1 if listen else int(timeout_s * 1000),
            "exit_on_failure": not listen,
            "retry": RETRY,
        },
        "scouting": {"multicast": multicast_section(listen), "gossip": {"enabled": False}, "delay": 0},
        "open": {"return_conditions": {"connect_scouted": False}},
        "timestamping": {"enabled": False},
        "transport": _transport_config(),
    }


def _transport_config() -> dict[str, Any]:
    return {
        "unicast": {"max_sessions": MAX_SESSIONS, "open_timeout": HANDSHAKE_MS, "accept_timeout": HANDSHAKE_MS},
        "link": {
            "tx": {
                "lease": LEASE_MS,
                "keep_alive": KEEP_ALIVES_PER_LEASE,
                # A queue of one batch: what is behind a full link is dropped here, not sent late.
                "queue": {"size": {"data_low": 1, "real_time": 1}},
            },
            "rx": {"max_message_size": MAX_MESSAGE_BYTES},
        },
        "shared_memory": {"enabled": False},
    }


def _error_of(
    text: str, listen: Sequence[str], connect: Sequence[str], timeout_s: float, secured: RoleKeys | None
) -> SightlineError:
    """Zenoh's error as one line that names the endpoint and the fix; its source paths are left out."""
    if not listen:
        where = " or ".join(connect)
        trouble = next((found for endpoint in connect if (found := diagnose_tls(endpoint, secured))), "")
        if trouble:
            return LinkError(f"refused at {where}: {trouble}")
        more = ""
        if "quic/" in where:
            more = ", or one end rejects the other's keys: start the robot with RUST_LOG=zenoh_link_commons=warn"
        more += ", and what listens there does not speak Zenoh" if any(map(_is_open, connect)) else ""
        return LinkError(f"nobody answers at {where}; is the robot or router running? tried for {timeout_s:g} s{more}")
    where = next((endpoint for endpoint in listen if endpoint.partition("#")[0] in text), " or ".join(listen))
    if "in use" in text:
        return _port_in_use(where)
    cause = re.split(r" at /|\(os error", text.rpartition("[")[2])[0].rpartition(": ")[2].strip(" .]")
    return LinkError(f"cannot listen on {where}: {cause}; use an address of this machine, e.g. tcp/127.0.0.1:7447")


def _is_open(endpoint: str) -> bool:
    transport, host, port = parse_zenoh_endpoint(endpoint)
    try:
        if transport not in _OVER_UDP:
            socket.create_connection((host, port), _PROBE_TIMEOUT_S).close()
    except OSError:
        return False
    return transport not in _OVER_UDP


def _port_in_use(endpoint: str) -> LinkError:
    port = parse_zenoh_endpoint(endpoint)[2]
    owner = port_owner(port)
    by = f" by {owner}" if owner else " by another process"
    return LinkError(f"cannot listen on {endpoint}: port {port} is in use{by}; end it or choose another port")


@contextmanager
def report_floods(listen: Sequence[str], report: Callable[[str], None]) -> Iterator[None]:
    """While inside, `report` each host that has more connections to `listen` than Zenoh accepts from all together."""
    ports = {parse_zenoh_endpoint(endpoint)[2] for endpoint in listen if "://" not in endpoint}
    ending = threading.Event()
    if ports:
        arguments = (ports, report, ending)
        threading.Thread(target=_watch_floods, args=arguments, name="zenoh-floods", daemon=True).start()
    try:
        yield
    finally:
        ending.set()


def _watch_floods(ports: set[int], report: Callable[[str], None], ending: threading.Event) -> None:
    limiter = RepeatLimiter()
    while not ending.wait(_FLOOD_CHECK_S):
        for host, count in connections(ports).most_common(1):
            if count > MAX_SESSIONS and limiter.due(host, monotonic_us()):
                report(f"{count} connections from {host}, more than the {MAX_SESSIONS} accepted from all; "
                       "block that address or end the program there")
