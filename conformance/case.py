"""What a case is: numbered, MUST or SHOULD, of one clause, a plain function of a `Bench`. Pure.

    SUITE = Suite("R")

    @SUITE.must("R-CAUS-02", "How a robot judges")
    def unknown_frame(bench: Bench) -> None:
        '''A twist that cites a frame never issued is refused as UNKNOWN_FRAME.'''
        ...
        bench.expect(reason == "UNKNOWN_FRAME", f"it was {reason}")

The id is side, group and number; the first docstring line is the title; the clause is a heading of the specification.
A case returns when the peer conforms and raises `ConformanceError` (through `bench.expect`) when it does not. It
raises `NotApplicableError` (through `bench.need`) when what it builds on is missing: that has a case of its own, or is
a choice.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from sightline.protocol.conformance.bench import Bench

GROUPS: Final = {
    "FRAM": "framing",
    "HEAD": "headers",
    "GRAM": "grammar",
    "CAUS": "causality",
    "SEQ": "sequence",
    "LIM": "limits",
    "LEASE": "lease",
    "ARM": "arming",
    "STOP": "stop",
    "SIL": "silence",
    "REQ": "requests",
    "STAT": "status",
    "FLOW": "flow",
    "DIAL": "dialect",
    "HOST": "hostile input",
    "RECO": "reconnect",
    "SOCK": "websocket",
    "STEER": "steering",
    "CODEC": "codec",
}
"""Code in an id -> the group's name, as `--group` takes it."""


class Level(StrEnum):
    """How binding a case is, in the words of RFC 2119."""

    MUST = "MUST"
    SHOULD = "SHOULD"


class ConformanceError(Exception):
    """The peer does not conform; the text says what was expected and what was seen."""


class NotApplicableError(Exception):
    """What the case builds on is missing here; the text says what."""


@dataclass(frozen=True, slots=True)
class Case:
    """One point of the specification and the function that tests it."""

    id: str
    level: Level
    clause: str
    title: str
    run: "Callable[[Bench], None]"
    real: bool = False
    """Whether it needs real sockets, so that it cannot run in virtual time."""

    @property
    def group(self) -> str:
        """The group's name."""
        return GROUPS[self.id.split("-")[1]]


class Suite:
    """The cases of one file. `side` is the letter their ids begin with: R robot, V vision, C codec."""

    def __init__(self, side: str) -> None:
        self.side = side
        self.cases: list[Case] = []

    def must(self, number: str, clause: str, *, real: bool = False) -> "Callable[[Run], Run]":
        """Decorator: a case that every peer has to pass."""
        return self._adding(number, Level.MUST, clause, real)

    def should(self, number: str, clause: str, *, real: bool = False) -> "Callable[[Run], Run]":
        """Decorator: a case that a peer may fail for a good reason."""
        return self._adding(number, Level.SHOULD, clause, real)

    def add(self, case: Case) -> None:
        """Add a case made otherwise, e.g. from a table. Raises ValueError for a bad or double id."""
        parts = case.id.split("-")
        if len(parts) != 3 or parts[0] != self.side or parts[1] not in GROUPS or not parts[2].isdigit():
            raise ValueError(f"{case.id}: write {self.side}-GROUP-NN with a group of {', '.join(GROUPS)}")
        if any(other.id == case.id for other in self.cases):
            raise ValueError(f"{case.id} is there twice")
        self.cases.append(case)

    def _adding(self, number: str, level: Level, clause: str, real: bool) -> "Callable[[Run], Run]":
        def add(run: Run) -> Run:
            self.add(Case(number, level, clause, (run.__doc__ or "").split("\n")[0], run, real))
            return run

        return add


Run = Callable[["Bench"], None]
