"""The rows of `bench network`: what the wire does, when, and what is demanded then. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from protocol.errors import ConfigError
from sim.wire import Shape, Shapes

HOLD_AGE_MS: Final = 400.0
"""A frame older than this is not driven on; the robot's default `safety.zero_speed_age_ms`."""
CUT_S: Final = 5.0
STEP_SETTLES_S: Final = 2.0
HEALS_S: Final = 1.0


@dataclass(frozen=True, slots=True)
class Phase:
    """Shapes in force for `seconds`, or for its share of the time asked for where that is None."""

    shapes: Shapes
    seconds: float | None = None
    settle_s: float = 0.0
    """How long after its beginning its bounds hold."""
    judged: bool = True


@dataclass(frozen=True, slots=True)
class Row:
    """One network. Bounds that are None are not demanded; `over_loopback_ms` is over the first phase's p50."""

    name: str
    what: str
    phases: tuple[Phase, ...]
    least_fps: float | None = None
    p50_ms: float | None = None
    p95_ms: float | None = None
    over_first_ms: float | None = None
    most_holds: int | None = None
    longest_hold_s: float | None = None
    flows_again_s: float | None = None


def both(**changes: float | bool) -> Shapes:
    """The same shape each way."""
    shape = Shape.model_validate(changes)
    return Shapes(ab=shape, ba=shape)


def _steady(**changes: float | bool) -> tuple[Phase, ...]:
    return (Phase(both(**changes)),)


ROWS: Final = (
    Row("rtt40", "40 ms round trip", _steady(delay_ms=20), least_fps=28, p50_ms=40 + 15),
    Row("near", "no loss, 1 ms each way", (Phase(both(), judged=False), Phase(both(delay_ms=1))), over_first_ms=2 + 1),
    Row("radio", "10 Mbit/s, 40 ms round trip, 2 % loss", _steady(delay_ms=20, loss=0.02, rate_bit_s=1e7), least_fps=12,
        p95_ms=160, most_holds=1, longest_hold_s=0.5),
    Row("thin", "2 Mbit/s, 10 ms round trip", _steady(delay_ms=5, rate_bit_s=2e6), p95_ms=250),
    Row("step", "10 Mbit/s, then 1 Mbit/s", (
        Phase(both(delay_ms=5, rate_bit_s=1e7), judged=False),
        Phase(both(delay_ms=5, rate_bit_s=1e6), settle_s=STEP_SETTLES_S),
    ), p95_ms=250),
    Row("rtt200", "200 ms round trip", _steady(delay_ms=100), least_fps=20, p95_ms=200 + 60),
    Row("cut", "a partition of 5 s", (
        Phase(both(delay_ms=1), judged=False), Phase(both(cut=True), CUT_S, judged=False),
        Phase(both(delay_ms=1), settle_s=HEALS_S),
    ), flows_again_s=HEALS_S),
)


def chosen(only: Iterable[str]) -> tuple[Row, ...]:
    """The rows named, all where none is. Raises ConfigError for a name that is none."""
    names = tuple(only)
    known = [row.name for row in ROWS]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f"--only {unknown[0]!r} is no row; there are: {', '.join(known)}")
    return tuple(row for row in ROWS if not names or row.name in names)


def spans_s(row: Row, seconds: float) -> list[float]:
    """How long each phase lasts when `seconds` are shared among those that have no length of their own."""
    shared = sum(phase.seconds is None for phase in row.phases)
    return [seconds / shared if phase.seconds is None else phase.seconds for phase in row.phases]
