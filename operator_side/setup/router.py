"""Runs a Zenoh router for the robots, vision services and operators of one site. Shell.

A stock `zenohd` also works, without the access rules of `--secure` and without the STOP port.
"""

import logging
import resource
import signal
import threading
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import Final

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import RepeatLimiter
from sightline.protocol.transports.endpoints import check_zenoh_endpoints, own_stop_addresses
from sightline.protocol.transports.flood_limits import limit_floods
from sightline.protocol.transports.security import ROUTER_ROLE, date_problem, load_role_keys
from sightline.protocol.transports.stop_port import StopProcess, read_packets, send_packet, stop_secret_file
from sightline.protocol.transports.zenoh.session import MAX_ROUTER_SESSIONS, close_without_waiting, open_session
from sightline.robot_side.guardian import stop_forwarder
from sightline.robot_side.guardian.stop_core import unpack_ignored

_log: Final = logging.getLogger(__name__)

_REACH_S = 5.0
_WATCHED_S = 1.0
_DESCRIPTORS: Final = 4 * MAX_ROUTER_SESSIONS
_PROBE: Final = bytes(256)
"""A packet that the forwarder ignores. `keep_alive` kills a forwarder that leaves five of them unread."""
_limiter: Final = RepeatLimiter()


def run(listen: Sequence[str], connect: Sequence[str], secure: str) -> int:
    """Serve until SIGTERM or SIGINT. Raises ConfigError and LinkError as `open_session` does."""
    web = next((endpoint for endpoint in (*listen, *connect) if "://" in endpoint), "")
    if web:
        raise ConfigError(f"a router takes no WebSocket endpoint ({web}); let the robot listen on ws://")
    check_zenoh_endpoints(listen, connect)
    stop_addresses = own_stop_addresses(listen)
    secured = load_role_keys(secure, ROUTER_ROLE)
    if problem := date_problem(secure, ROUTER_ROLE):
        _log.warning("router: %s", problem)
    _raise_descriptor_limit()
    ending = threading.Event()
    with (
        ExitStack() as closing_all,
        limit_floods(listen, lambda line: _log.info("router: %s", line)),
        closing(open_session(listen, connect, _REACH_S, secured, MAX_ROUTER_SESSIONS)),
    ):
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda _number, _frame: ending.set())
        rules = f"keys of {secure}, access rules on" if secure else "no keys, every client that reaches it may connect"
        forwarder = _stop_forwarder(stop_addresses, secure)
        if forwarder is not None:
            closing_all.callback(forwarder.close)
            forwarder.keep_alive(monotonic_us())
        _log.info("router: on %s; %s", ", ".join(listen), rules)
        while not ending.wait(_WATCHED_S):
            close_without_waiting()
            if forwarder is not None:
                _watch(forwarder)
    _log.info("router: ended")
    return 0


def _raise_descriptor_limit() -> None:
    """Raise the limit of descriptors to the number that the sessions need, as far as the system permits."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(_DESCRIPTORS, hard)
    if resource.RLIM_INFINITY != soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _stop_forwarder(addresses: Sequence[tuple[str, int]], secure: str) -> StopProcess | None:
    """Prepare the forwarder of STOP datagrams; None with keys but without a STOP secret."""
    try:
        return stop_forwarder.start(addresses, stop_secret_file(secure) if secure else "")
    except ConfigError as error:
        _log.warning("router: %s", error)
        return None


def _watch(forwarder: StopProcess) -> None:
    """Restart the forwarder after its end or if it hangs, and log its reports."""
    forwarder.keep_alive(monotonic_us())
    send_packet(forwarder.near, _PROBE)
    for packet in read_packets(forwarder.near):
        if packet.startswith(b"L"):
            _log.info("router: %s", packet[1:].decode())
        elif packet.startswith(b"C"):
            counts, address = unpack_ignored(packet)
            for reason, count in counts.items():
                if times := _limiter.due(reason, monotonic_us(), count):
                    _log.info("router: ignored %d STOP datagrams (%s), the last from %s", times, reason, address)
