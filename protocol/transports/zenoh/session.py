"""Open a Zenoh session with Sightline's settings, and convert its errors to `LinkError`. Shell.

An end that listens beyond loopback answers on Sightline's own multicast group and port. So other Zenoh programs on the
network do not find it. It never connects to a peer that it found. Explicit endpoints do not need multicast.
"""

from __future__ import annotations

import json
import logging
import re
import socket
import struct
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from sightline.protocol.errors import ConfigError, LinkError, SightlineError, install_command
from sightline.protocol.transports.diagnosis import (
    diagnose_tls,
    keys_problem,
    own_sockets,
    port_in_use,
    unresolved_host,
)
from sightline.protocol.transports.endpoints import (
    MULTICAST_PORT,
    OVER_UDP,
    parse_zenoh_endpoint,
    uses_discovery,
    with_send_buffer,
)
from sightline.protocol.transports.security import RoleKeys, check_keys, size_limit_section

if TYPE_CHECKING:
    import zenoh


# Multicast group of Zenoh, with Sightline's port.
MULTICAST_GROUP: Final = ("224.0.0.224", MULTICAST_PORT)
MULTICAST_OFF: Final = {"enabled": False}


def multicast_section(listen: Sequence[str]) -> dict[str, Any]:
    """Return Zenoh's `scouting/multicast`. It is enabled only if the owner listens beyond loopback."""
    if not uses_discovery(listen):
        return MULTICAST_OFF
    never: dict[str, list[str]] = {"router": [], "peer": [], "client": []}
    return {"enabled": True, "listen": True, "address": multicast_address(), "autoconnect": never}


def multicast_address() -> str:
    return f"{MULTICAST_GROUP[0]}:{MULTICAST_GROUP[1]}"


# The Zenoh session and its errors. Shell.
#
# Shared memory is off, because it hides the network. Gossip is off, because it finds third parties. A lease of 2 s
# detects a silent link early. A message above 1 MiB is rejected before it is buffered.


LEASE_MS: Final = 2000
# One keepalive follows 40 ms after the last message. TCP detects a lost packet by the packets after it. Without them,
# at the end of a frame or a twist, it needs its timeout of at least 200 ms.
KEEP_ALIVES_PER_LEASE: Final = 50
MAX_MESSAGE_BYTES: Final = 1_048_576
HANDSHAKE_MS: Final = 3000
# Handshake timeout of a client with several endpoints: three round trips of 260 ms. With TLS there are five.
HANDSHAKE_OF_SEVERAL_MS: Final = 800
# Limit of sessions at a listening end: a robot, or a vision service with twenty robots and their viewers.
MAX_SESSIONS: Final = 64
# Limit of sessions at a router.
MAX_ROUTER_SESSIONS: Final = 1000
_PROBE_TIMEOUT_S: Final = 0.3
# SO_LINGER of Zenoh for TCP and TLS. No other library in this process sets it.
_LINGERS_S: Final = 10
_LINGER: Final = struct.Struct("ii")
RETRY: Final = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}


def _keep(session: zenoh.Session) -> zenoh.Session:
    """Keep a listening session in memory forever. After its close it takes 16 KiB."""
    import ctypes

    # To free it, Zenoh (1.10.2) waits for a task with Python's global lock held. The thread of that task may run a
    # callback of another session, which needs the lock. Then all of Python blocks for 10 s.
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(session))
    return session


def open_session(
    listen: Sequence[str], connect: Sequence[str], timeout_s: float, secured: RoleKeys | None = None,
    max_sessions: int = MAX_SESSIONS,
) -> zenoh.Session:
    """Open a session.

    Args:
        listen: valid endpoints to listen on.
        connect: valid endpoints to connect to.
        timeout_s: longest wait for an answer, if there are only endpoints to connect to.
        secured: keys for mutual TLS, or None. The listening end then applies the access rules.
        max_sessions: security limit for the sessions of other ends with this one.

    Raises:
        ConfigError: Zenoh is missing, or an endpoint does not fit `secured`.
        LinkError: an endpoint cannot be opened, or no peer answers in time.
    """
    check_keys(secured, (*listen, *connect))
    try:
        import zenoh
    except ImportError:
        raise ConfigError(f"Zenoh is not installed: {install_command('zenoh')}") from None
    # RUST_LOG enables it, see docs/how-to/secure-the-link.md.
    zenoh.init_log_from_env_or("off")
    # Without a handler Python prints the warnings of Zenoh to the terminal.
    logging.getLogger("zenoh").addHandler(logging.NullHandler())
    until_s = time.monotonic() + timeout_s
    while True:
        try:
            opened = _open(session_config(listen, connect, timeout_s, secured, max_sessions))
            return _keep(opened) if listen else opened
        except zenoh.ZError as error:
            if not _tries_each_once(listen, connect) or time.monotonic() >= until_s:
                raise _error_of(str(error), listen, connect, timeout_s, secured) from None
        time.sleep(RETRY["period_init_ms"] / 1000)


def close_without_waiting() -> None:
    """Disable SO_LINGER on all connections of Zenoh. The system still sends the remaining data."""
    # With the 10 s of Zenoh, closing a link with unsent data whose other end hangs blocks a thread that receives for
    # all sessions of the process.
    for one in own_sockets():
        with suppress(OSError):  # the socket has no such option
            if one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.size) == _LINGER.pack(1, _LINGERS_S):
                one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER.pack(0, 0))


def _tries_each_once(listen: Sequence[str], connect: Sequence[str]) -> bool:
    # With a timeout, Zenoh spends all of it on the first endpoint, even if another one answers.
    return not listen and len(connect) > 1


def _open(config: dict[str, Any]) -> zenoh.Session:
    """Open the session. If multicast fails, open it without multicast."""
    import zenoh

    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except zenoh.ZError:
        if config["scouting"]["multicast"] == MULTICAST_OFF:
            raise
    config["scouting"]["multicast"] = MULTICAST_OFF
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def session_config(
    listen: Sequence[str], connect: Sequence[str], timeout_s: float, secured: RoleKeys | None = None,
    max_sessions: int = MAX_SESSIONS,
) -> dict[str, Any]:
    """Return the Zenoh configuration. A listening end is a router, other ends are clients."""
    config = _session_config(listen, connect, timeout_s, max_sessions)
    if secured is not None:
        config["transport"]["link"]["tls"] = secured.tls_section()
        # A client needs no rules, because its only peer is a listening end, which applies them.
        if listen:
            config["access_control"] = secured.access_section()
            config["low_pass_filter"] = size_limit_section()
    return config


def _session_config(
    listen: Sequence[str], connect: Sequence[str], timeout_s: float, max_sessions: int
) -> dict[str, Any]:
    return {
        "mode": "router" if listen else "client",
        "listen": {"endpoints": [_for_zenoh(endpoint) for endpoint in listen], "exit_on_failure": True},
        "connect": {
            "endpoints": [_for_zenoh(endpoint) for endpoint in connect],
            "timeout_ms": -1 if listen else 0 if _tries_each_once(listen, connect) else int(timeout_s * 1000),
            "exit_on_failure": not listen,
            "retry": RETRY,
        },
        "scouting": {"multicast": multicast_section(listen), "gossip": {"enabled": False}, "delay": 0},
        "open": {"return_conditions": {"connect_scouted": False}},
        "timestamping": {"enabled": False},
        "transport": _transport_config(max_sessions, _handshake_ms(listen, connect)),
    }


def _for_zenoh(endpoint: str) -> str:
    """Return the endpoint with its send buffer, and with an interface number, because Zenoh accepts no name."""
    address, _, rest = endpoint.partition("%")
    name, bracket, port = rest.partition("]")
    if bracket and not name.isdigit():
        try:
            endpoint = f"{address}%{socket.if_nametoindex(name)}{bracket}{port}"
        except OSError:
            raise ConfigError(f"{endpoint}: no interface '{name}' on this machine; `ip link` lists them") from None
    return with_send_buffer(endpoint)


def _handshake_ms(listen: Sequence[str], connect: Sequence[str]) -> int:
    """Return the handshake timeout. A router that hangs must not prevent a client from trying the next one."""
    has_keys = any(endpoint.startswith(("tls/", "quic/")) for endpoint in connect)
    return HANDSHAKE_OF_SEVERAL_MS if _tries_each_once(listen, connect) and not has_keys else HANDSHAKE_MS


def _transport_config(max_sessions: int, open_ms: int) -> dict[str, Any]:
    return {
        "unicast": {"max_sessions": max_sessions, "open_timeout": open_ms, "accept_timeout": HANDSHAKE_MS},
        "link": {
            "tx": {
                "lease": LEASE_MS,
                "keep_alive": KEEP_ALIVES_PER_LEASE,
                # A queue of one batch, so that data for a full link is dropped here, not sent late.
                "queue": {"size": {"data_low": 1, "real_time": 1}},
            },
            "rx": {"max_message_size": MAX_MESSAGE_BYTES},
        },
        "shared_memory": {"enabled": False},
    }


def _error_of(
    text: str, listen: Sequence[str], connect: Sequence[str], timeout_s: float, secured: RoleKeys | None
) -> SightlineError:
    """Convert Zenoh's error to one line with the endpoint and the fix, without its source paths."""
    if not listen:
        where = " or ".join(connect)
        trouble = next((found for endpoint in connect if (found := diagnose_tls(endpoint, secured))), "")
        if trouble:
            return LinkError(f"cannot connect to {where}: {trouble}")
        if host := unresolved_host(parse_zenoh_endpoint(endpoint)[1] for endpoint in connect):
            return LinkError(f"host '{host}' in {where} does not resolve; check the name or use an IP address")
        more = ""
        if "quic/" in where:
            more = ", or one end rejects the other's keys: start the robot with RUST_LOG=zenoh_link_commons=warn"
        if any(map(_is_open, connect)):
            more += (f". Something listens there, but it is not Zenoh, or has its limit of {MAX_SESSIONS} sessions "
                     f"({MAX_ROUTER_SESSIONS} at a router)")
        return LinkError(
            f"no answer from {where} after {timeout_s:g} s; start the robot or router, or check the address{more}"
        )
    where = next((endpoint for endpoint in listen if endpoint.partition("#")[0] in text), " or ".join(listen))
    if "in use" in text:
        return port_in_use(where, parse_zenoh_endpoint(where)[2])
    if secured is not None and (problem := keys_problem(secured)):
        return LinkError(f"cannot listen on {where}: {problem}")
    cause = re.split(r" at /|\(os error", text.rpartition("[")[2])[0].rpartition(": ")[2].strip(" .]")
    return LinkError(f"cannot listen on {where}: {cause}; use an address of this machine, e.g. tcp/127.0.0.1:7447")


def _is_open(endpoint: str) -> bool:
    transport, host, port = parse_zenoh_endpoint(endpoint)
    try:
        if transport not in OVER_UDP:
            socket.create_connection((host, port), _PROBE_TIMEOUT_S).close()
    except OSError:
        return False
    return transport not in OVER_UDP
