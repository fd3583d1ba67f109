"""The counters of a vision service as Prometheus metrics. Shell (HTTP)."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from sightline.operator_side.cockpit.metrics import counter, gauge, serving
from sightline.protocol.errors import ConfigError
from sightline.vision_side.serving.service import Observe, ServiceCounts, ServingState

if TYPE_CHECKING:
    from sightline.operator_side.cockpit.metrics import Family

_WHERE: Final = re.compile(r"(?:(\[[^\s\]]+\]|[^\s:\[\]]+):)?([0-9]{1,5})")
_LOOPBACK: Final = "127.0.0.1"


class VisionMetrics:
    """Collects the counters of a vision service, and answers its probes."""

    def __init__(self) -> None:
        self._state: ServingState | None = None
        self._busy: tuple[float, dict[str, int]] = (0.0, {})
        """Time of the newest scrape, and the busy time of each robot's service at that time."""

    def look_at(self, state: ServingState) -> None:
        """Use `state` as the source."""
        self._busy = time.monotonic(), {}
        self._state = state

    def is_live(self) -> bool:
        """Return True while the loop turns, and before it begins."""
        return self._state is None or self._state.is_live

    def is_ready(self) -> bool:
        """Return True while new robots are served, with or without a robot."""
        return self._state is not None and self._state.is_ready

    def collect(self) -> Iterator[Family]:
        """Yield the current metrics of each robot."""
        rows = self._state.counts() if self._state else []

        def each(value: Callable[[ServiceCounts], float]) -> dict[tuple[str, ...], float]:
            return {(one.robot,): value(one) for one in rows}

        yield gauge("vision_robots", "robots that it drives", {(): sum(one.drives for one in rows)})
        yield gauge("vision_busy_ratio", "share of the time since the scrape before in which it answered frames; of "
                    "several threads that of the busiest", {(): self._busy_ratio(rows)})
        yield gauge("vision_hears", "whether frames arrive", each(lambda one: float(one.receives)), "robot")
        yield gauge("vision_drives", "whether it drives the robot; 0 while it stands by", each(lambda one: one.drives),
                    "robot")
        yield counter("vision_frames_received", "frames that came, also those without an answer",
                      each(lambda one: one.received), "robot")
        yield counter("vision_frames_answered", "frames answered", each(lambda one: one.answered), "robot")
        yield counter("vision_twists", "frames answered by a twist", each(lambda one: one.steered), "robot")
        yield counter("vision_frames_overtaken", "frames that a newer one replaced before their detection",
                      each(lambda one: one.overtaken), "robot")
        yield counter("vision_restarts", "services of this robot that failed and were started again",
                      each(lambda one: one.restarts), "robot")
        skipped: dict[tuple[str, ...], float] = {
            (one.robot, reason): count for one in rows for reason, count in one.skipped.items()
        }
        yield counter("vision_frames_skipped", "frames without a detection", skipped, "robot", "reason")
        yield gauge("vision_compute_seconds", "frame to answer, the newest", each(lambda one: one.compute_us / 1e6),
                    "robot")
        ages: dict[tuple[str, ...], float] = {
            (one.robot,): one.queue_p95_us / 1e6 for one in rows if one.queue_p95_us is not None
        }
        yield gauge("vision_queue_age_seconds", "age of frames when their turn came, 95th percentile", ages, "robot")
        known: dict[tuple[str, ...], float] = {
            (one.robot,): one.latency_us / 1e6 for one in rows if one.latency_us is not None
        }
        yield gauge("vision_latency_seconds", "capture to accepted command, as the robot measured it", known, "robot")

    def _busy_ratio(self, rows: list[ServiceCounts]) -> float:
        now_s, (before_s, before) = time.monotonic(), self._busy
        self._busy = now_s, {one.robot: one.busy_us for one in rows}
        threads: Counter[int] = Counter()
        for one in rows:
            earlier_us = before.get(one.robot, 0)
            # The counters of a restarted service begin at 0.
            threads[one.thread] += one.busy_us - (earlier_us if earlier_us <= one.busy_us else 0)
        return min(1.0, max(threads.values(), default=0) / 1e6 / max(1e-6, now_s - before_s))


@contextmanager
def served(where: str) -> Iterator[Observe]:
    """Serve at `[HOST:]PORT` in this context. Yields the function that receives the source of the counters.

    Raises:
        ConfigError: the address is invalid.
        LinkError: the port is in use.
    """
    metrics = VisionMetrics()
    with serving(metrics, *listening_address(where)):
        yield metrics.look_at


def listening_address(where: str) -> tuple[str, int]:
    """Return host and port of `[HOST:]PORT`. Raises ConfigError for an invalid text."""
    match = _WHERE.fullmatch(where)
    if match is None or not 1 <= int(match[2]) <= 65_535:
        raise ConfigError(f"invalid --metrics '{where}': expected PORT or HOST:PORT, e.g. 9465 or 0.0.0.0:9465")
    return match[1] or _LOOPBACK, int(match[2])
