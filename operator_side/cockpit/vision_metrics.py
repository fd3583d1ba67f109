"""The counters of a vision service as Prometheus metrics. Shell (HTTP)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from sightline.operator_side.cockpit.metrics import counter, gauge, serving
from sightline.protocol.errors import ConfigError
from sightline.vision_side.serving.service import CountsNow, Observe, ServiceCounts

if TYPE_CHECKING:
    from sightline.operator_side.cockpit.metrics import Family

_WHERE: Final = re.compile(r"(?:([^\s:]+):)?([0-9]{1,5})")
_LOOPBACK: Final = "127.0.0.1"


class VisionMetrics:
    """The counts of a vision service, as families of metrics. It is well while it hears a robot."""

    def __init__(self) -> None:
        self._now: CountsNow = list

    def look_at(self, now: CountsNow) -> None:
        """Take the counts from `now` from here on."""
        self._now = now

    def is_heard(self) -> bool:
        """Whether frames of any robot come."""
        return any(one.heard for one in self._now())

    def collect(self) -> Iterator[Family]:
        """All that is known now, by robot."""
        rows = self._now()

        def each(value: Callable[[ServiceCounts], float]) -> dict[tuple[str, ...], float]:
            return {(one.robot,): value(one) for one in rows}

        yield gauge("vision_hears", "whether frames come", each(lambda one: float(one.heard)), "robot")
        yield counter("vision_frames_answered", "frames answered", each(lambda one: one.answered), "robot")
        yield counter("vision_twists", "frames answered by a twist", each(lambda one: one.steered), "robot")
        yield counter("vision_frames_overtaken", "frames that a newer one replaced before they were looked at",
                      each(lambda one: one.overtaken), "robot")
        skipped: dict[tuple[str, ...], float] = {
            (one.robot, reason): count for one in rows for reason, count in one.skipped.items()
        }
        yield counter("vision_frames_skipped", "frames not looked at", skipped, "robot", "reason")
        yield gauge("vision_compute_seconds", "frame to answer, the newest", each(lambda one: one.compute_us / 1e6),
                    "robot")
        known: dict[tuple[str, ...], float] = {
            (one.robot,): one.latency_us / 1e6 for one in rows if one.latency_us is not None
        }
        yield gauge("vision_latency_seconds", "capture to accepted command, as the robot measured it", known, "robot")


@contextmanager
def served(where: str) -> Iterator[Observe]:
    """Serve at `[HOST:]PORT` while inside; give what it yields the way to the counts.

    Raises ConfigError for a place that is none, LinkError for a port in use.
    """
    match = _WHERE.fullmatch(where)
    if match is None or not 1 <= int(match[2]) <= 65_535:
        raise ConfigError(f"--metrics {where!r} is no place: write a port, or host:port; e.g. 9465 or 0.0.0.0:9465")
    told = VisionMetrics()
    with serving(told, match[1] or _LOOPBACK, int(match[2])):
        yield told.look_at
