"""One row of the fault bench: what is injected and what is demanded. Pure."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sightline.evaluation.checks import Check
from sightline.evaluation.faults.evidence import DISTANCE_M, FALLS_MS, OLD_US, ZERO_MS

if TYPE_CHECKING:
    from sightline.operator_side.faults.rig import RobotFixture, Setup


@dataclass(frozen=True, slots=True)
class Injected:
    """What an injection did: how often, when it began, when sight or commands were good again."""

    count: int
    at_us: int
    resumed_us: int | None = None
    again: bool | None = None
    """Whether the robot drove again, where that is demanded."""
    checks: tuple[Check, ...] = ()
    """What only this row demands."""


@dataclass(frozen=True, slots=True)
class Case:
    """One fault. `inject` is given a robot at speed and returns when there is nothing more to see."""

    id: str
    what: str
    inject: "Callable[[RobotFixture], Injected]"
    setup: "Setup"
    blind: bool = False
    """Commands go on while they must not be obeyed any more: from the injection on, none counts as good."""
    by_frame: bool = False
    """It is pictures that end, not commands: one under way may still be answered."""
    stops: bool = True
    """A stop is demanded after the last valid command."""
    again: bool = False
    zero_ms: float = ZERO_MS
    distance_m: float = DISTANCE_M
    also: str = ""
    """In words, what `Injected.checks` demand."""
    short: bool = False
    """Part of the short set."""
    alone: bool = False
    """It takes the whole machine: no other row runs beside it."""

    @property
    def demanded(self) -> str:
        """In words."""
        stop = f"falls <= {min(FALLS_MS, self.zero_ms):g} ms, zero <= {self.zero_ms:g} ms, <= {self.distance_m:g} m"
        parts = [
            stop if self.stops else f"no motion on frames older than {OLD_US // 1000} ms",
            "drives again" if self.again else "",
            self.also,
        ]
        return "; ".join(part for part in parts if part)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of one run of a row. `skipped` says why it could not run."""

    row: Case
    checks: tuple[Check, ...] = ()
    skipped: str = ""
    trouble: str = ""
    """Why there are no figures."""

    @property
    def ok(self) -> bool:
        """Every check held; a row that was skipped is not ok."""
        return bool(self.checks) and not self.trouble and all(check.ok for check in self.checks)
