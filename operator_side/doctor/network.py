"""Finds problems between this machine and a robot or router. Shell (sockets, a link)."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median, quantiles

from sightline.operator_side.client.pictures import FrameViewer, viewer_role
from sightline.operator_side.client.requests import Operator
from sightline.operator_side.client.status import encoding_text, stream_is_whole
from sightline.operator_side.doctor.finding import Finding, histogram, trouble
from sightline.protocol.channels import FRAME
from sightline.protocol.errors import SightlineError
from sightline.protocol.messages import Status
from sightline.protocol.transports import endpoints
from sightline.protocol.transports.link import Link
from sightline.protocol.transports.open import open_link
from sightline.protocol.transports.security import ROBOT_ROLE
from sightline.protocol.transports.zenoh.discovery import find_listeners
from sightline.protocol.transports.zenoh.presence import QUERY_ROUNDS, PeerInfo, best_round_trips, software_version

ROLE = "doctor"
ARP_TABLE = Path("/proc/net/arp")
_ARP_COMPLETE = 0x2
_SCOUT_S = 0.5
_PROBES = 40
_PATIENCE_S = 2.0
_LISTEN_S = 3.0
_QUICK_MS = 60.0
"""A longer round trip reduces the speed of a robot: full speed ends at 150 ms of frame age."""
_UNREACHED = {
    errno.ECONNREFUSED: "the machine answers, but the port is closed: start `sightline robot` there with --listen",
    errno.EHOSTUNREACH: "no route: another network, or the access point isolates its clients (client isolation)",
    errno.ENETUNREACH: "no route: this machine has no connection to that network",
}


def findings(endpoint: str, robot: str, secure: str) -> Iterator[Finding]:
    """Yield the findings about the link to `endpoint`, and about the stream of the robot there."""
    transport, host, port = _address(endpoint)
    if transport not in endpoints.OVER_UDP:
        knocks_ms, why = _probe(host, port)
        if why:
            yield Finding("reach", False, f"{host}:{port} does not answer", why)
            return
        yield from _round_trip(knocks_ms, "handshakes")
    if not host.startswith(endpoints.LOOPBACK):
        yield _found_by_multicast(host)
    try:
        role = viewer_role(secure) if secure else ROLE  # with an operator's keys it may acknowledge frames
        with open_link(robot, connect=[endpoint], role=role, secure=secure) as link:
            if transport in endpoints.OVER_UDP:
                yield from _round_trip(_answer_ms(link), "queries")
            yield from _peers(link, robot)
            yield from _robot(link, robot, FrameViewer(link, role, secure))
    except SightlineError as error:
        yield _no_link(error, endpoint)


def _no_link(error: SightlineError, endpoint: str) -> Finding:
    """Return the finding for a link that did not open. The handshake worked, so another program may listen there."""
    found = trouble("link", error)
    if not found.value.startswith("no answer from"):
        return found
    transport, _, port = _address(endpoint)
    scheme, is_web, _ = endpoint.partition("://")
    there = f"{scheme}{is_web}" if is_web else f"{transport}/"
    fix = f"there: sightline robot --listen {there}0.0.0.0:{port}"
    if transport not in endpoints.OVER_UDP:
        fix += "; what listens on the port now is something else"
    return Finding("link", False, found.value, fix)


def _found_by_multicast(host: str) -> Finding:
    """Report if discovery finds the machine. Discovery is optional, so this never fails."""
    try:
        there = socket.gethostbyname(host) in {
            endpoints.parse_zenoh_endpoint(one)[1] for one in find_listeners(_SCOUT_S)
        }
    except OSError:
        there = False
    words = "it answers: `sightline robots` finds it" if there else "no answer, as on many networks"
    return Finding("multicast there", None, words, "" if there else "none needed: give the endpoint with --connect")


def _answer_ms(link: Link) -> list[float]:
    """Measure round trips by queries on the link, for transports without a TCP handshake."""
    rounds = [_peers_of(link) for _ in range(_PROBES)]
    return [min(one.round_trip_us for one in peers) / 1000 for peers in rounds if peers]


def _peers_of(link: Link) -> list[PeerInfo]:
    """Return the peers on `link`; empty on a link without queries."""
    query: Callable[[], list[PeerInfo]] = getattr(link, "peers", list)
    return query()


def _peers(link: Link, robot: str) -> Iterator[Finding]:
    """Yield the versions of both ends and the difference of their clocks. A WebSocket does not report them."""
    ours = software_version()
    for peer in best_round_trips([_peers_of(link) for _ in range(QUERY_ROUNDS)]):
        presence = peer.presence
        if presence.role == ROBOT_ROLE and presence.robot != robot:
            continue
        same = True if presence.software == ours else None
        fix = f"install the same version on both machines; this one has {ours}"
        yield Finding(f"version of {presence.role}", same, f"{presence.software} on {presence.host}", fix)
        if presence.role == ROBOT_ROLE:
            ahead_ms = peer.ahead_us / 1000
            yield Finding("clock skew", None, f"the robot's clock is {abs(ahead_ms):.0f} ms "
                          f"{'ahead' if ahead_ms > 0 else 'behind'}; only certificates and logs need it, no frame or "
                          "command does")


def _address(endpoint: str) -> tuple[str, str, int]:
    """Return transport, host and port. Raises ConfigError for an invalid endpoint."""
    if "://" in endpoint:
        web = endpoints.parse_websocket_endpoint(endpoint)
        return "ws", web.host, web.port
    return endpoints.parse_zenoh_endpoint(endpoint)


def _probe(host: str, port: int) -> tuple[list[float], str]:
    """Measure TCP handshakes, one round trip each, in ms. Also return the reason if one fails."""
    times_ms: list[float] = []
    for _ in range(_PROBES):
        begun_ns = time.monotonic_ns()
        try:
            socket.create_connection((host, port), _PATIENCE_S).close()
        except TimeoutError:
            why = "no reply: firewall, wrong address, or client isolation on the access point"
            return times_ms, why + neighbor(host, port)
        except socket.gaierror:
            return times_ms, f"host '{host}' does not resolve: check the name or use its IP address"
        except OSError as error:
            why = _UNREACHED.get(error.errno or 0, error.strerror or "unknown")
            return times_ms, why + (neighbor(host, port) if error.errno == errno.EHOSTUNREACH else "")
        times_ms.append((time.monotonic_ns() - begun_ns) / 1e6)
        time.sleep(0.01)
    return times_ms, ""


def neighbor(host: str, port: int, table: Path = ARP_TABLE) -> str:
    """Return the kernel's information on a silent machine of the same network: whether it exists."""
    try:
        rows = [line.split() for line in table.read_text().splitlines()[1:]]
        address = socket.gethostbyname(host)
    except OSError:
        return ""
    flags = {row[0]: int(row[2], 16) for row in rows if len(row) > 3}
    if address not in flags:
        return ""
    if flags[address] & _ARP_COMPLETE:
        return f"; {address} is on this network, so a firewall blocks it: sudo ufw allow {port}/tcp on that machine"
    return (f"; no machine on this network has {address}: it is off, or the access point isolates its clients "
            "(switch off client isolation, or leave the guest network)")


def _round_trip(knocks_ms: list[float], what: str) -> Iterator[Finding]:
    if len(knocks_ms) < 2:
        yield Finding("round trip p50", None, "unknown: no peer answers queries here")
        return
    p50, p95 = median(knocks_ms), quantiles(knocks_ms, n=20)[-1]
    fix = "use a nearer access point, 5 GHz, and Wi-Fi power save off on both ends"
    yield Finding("round trip p50", p50 <= _QUICK_MS, f"{p50:.2f}", fix, "ms", f"{_QUICK_MS:.0f}")
    yield Finding("round trip p95", p95 <= 2 * _QUICK_MS, f"{p95:.2f}", fix, "ms", f"{2 * _QUICK_MS:.0f}")
    lines = "".join(f"\n{'':25}{line}" for line in histogram(knocks_ms))
    yield Finding("jitter", None, f"{max(knocks_ms) - min(knocks_ms):.2f} ms over {len(knocks_ms)} {what}{lines}")


def _robot(link: Link, robot: str, viewer: FrameViewer) -> Iterator[Finding]:
    status = Operator(link).wait_report().status
    yield Finding("robot", None, f"{robot} is {status.state}: {status.reason}")
    yield from _rejections(status)
    fps, kilobytes = _watch(link, viewer)
    wanted = status.stream.fps
    enough = fps >= 0.8 * wanted if wanted else fps > 0
    fix = "send smaller or fewer images from the robot: --set camera.options.width_px=320 --set stream.max_fps=15"
    rate = f"{fps:.1f} per second, {kilobytes:.0f} kB each, {fps * kilobytes / 125:.2f} Mbit/s"
    yield Finding("frames", enough, rate, fix)
    whole = stream_is_whole(status.stream)
    yield Finding("stream", whole, encoding_text(status.stream),
                  "use a nearer access point or 5 GHz, or a lower rate: --set stream.max_fps=15 on the robot")


def _rejections(status: Status) -> Iterator[Finding]:
    for reason, count in sorted(status.refused.items(), key=lambda row: -row[1])[:3]:
        yield Finding(f"rejected {reason}", None, f"{count} times since its start")


def _watch(link: Link, viewer: FrameViewer) -> tuple[float, float]:
    """Measure frames per second and kB per frame for a few seconds. It acknowledges each frame as a viewer."""
    slot, begun_s = link.latest(FRAME), time.monotonic()
    sizes: list[int] = []
    while time.monotonic() - begun_s < _LISTEN_S:
        message = slot.take(0.2)
        if message is None:
            continue
        sizes.append(len(message.payload))
        viewer.acknowledge(message)
    return len(sizes) / _LISTEN_S, sum(sizes) / len(sizes) / 1000 if sizes else 0.0
