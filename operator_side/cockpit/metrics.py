"""`/metrics` in Prometheus' own words and `/health`, over plain HTTP. Shell (an HTTP server).

`prometheus_client` writes the format: it is the one that Prometheus itself maintains.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, Protocol
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from sightline.operator_side.cockpit.http_server import BoundedThreads
from sightline.protocol.errors import LinkError
from sightline.protocol.transports.diagnosis import port_owner

if TYPE_CHECKING:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    Family = GaugeMetricFamily | CounterMetricFamily

_IDLE_S: Final = 20
"""After that a connection that says nothing is let go of."""
Respond = Callable[[str, list[tuple[str, str]]], Any]


class Exposed(Protocol):
    """What is served."""

    def collect(self) -> Iterator[Family]:
        """All that is known now."""
        ...

    def is_heard(self) -> bool:
        """Whether all is well, for a health check."""
        ...


def gauge(name: str, about: str, values: dict[tuple[str, ...], float], *labels: str) -> GaugeMetricFamily:
    """A value that goes up and down, by what its labels say."""
    from prometheus_client.core import GaugeMetricFamily

    family = GaugeMetricFamily(f"sightline_{name}", about, labels=labels)
    for of, value in values.items():
        family.add_metric(list(of), value)
    return family


def counter(name: str, about: str, values: dict[tuple[str, ...], float], *labels: str) -> CounterMetricFamily:
    """A count that only goes up, by what its labels say."""
    from prometheus_client.core import CounterMetricFamily

    family = CounterMetricFamily(f"sightline_{name}", about, labels=labels)
    for of, value in values.items():
        family.add_metric(list(of), value)
    return family


@contextmanager
def serving(told: Exposed, host: str, port: int) -> Iterator[int]:
    """Serve `/metrics` and `/health` while inside; gives the port. Raises LinkError for a port in use."""
    from prometheus_client import CollectorRegistry, make_wsgi_app

    registry = CollectorRegistry()
    registry.register(told)
    metrics = make_wsgi_app(registry)

    def answer(environ: dict[str, Any], respond: Respond) -> Iterable[bytes]:
        if environ["PATH_INFO"] == "/health":
            heard = told.is_heard()
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


class _Server(BoundedThreads, WSGIServer):
    def handle_error(self, request: Any, client_address: Any) -> None:
        """Who goes away in the middle of it, or says nothing, is no error of ours."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Quiet(WSGIRequestHandler):
    """One line per change of state, never one per request."""

    timeout = _IDLE_S

    def log_message(self, format: str, *arguments: Any) -> None:
        """Say nothing."""


def _listening(host: str, port: int, answer: Callable[..., Iterable[bytes]]) -> WSGIServer:
    try:
        return make_server(host, port, answer, server_class=_Server, handler_class=_Quiet)
    except OSError as error:
        owner = port_owner(port)
        by = f" by {owner}" if owner else ""
        cause = f"port {port} is in use{by}; choose another" if owner else error.strerror
        raise LinkError(f"cannot serve on {host}:{port}: {cause}") from None
