"""A robot's status as Prometheus metrics, and the probes of a supervisor. Shell (HTTP, a link).

`prometheus_client` writes the format, because the Prometheus project maintains it.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final, Protocol

from sightline.operator_side.client.requests import read_report
from sightline.operator_side.cockpit.http_server import HttpAnswer, Route, served
from sightline.protocol.channels import STATUS
from sightline.protocol.errors import WireError
from sightline.protocol.messages import State, Status, StreamStatus
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.security import ROBOT_ROLE
from sightline.protocol.transports.zenoh.presence import PeerInfo

if TYPE_CHECKING:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    Family = GaugeMetricFamily | CounterMetricFamily


class Exposed(Protocol):
    """A source of metrics."""

    def collect(self) -> Iterator[Family]:
        """Yield the current metrics."""
        ...

    def is_live(self) -> bool:
        """Return False if the process hangs and must be restarted."""
        ...

    def is_ready(self) -> bool:
        """Return True if the service works."""
        ...


def gauge(name: str, about: str, values: dict[tuple[str, ...], float], *labels: str) -> GaugeMetricFamily:
    """Create a gauge with a value for each combination of labels."""
    from prometheus_client.core import GaugeMetricFamily

    family = GaugeMetricFamily(f"sightline_{name}", about, labels=labels)
    for of, value in values.items():
        family.add_metric(list(of), value)
    return family


def counter(name: str, about: str, values: dict[tuple[str, ...], float], *labels: str) -> CounterMetricFamily:
    """Create a counter with a value for each combination of labels."""
    from prometheus_client.core import CounterMetricFamily

    family = CounterMetricFamily(f"sightline_{name}", about, labels=labels)
    for of, value in values.items():
        family.add_metric(list(of), value)
    return family


@contextmanager
def serving(exposed: Exposed, host: str, port: int) -> Iterator[str]:
    """Serve `/metrics`, `/live` and `/ready` in this context. Yields the address.

    `/health` is the former name of `/ready`. Raises LinkError for a port in use.
    """
    from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest

    registry = CollectorRegistry()
    registry.register(exposed)

    def probe(is_true: Callable[[], bool], otherwise: bytes) -> Route:
        return lambda _request, _body: (
            HttpAnswer(b"ok\n", "text/plain") if is_true() else HttpAnswer(otherwise, "text/plain", 503)
        )

    ready = probe(exposed.is_ready, b"not ready\n")
    routes: dict[str, Route] = {
        "GET /metrics": lambda _request, _body: HttpAnswer(generate_latest(registry), CONTENT_TYPE_LATEST),
        "GET /live": probe(exposed.is_live, b"hangs\n"),
        "GET /ready": ready,
        "GET /health": ready,
    }
    with served(routes, port, host, names=()) as address:
        yield address


# --- a robot's status --------------------------------------------------------------------------------------------


FRESH_S: Final = 2.0
"""Time without a status after which a robot is down."""


_COUNTERS: Final = {
    "accepted": "commands_accepted",
    "refused": "commands_refused",
    "network_restarts": "network_restarts",
    "sent": "frames_sent",
    "credit_timeouts": "frames_unanswered",
    "dropped_commands": "commands_dropped",
    "missed_captures": "captures_missed",
    "overtaken": "frames_overtaken",
    "refused_pictures": "pictures_refused",
    "dropped": "messages_dropped",
    "faults": "faults",
}
"""Fields of a status that never decrease -> names of their metrics. Every other number is a gauge with its own name."""
_LABELS: Final = {"refused": "reason", "dropped": "channel", "faults": "part"}
_GAUGES: Final = {"fps": "stream_fps", "window": "stream_window"}


class Watched:
    """Collects the newest status of one robot for Prometheus."""

    def __init__(self, link: Link) -> None:
        self._robot = link.robot
        self._newest: tuple[Status, float] | None = None
        self._entered: Counter[str] = Counter()
        self._peers: Callable[[], list[PeerInfo]] = getattr(link, "peers", list)
        link.subscribe(STATUS, self._on_status)

    def _on_status(self, message: Message) -> None:
        try:
            status = read_report(message).status
        except WireError:
            return
        before = self._newest
        self._entered[status.state.value] += before is not None and before[0].state is not status.state
        self._newest = (status, time.monotonic())

    def fresh(self) -> Status | None:
        """Return the status, or None if it is too old."""
        newest = self._newest
        return newest[0] if newest is not None and time.monotonic() - newest[1] <= FRESH_S else None

    def is_live(self) -> bool:
        """Return True, because this process only waits."""
        return True

    def is_ready(self) -> bool:
        """Return True while the robot publishes its status."""
        return self.fresh() is not None

    def collect(self) -> Iterator[Family]:
        """Yield the current metrics; for a silent robot only `sightline_up`."""
        status = self.fresh()
        yield self._gauge("up", "whether the robot publishes its status", float(status is not None))
        if status is not None:
            yield from self._of(status)
            yield from self._round_trip()

    def _of(self, status: Status) -> Iterator[Family]:
        yield gauge("state", "1 for the state it is in",
                    {(self._robot, one.value): float(one is status.state) for one in State}, "robot", "state")
        yield self._gauge("linear_mps", "forward speed applied", status.applied[0])
        yield self._gauge("angular_rad_s", "turning speed applied, left positive", status.applied[1])
        yield from self._fields(status)
        yield self._counter("holds", "transitions to HOLD, observed at ten statuses per second",
                            {(): self._entered[State.HOLD.value]})

    def _fields(self, part: Status | StreamStatus) -> Iterator[Family]:
        """Yield every number in `part` with the description of its field. Times are in seconds."""
        for field, info in type(part).model_fields.items():
            value, about = getattr(part, field), info.description or ""
            if isinstance(value, StreamStatus):
                yield from self._fields(value)
            elif isinstance(value, dict):
                yield self._counter(_COUNTERS[field], about, {(key,): count for key, count in value.items()},
                                    _LABELS[field])
            elif field in _COUNTERS:
                yield self._counter(_COUNTERS[field], about, {(): value})
            elif field.endswith("_us") and value is not None:
                yield self._gauge(field.removesuffix("_us") + "_seconds", about, value / 1e6)
            elif isinstance(value, int | float):
                yield self._gauge(_GAUGES.get(field, field), about, float(value))

    def _round_trip(self) -> Iterator[Family]:
        """Query the robot's network process at each collection. Yields nothing on a link without queries."""
        for peer in self._peers():
            if peer.presence.role == ROBOT_ROLE and peer.presence.robot == self._robot:
                yield self._gauge("round_trip_seconds", "there and back on the link", peer.round_trip_us / 1e6)
                return

    def _gauge(self, name: str, about: str, value: float) -> Family:
        return gauge(name, about, {(self._robot,): value}, "robot")

    def _counter(self, name: str, about: str, counts: Mapping[tuple[str, ...], int], *labels: str) -> Family:
        values = {(self._robot, *of): float(count) for of, count in counts.items()}
        return counter(name, about, values, "robot", *labels)
