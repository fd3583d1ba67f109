"""The table of mutants: rows of TOML, checked one by one. A bad row is one line, and the others still run. Shell."""

import tomllib
from dataclasses import dataclass, field
from pathlib import Path

from tests.conformance.mutants.operators import CHANNEL_NAMES, OF_SOURCE, OPERATORS, parameters_of

FOLDER = Path(__file__).parent
FAULTS = (
    "swapped fields", "flipped sign", "coasting", "off by one", "echo of another field", "wrong unit",
    "forgotten reset", "lost credit", "wrong role", "ignored limit", "stale re-send", "wrong order", "too strict",
    "hand-written",
)
_OWN = {"name", "fault", "operator", "caught_by", "survives", "message", "when"}


@dataclass(frozen=True)
class Mutant:
    """One peer with one fault.

    Args:
        name: the fault in a few words.
        peer: name of the peer, a key of `peers.PEERS`.
        fault: one of FAULTS.
        operator: name of the operator, or of a hand-written peer's function.
        caught_by: ids of the cases that must fail.
        exact: True if no other case may fail.
        survives: the reason why no case catches it, in place of `caught_by`.
    """

    name: str
    peer: str
    fault: str
    operator: str
    caught_by: tuple[str, ...]
    parameters: dict = field(default_factory=dict)
    message: str = ""
    when: dict = field(default_factory=dict)
    exact: bool = False
    survives: str = ""

    def __str__(self):
        return f"{self.peer}: {self.name}"


def read_table(text, file, cases):
    """Read rows.

    Args:
        text: TOML with one array of tables for each peer: `[[robot]]`.
        file: its name, for the lines about bad rows.
        cases: peer -> ids of its cases.

    Returns:
        The good mutants, and one line for each bad row.
    """
    mutants, problems = [], []
    try:
        rows = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        return [], [f"{file}: invalid TOML: {error}"]
    for peer, of_peer in rows.items():
        if peer not in cases:
            problems.append(f"{file}: unknown peer {peer!r}; expected one of {', '.join(cases)}")
            continue
        for row in of_peer:
            wrong = _problem(row, {one.name for one in mutants if one.peer == peer}, cases[peer])
            if wrong:
                problems.append(f"{file}: mutant {row.get('name', '?')!r} of {peer}: {wrong}")
            else:
                mutants.append(_mutant(row, peer))
    return mutants, problems


def _problem(row, names, ids):
    """Return the first thing that is wrong with a row, or an empty text."""
    missing = [name for name in ("name", "fault", "operator") if name not in row]
    if missing:
        return f"{missing[0]} is missing"
    operator = row["operator"]
    if operator not in OPERATORS:
        return f"unknown operator {operator!r}; expected one of {', '.join(sorted(OPERATORS))}"
    unknown = [one for one in row.get("caught_by", ()) if one not in ids]
    given = set(row) - _OWN
    checks = (
        (row["name"] in names, "the name is there twice"),
        (row["fault"] not in FAULTS, f"unknown fault {row['fault']!r}; expected one of {', '.join(FAULTS)}"),
        (given != parameters_of(operator), f"{operator} has the parameters {_names(parameters_of(operator))}, "
                                           f"not {_names(given)}"),
        (operator not in OF_SOURCE and row.get("message") not in CHANNEL_NAMES, "`message` names no channel"),
        (bool(unknown), f"unknown case {', '.join(unknown)}"),
        (bool(row.get("caught_by")) == bool(row.get("survives")), "give either `caught_by` or `survives`"),
    )
    return next((text for wrong, text in checks if wrong), "")


def _names(given):
    return ", ".join(sorted(given)) or "none"


def _mutant(row, peer):
    parameters = {name: value for name, value in row.items() if name not in _OWN}
    return Mutant(
        row["name"], peer, row["fault"], row["operator"], tuple(row.get("caught_by", ())), parameters,
        row.get("message", ""), row.get("when", {}), survives=row.get("survives", ""),
    )


def read_files(cases, folder=FOLDER):
    """Read every table of the folder: the good mutants, and one line for each bad row."""
    mutants, problems = [], []
    for path in sorted(folder.glob("*.toml")):
        good, bad = read_table(path.read_text("utf-8"), path.name, cases)
        mutants += good
        problems += bad
    return mutants, problems
