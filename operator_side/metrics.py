"""A robot's status for Prometheus, and a health endpoint. Shell (an HTTP server, a link).

`prometheus_client` writes the format: it is the one that Prometheus itself maintains.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from operator_side.requests import read_report
from protocol.channels import STATUS
from protocol.errors import LinkError, WireError
from protocol.messages import State, Status
from protocol.transports.link import Link, Message

if TYPE_CHECKING:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

FRESH_S = 2.0
"""A robot that was not heard for longer is down."""
Respond = Callable[[str, list[tuple[str, str]]], Any]


class Watched:
    """The newest status of one robot, and when it came. A Prometheus collector."""

    def __init__(self, link: Link) -> None:
        self._robot = link.robot
        self._newest: tuple[Status, float] | None = None
        link.subscribe(STATUS, self._on_status)

    def _on_status(self, message: Message) -> None:
        try:
            self._newest = (read_report(message).status, time.monotonic())
        except WireError:
            return

    def fresh(self) -> Status | None:
        """The status, unless it is too old."""
        newest = self._newest
        return newest[0] if newest is not None and time.monotonic() - newest[1] <= FRESH_S else None

    def collect(self) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        """All that is known now; only `sightline_up` of a robot that is not heard."""
        status = self.fresh()
        yield self._gauge("up", "whether the robot is heard", float(status is not None))
        if status is not None:
            yield from self._of(status)

    def _of(self, status: Status) -> Iterator[GaugeMetricFamily | CounterMetricFamily]:
        stream = status.stream
        yield self._labelled("state", "1 for the state it is in", {s.value: float(s is status.state) for s in State})
        yield self._gauge("linear_mps", "forward speed applied", status.applied[0])
        yield self._gauge("angular_rad_s", "turning speed applied, left positive", status.applied[1])
        yield from self._times(status)
        yield self._gauge("stream_fps", "frames sent in the last second", stream.fps)
        yield self._gauge("stream_window", "frames that may be in flight", stream.window)
        yield self._counter("frames_sent", "frames sent", stream.sent)
        yield self._counter("frames_unanswered", "frames whose answer never came", stream.credit_timeouts)
        yield self._counter("commands_accepted", "commands accepted", status.accepted)
        yield self._counter("commands_dropped", "commands the driver had no room for", stream.dropped_commands)
        yield self._counter("network_restarts", "restarts of the network process", status.network_restarts)
        yield self._refused(status.refused)

    def _times(self, status: Status) -> Iterator[GaugeMetricFamily]:
        for name, about, value_us in (
            ("frame_age_seconds", "age of the frame behind the applied command", status.frame_age_us),
            ("latency_seconds", "capture to command, as the robot measures it", status.latency_us),
            ("tick_late_max_seconds", "latest tick of the driver's loop", status.tick_late_max_us),
        ):
            if value_us is not None:
                yield self._gauge(name, about, value_us / 1e6)

    def _gauge(self, name: str, about: str, value: float) -> GaugeMetricFamily:
        from prometheus_client.core import GaugeMetricFamily

        family = GaugeMetricFamily(f"sightline_{name}", about, labels=["robot"])
        family.add_metric([self._robot], value)
        return family

    def _labelled(self, name: str, about: str, values: dict[str, float]) -> GaugeMetricFamily:
        from prometheus_client.core import GaugeMetricFamily

        family = GaugeMetricFamily(f"sightline_{name}", about, labels=["robot", name])
        for label, value in values.items():
            family.add_metric([self._robot, label], value)
        return family

    def _counter(self, name: str, about: str, value: float) -> CounterMetricFamily:
        from prometheus_client.core import CounterMetricFamily

        family = CounterMetricFamily(f"sightline_{name}", about, labels=["robot"])
        family.add_metric([self._robot], value)
        return family

    def _refused(self, refused: dict[str, int]) -> CounterMetricFamily:
        from prometheus_client.core import CounterMetricFamily

        family = CounterMetricFamily("sightline_commands_refused", "commands refused", labels=["robot", "reason"])
        for reason, count in refused.items():
            family.add_metric([self._robot, reason], count)
        return family


@contextmanager
def serving(watched: Watched, host: str, port: int) -> Iterator[int]:
    """Serve `/metrics` and `/health` while inside; gives the port. Raises LinkError for a port in use."""
    from prometheus_client import CollectorRegistry, make_wsgi_app

    registry = CollectorRegistry()
    registry.register(watched)
    metrics = make_wsgi_app(registry)

    def answer(environ: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        if environ["PATH_INFO"] == "/health":
            heard = watched.fresh() is not None
            respond("200 OK" if heard else "503 Service Unavailable", [("Content-Type", "text/plain")])
            return [b"heard\n" if heard else b"not heard\n"]
        body: Iterable[bytes] = metrics(environ, respond)
        return body

    server = _listening(host, port, answer)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield int(server.server_port)
    finally:
        server.shutdown()
        server.server_close()


class _Quiet(WSGIRequestHandler):
    """One line per change of state, never one per request."""

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing."""


def _listening(host: str, port: int, answer: Callable[..., Iterable[bytes]]) -> WSGIServer:
    from protocol.transports.port_owner import port_owner

    try:
        return make_server(host, port, answer, handler_class=_Quiet)
    except OSError as error:
        owner = port_owner(port)
        by = f" by {owner}" if owner else ""
        cause = f"port {port} is in use{by}; choose another with --port" if owner else error.strerror
        raise LinkError(f"cannot serve on {host}:{port}: {cause}") from None
