"""The counters of a detector service as Prometheus metrics. Shell (HTTP)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sightline.operator_side.cockpit.metrics import counter, gauge, serving
from sightline.operator_side.cockpit.vision_metrics import listening_address
from sightline.vision_side.serving.detector_service import DetectorService

if TYPE_CHECKING:
    from sightline.operator_side.cockpit.metrics import Family


class DetectorMetrics:
    """Collects the counters of a detector service, and answers its probes."""

    def __init__(self) -> None:
        self._service: DetectorService | None = None

    def look_at(self, service: DetectorService) -> None:
        """Use `service` as the source."""
        self._service = service

    def is_live(self) -> bool:
        """Return True while the loop runs and the detector ends each batch, and before the service begins."""
        return self._service is None or self._service.is_live()

    def is_ready(self) -> bool:
        """Return True while frames would be answered, with or without a robot."""
        return self._service is not None and self._service.is_ready()

    def collect(self) -> Iterator[Family]:
        """Yield the current metrics."""
        if self._service is None:
            return
        now = self._service.health()
        yield gauge("detector_robots", "robots whose frames this service examines", {(): now.robots})
        yield gauge("detector_services", "services that share the robots, this one included", {(): now.services})
        yield gauge("detector_busy_ratio", "share of the last seconds in which the detector was busy",
                    {(): now.busy_ratio})
        yield gauge("detector_queue_age_seconds", "age of frames when their turn came, 95th percentile",
                    {(): now.queue_p95_us / 1e6})
        yield gauge("detector_answer_age_seconds", "age of frames when their boxes were sent, 95th percentile",
                    {(): now.answer_p95_us / 1e6})
        counters = now.counters
        yield counter("detector_frames_answered", "frames answered", {(): counters.served})
        dropped = {"overtaken": counters.overtaken, "stale": counters.stale, "late": counters.late,
                   "rejected": counters.rejected}
        yield counter("detector_frames_dropped", "frames without an answer",
                      {(reason,): float(count) for reason, count in dropped.items()}, "reason")


@contextmanager
def served(where: str) -> Iterator[Callable[[DetectorService], None]]:
    """Serve at `[HOST:]PORT` in this context. Yields the function that receives the service.

    Raises:
        ConfigError: the address is invalid.
        LinkError: the port is in use.
    """
    metrics = DetectorMetrics()
    with serving(metrics, *listening_address(where)):
        yield metrics.look_at
