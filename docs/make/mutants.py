"""Run each mutant at the cases that must catch it, and write docs/reference/results/conformance-mutants.md.

    python -m docs.make.mutants              # a minute or two: mutants on sockets run in real time
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from docs.make.reference import cell
from tests.conformance.mutants import peers

PAGE = Path(__file__).parent.parent / "reference" / "results" / "conformance-mutants.md"
AT_ONCE = 8
"""Mutants on sockets in parallel: they wait far more than they compute."""

FOLDER = "https://github.com/sightline-robot/sightline/tree/main/tests/conformance/mutants"
PREFACE = f"""`python -m docs.make.mutants` runs these mutants and writes this page. A mutant is a peer with one fault.
An operator makes it: it changes one field or message, or one text in the source. Hand-written mutants are programs.
The rows are in [tests/conformance/mutants]({FOLDER}).

Each mutant must fail each case in the last column. `python -m tests.conformance.mutants NAME` runs one again, and
`--all` runs it at all cases. A `socket` is a peer in real time on loopback; all others run in virtual time."""


def measured(mutants: Sequence[Any]) -> Iterator[tuple[Any, dict[str, str]]]:
    """Yield each mutant with the cases that failed. Mutants on sockets run in parallel."""
    with peers.Stage() as stage, ThreadPoolExecutor(AT_ONCE) as pool:
        def run(mutant: Any) -> dict[str, str]:
            chosen = [case for case in peers.CASES[mutant.peer] if mutant.survives or case.id in mutant.caught_by]
            return dict(peers.failed(stage.results(mutant.peer, mutant, chosen)))

        real = [one for one in mutants if one.peer in peers.REAL_TIME]
        # Before all others, because every thread sees a change of the source of a Python peer.
        on_sockets = dict(zip(map(str, real), pool.map(run, real), strict=True))
        for one in mutants:
            yield one, on_sockets[str(one)] if str(one) in on_sockets else run(one)


def to_page(results: Sequence[tuple[Any, dict[str, str]]]) -> str:
    """Return the page: counts, mutants that no case catches, then all mutants by peer."""
    missed = [one for one, failed in results if set(one.caught_by) - set(failed)]
    lines = ["# Mutants of the conformance kit", "", PREFACE, ""]
    lines += ["| peer | mutants | caught | listed |", "|---|---|---|---|"]
    counts = Counter(one.peer for one, _ in results)
    for peer, count in counts.items():
        listed = sum(one.peer == peer and bool(one.survives) for one, _ in results)
        caught = count - listed - sum(one.peer == peer for one in missed)
        lines.append(f"| {peer} | {count} | {caught} | {listed} |")
    lines += ["", "## Not caught", "", "| mutant | peer | why |", "|---|---|---|"]
    lines += [f"| {cell(one.name)} | {one.peer} | {cell(one.survives or 'MISSED')} |"
              for one, _ in results if one.survives or one in missed]
    for peer in counts:
        lines += ["", f"## {peer}", "", "| mutant | fault | operator | caught by |", "|---|---|---|---|"]
        lines += [f"| {name_of(one)} | {one.fault} | {one.operator} | {short(sorted(failed))} |"
                  for one, failed in results if one.peer == peer and not one.survives]
    return "\n".join(lines) + "\n"


def name_of(mutant: Any) -> str:
    """Return the name. That of a program is in its source."""
    return f"`{cell(mutant.name)}`" if mutant.exact or mutant.peer == "codec" else cell(mutant.name)


def short(names: Sequence[str]) -> str:
    """Return the ids, or the first and the number of many."""
    return ", ".join(names) if len(names) <= 8 else f"{names[0]} and {len(names) - 1} more"


def main() -> None:
    """Run all, and write the page."""
    mutants, problems = peers.table()
    assert not problems, problems
    PAGE.write_text(to_page(list(measured(mutants))), "utf-8")


if __name__ == "__main__":
    main()
