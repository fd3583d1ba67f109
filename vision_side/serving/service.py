"""What a vision service has done for one robot so far, for whoever measures it. Pure."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Counts:
    """Counters only grow. Times are of the newest frame; None where nobody has said any."""

    robot: str
    heard: bool
    """Whether frames came within the last seconds."""
    answered: int
    steered: int
    """Answers that were twists; the others gave credit back."""
    skipped: dict[str, int]
    """By reason: what was not looked at."""
    overtaken: int
    """Frames that a newer one replaced while an older was looked at."""
    compute_us: int
    latency_us: int | None
    """Capture to accepted command, as the robot measured it."""


CountsNow = Callable[[], list[Counts]]
Observe = Callable[[CountsNow], None]
"""Told, once, how to look at the counts of every robot."""
