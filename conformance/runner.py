"""Runs cases one after another and collects their results. Pure."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum

from sightline.conformance.case import GROUPS, NOT_DRIVING, Bench, Case, ConformanceError, Level, NotApplicableError
from sightline.protocol.errors import ConfigError, LinkError


class Outcome(StrEnum):
    """The result of a case."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "not applicable"


@dataclass(frozen=True, slots=True)
class Result:
    """A case that ran. `reason` is empty when it passed at once."""

    case: Case
    outcome: Outcome
    reason: str = ""
    took_us: int = 0
    evidence: tuple[str, ...] = ()
    """The last messages of a failed case."""


def run_case(case: Case, bench: Bench, prepare: Callable[[Bench], None] = lambda _bench: None) -> Result:
    """Run one case; whatever a peer makes it raise is a result."""
    bench.forget()
    began_us = bench.now_us
    outcome, reason = Outcome.PASSED, ""
    try:
        bench.restore()
        prepare(bench)
        case.run(bench)
    except NotApplicableError as missing:
        outcome, reason = Outcome.SKIPPED, str(missing)
    except (ConformanceError, LinkError) as failed:
        outcome, reason = Outcome.FAILED, str(failed)
    except Exception as error:  # a peer's nonsense must not end the run
        outcome, reason = Outcome.FAILED, f"{type(error).__name__}: {error}"
    evidence = tuple(map(printable, bench.evidence())) if outcome is Outcome.FAILED else ()
    return Result(case, outcome, printable(reason), bench.now_us - began_us, evidence)


def printable(text: str) -> str:
    """`text` as a terminal, XML and UTF-8 can hold it: a reason may quote any bytes of a peer."""
    return "".join(char if char.isprintable() else "?" for char in text)


def run_cases(
    cases: Iterable[Case],
    bench: Bench,
    prepare: Callable[[Bench], None] = lambda _bench: None,
    on_result: Callable[[Result], None] = lambda _result: None,
    tries: int = 1,
) -> list[Result]:
    """Run `cases` in order against one peer; `prepare` brings it to where each begins.

    Over a network nothing may be relied on to arrive: with `tries` above 1 a case fails that fails so often in a row,
    and one that passes later reports how it failed before.
    """
    results = []
    for case in cases:
        result = run_case(case, bench, prepare)
        for count in range(2, tries + 1):
            if result.outcome is not Outcome.FAILED:
                break
            result = _after(result, run_case(case, bench, prepare), count)
        results.append(result)
        on_result(result)
    return results


def _after(last: Result, this: Result, count: int) -> Result:
    """Return the result of two runs of a case after a failed first one. Only a pass, at try `count`, replaces it."""
    if this.outcome is not Outcome.PASSED:
        return this if this.outcome is Outcome.FAILED else last
    return Result(this.case, this.outcome, f"at try {count}; before: {last.reason}", this.took_us)


def passed(results: Sequence[Result]) -> bool:
    """Return True if the peer conforms: no MUST failed or needed a vision service that drives, and a case passed."""
    broken = any((one.outcome is Outcome.FAILED or one.reason == NOT_DRIVING) and one.case.level is Level.MUST
                 for one in results)
    return not broken and any(one.outcome is Outcome.PASSED for one in results)


def chosen(cases: Sequence[Case], only: Sequence[str] = (), groups: Sequence[str] = ()) -> list[Case]:
    """The cases named by id (or the beginning of one) and by group; all if nothing is named. Raises ConfigError."""
    for name in only:
        if not any(case.id.startswith(name.upper()) for case in cases):
            raise ConfigError(f"--only {name}: no case begins so; `--list` names them, e.g. --only {cases[0].id}")
    for name in groups:
        if name not in (case.group for case in cases):
            known = ", ".join(group for group in GROUPS.values() if group in {case.group for case in cases})
            raise ConfigError(f"--group {name}: no such group; there are {known}")
    return [
        case
        for case in cases
        if (not only or any(case.id.startswith(name.upper()) for name in only))
        and (not groups or case.group in groups)
    ]
