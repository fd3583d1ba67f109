"""What the doctor finds between this machine and a robot or router. Shell (sockets, a link)."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Iterator
from statistics import median, quantiles

from operator_side.acknowledge import Viewer
from operator_side.doctor.finding import Finding, histogram
from operator_side.requests import Operator
from protocol.channels import FRAME
from protocol.errors import SightlineError
from protocol.messages import Status
from protocol.transports import endpoints, websocket_endpoints
from protocol.transports.link import Link
from protocol.transports.opening import open_link

ROLE = "doctor"
_KNOCKS = 40
_PATIENCE_S = 2.0
_LOOK_S = 3.0
_QUICK_MS = 60.0
"""A round trip above this takes speed from a robot: its full limit ends at 150 ms of frame age."""
_UNREACHED = {
    errno.ECONNREFUSED: "the machine is there, nobody listens on the port: start `sightline robot` there with --listen",
    errno.EHOSTUNREACH: "no way there: another network, or the access point keeps its clients apart (client isolation)",
    errno.ENETUNREACH: "no way there: this machine is on no such network",
}


def findings(endpoint: str, robot: str, secure: str) -> Iterator[Finding]:
    """Everything about the way to `endpoint` and, if it is a robot's, its stream."""
    host, port = _address(endpoint)
    knocks_ms, trouble = _knock(host, port)
    if trouble:
        yield Finding("reach", False, f"{host}:{port} does not answer", trouble)
        return
    yield from _round_trip(knocks_ms)
    try:
        with open_link(robot, connect=[endpoint], role=ROLE, secure=secure) as link:
            yield from _robot(link, robot)
    except SightlineError as error:
        yield Finding("link", False, str(error))


def _address(endpoint: str) -> tuple[str, int]:
    """Host and port. Raises ConfigError for an endpoint that is none."""
    if "://" in endpoint:
        web = websocket_endpoints.parse_endpoint(endpoint)
        return web.host, web.port
    return endpoints.check_endpoint(endpoint)[1:]


def _knock(host: str, port: int) -> tuple[list[float], str]:
    """Times of TCP handshakes, one round trip each, in ms; or why there is none."""
    times_ms: list[float] = []
    for _ in range(_KNOCKS):
        begun_ns = time.monotonic_ns()
        try:
            socket.create_connection((host, port), _PATIENCE_S).close()
        except TimeoutError:
            return times_ms, "nothing comes back: firewall, wrong address, or client isolation on the access point"
        except socket.gaierror:
            return times_ms, f"no machine is called {host!r}: check the name, or use its address"
        except OSError as error:
            return times_ms, _UNREACHED.get(error.errno or 0, error.strerror or "unknown")
        times_ms.append((time.monotonic_ns() - begun_ns) / 1e6)
        time.sleep(0.01)
    return times_ms, ""


def _round_trip(knocks_ms: list[float]) -> Iterator[Finding]:
    p50, p95 = median(knocks_ms), quantiles(knocks_ms, n=20)[-1]
    fix = "a nearer access point, 5 GHz, Wi-Fi power save off on both ends"
    yield Finding("round trip p50", p50 <= _QUICK_MS, f"{p50:.2f}", fix, "ms", f"{_QUICK_MS:.0f}")
    yield Finding("round trip p95", p95 <= 2 * _QUICK_MS, f"{p95:.2f}", fix, "ms", f"{2 * _QUICK_MS:.0f}")
    lines = "".join(f"\n{'':25}{line}" for line in histogram(knocks_ms))
    yield Finding("jitter", None, f"{max(knocks_ms) - min(knocks_ms):.2f} ms over {len(knocks_ms)} handshakes{lines}")


def _robot(link: Link, robot: str) -> Iterator[Finding]:
    status = Operator(link).wait_report().status
    yield Finding("robot", None, f"{robot} is {status.state}: {status.reason}")
    yield from _refusals(status)
    fps, kilobytes = _watch(link)
    asked = status.stream.fps
    enough = fps >= 0.8 * asked if asked else fps > 0
    fix = "smaller pictures or a lower rate: camera.options.width_px, stream.max_fps in the robot's configuration"
    rate = f"{fps:.1f} per second, {kilobytes:.0f} kB each, {fps * kilobytes / 125:.2f} Mbit/s"
    yield Finding("frames", enough, rate, fix)


def _refusals(status: Status) -> Iterator[Finding]:
    for reason, count in sorted(status.refused.items(), key=lambda row: -row[1])[:3]:
        yield Finding(f"refused {reason}", None, f"{count} times since its start")


def _watch(link: Link) -> tuple[float, float]:
    """Frames per second and kB a frame over a few seconds; each is acknowledged, as any viewer does."""
    slot, viewer, begun_s = link.latest(FRAME), Viewer(link, ROLE), time.monotonic()
    sizes: list[int] = []
    while time.monotonic() - begun_s < _LOOK_S:
        message = slot.take(0.2)
        if message is None:
            continue
        sizes.append(len(message.payload))
        viewer.acknowledge(message)
    return len(sizes) / _LOOK_S, sum(sizes) / len(sizes) / 1000 if sizes else 0.0
