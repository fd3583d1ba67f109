"""The rows of `bench network`: wire shapes over time, and their bounds. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from sightline.protocol.errors import ConfigError
from sightline.sim.network_emulator import LinkShape, LinkShapes

CUT_S: Final = 5.0
NOTHING_S: Final = 1.0
STEP_SETTLES_S: Final = 2.0
HEALS_S: Final = 1.0
ZENOH: Final = "zenoh"
WEBSOCKET: Final = "websocket"


@dataclass(frozen=True, slots=True)
class NetworkPhase:
    """Shapes in force for `seconds`, or for a share of the requested time if that is None."""

    shapes: LinkShapes
    seconds: float | None = None
    settle_s: float = 0.0
    """Time after its start from which its bounds apply."""


@dataclass(frozen=True, slots=True)
class NetworkCase:
    """One network. Bounds that are None are not demanded; `over_first_ms` is over the first phase's p50.

    A row with a `scene` has more than one robot and one vision service: its scene runs and scores it. With
    `passes_through` the camera provides its own JPEGs, which cannot be made smaller.
    """

    name: str
    what: str
    phases: tuple[NetworkPhase, ...]
    least_fps: float | None = None
    p50_ms: float | None = None
    p95_ms: float | None = None
    over_first_ms: float | None = None
    most_holds: int | None = None
    longest_hold_s: float | None = None
    flows_again_s: float | None = None
    scene: str = ""
    passes_through: bool = False
    transports: tuple[str, ...] = (ZENOH, WEBSOCKET)

    @property
    def draws(self) -> bool:
        """Return True if it is random, so that the seeds differ."""
        legs = [leg for phase in self.phases for leg in (phase.shapes.ab, phase.shapes.ba)]
        return not self.scene and any(
            leg.loss or leg.burst_start or leg.jitter_ms or leg.reorder or leg.duplicate or leg.corrupt for leg in legs
        )


def both(**changes: float | bool) -> LinkShapes:
    """Return the same shape for each direction."""
    shape = LinkShape.model_validate(changes)
    return LinkShapes(ab=shape, ba=shape)


def _steady(**changes: float | bool) -> tuple[NetworkPhase, ...]:
    return (NetworkPhase(both(**changes)),)


_NEAR: Final = both(delay_ms=1)
_SITE: Final = (ZENOH,)
"""Rows with a router, or with one vision service for many robots. WebSocket has neither."""

CASES: Final = (
    NetworkCase("rtt40", "40 ms round trip", _steady(delay_ms=20), least_fps=28, p50_ms=40 + 15),
    NetworkCase(
        "near",
        "no loss, 1 ms each way",
        (NetworkPhase(both()), NetworkPhase(_NEAR)),
        least_fps=28,
        over_first_ms=2 + 1,
    ),
    NetworkCase(
        "radio",
        "10 Mbit/s, 40 ms round trip, 2 % loss",
        _steady(delay_ms=20, loss=0.02, rate_bit_s=1e7),
        least_fps=12,
        p95_ms=160,
        most_holds=1,
        longest_hold_s=0.5,
    ),
    NetworkCase(
        "bursts",
        "10 Mbit/s, 40 ms round trip, losses five in a row, 1 % in all",
        _steady(delay_ms=20, burst_start=0.002, burst_end=0.2, rate_bit_s=1e7),
        least_fps=12,
        p95_ms=160,
    ),
    NetworkCase("thin", "2 Mbit/s, 10 ms round trip", _steady(delay_ms=5, rate_bit_s=2e6), least_fps=20, p95_ms=250),
    NetworkCase(
        "through",
        "2 Mbit/s, 10 ms round trip, a camera's own JPEGs of 46 kB",
        _steady(delay_ms=5, rate_bit_s=2e6),
        least_fps=4,
        p95_ms=250,
        passes_through=True,
    ),
    NetworkCase(
        "step",
        "10 Mbit/s, then 1 Mbit/s",
        (
            NetworkPhase(both(delay_ms=5, rate_bit_s=1e7)),
            NetworkPhase(both(delay_ms=5, rate_bit_s=1e6), settle_s=STEP_SETTLES_S),
        ),
        least_fps=15,
        p95_ms=250,
    ),
    NetworkCase(
        "rise",
        "1 Mbit/s, then 10 Mbit/s",
        (
            NetworkPhase(both(delay_ms=5, rate_bit_s=1e6)),
            NetworkPhase(both(delay_ms=5, rate_bit_s=1e7), settle_s=STEP_SETTLES_S),
        ),
        least_fps=12,
        p95_ms=160,
    ),
    NetworkCase("rtt200", "200 ms round trip", _steady(delay_ms=100), least_fps=20, p95_ms=200 + 60),
    NetworkCase(
        "cut",
        "a partition of 5 s",
        (
            NetworkPhase(_NEAR),
            NetworkPhase(both(cut=True), CUT_S),
            NetworkPhase(_NEAR, settle_s=HEALS_S),
        ),
        flows_again_s=HEALS_S,
    ),
    NetworkCase(
        "nothing",
        "20 Mbit/s, 10 ms round trip, a second of nothing",
        (
            NetworkPhase(both(delay_ms=5, rate_bit_s=2e7)),
            NetworkPhase(both(cut=True), NOTHING_S),
            NetworkPhase(both(delay_ms=5, rate_bit_s=2e7), settle_s=HEALS_S),
        ),
        flows_again_s=HEALS_S,
    ),
    NetworkCase(
        "medium",
        "one half-duplex medium of 1 Mbit/s, video offered at 4, an operator sends STOP",
        (NetworkPhase(both(rate_bit_s=1e6).model_copy(update={"half_duplex": True})),),
        scene="medium",
        transports=_SITE,
    ),
    NetworkCase(
        "uplink",
        "vision, standby, a second reader and a viewer at a router beyond the radio",
        (NetworkPhase(_NEAR),),
        scene="uplink",
        transports=_SITE,
    ),
    NetworkCase(
        "standby", "the driving vision killed with -9, a standby beside it", (NetworkPhase(_NEAR),), scene="standby"
    ),
    NetworkCase(
        "router",
        "the router killed with -9 and started again after 1 s",
        (NetworkPhase(_NEAR),),
        scene="router",
        transports=_SITE,
    ),
    NetworkCase("moved", "the robot gets another address", (NetworkPhase(_NEAR),), scene="moved", transports=_SITE),
    NetworkCase(
        "fleet",
        "40 robots at 320x240, 15 fps, into one vision",
        (NetworkPhase(_NEAR),),
        scene="fleet",
        transports=_SITE,
    ),
    *(
        NetworkCase(name, f"20 robots, 15 fps, {what}", (NetworkPhase(_NEAR),), scene="shared", transports=_SITE)
        for name, what in (
            ("shared-killed", "3 vision services that share: each killed with -9 in turn"),
            ("shared-rolling", "3 vision services that share: each ended in order and started again in turn"),
            ("shared-scaled", "3 vision services that share, then 5, then 3"),
            ("shared-frozen", "3 vision services that share: each stopped for 3 s in turn"),
            ("shared-cut", "2 vision services that share: the link of one cut for 5 s"),
            ("shared-alone", "one vision service that shares: its link cut for 5 s"),
            ("shared-router", "3 vision services and 2 routers: each router killed with -9 in turn"),
            ("shared-router-frozen", "3 vision services and 2 routers: each router stopped for 5 s in turn"),
            ("shared-parted", "3 vision services and 2 routers: the link between the routers cut for 5 s"),
            ("shared-joined", "3 vision services that share: one more robot joins"),
        )
    ),
    NetworkCase(
        "shared-loaded", "20 robots, 15 fps, a detector of 8 ms, then 1, 2 and 4 vision services that share",
        (NetworkPhase(_NEAR),), scene="loaded", transports=_SITE,
    ),
    NetworkCase(
        "shared-200", "200 robots, 5 fps, one router, 3 vision services that share", (NetworkPhase(_NEAR),),
        scene="shared", transports=_SITE,
    ),
)


def chosen(only: Iterable[str], transport: str = ZENOH) -> tuple[NetworkCase, ...]:
    """Return the rows named, all without a name, that `transport` supports. Raises ConfigError for another name."""
    names = tuple(only)
    possible = tuple(row for row in CASES if transport in row.transports)
    known = [row.name for row in possible]
    for name in names:
        if name not in known:
            raise ConfigError(f"unknown --only {name!r} over {transport}; known: {', '.join(known)}")
    return tuple(row for row in possible if not names or row.name in names)


def spans_s(row: NetworkCase, seconds: float) -> list[float]:
    """Return the length of each phase, with `seconds` shared among those without a length."""
    shared = sum(phase.seconds is None for phase in row.phases)
    return [seconds / shared if phase.seconds is None else phase.seconds for phase in row.phases]
