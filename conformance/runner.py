"""Run cases one after another and collect their results. Pure."""

import re
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from sightline.conformance.case import GROUPS, NOT_DRIVING, Bench, Case, ConformanceError, Level, NotApplicableError
from sightline.protocol.errors import ConfigError, LinkError

_NAMED: Final = re.compile(r"\b[RV]-[A-Z]+-[0-9]+\b")


class Outcome(StrEnum):
    """The result of a case."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "not applicable"


@dataclass(frozen=True, slots=True)
class Result:
    """A case that ran. `reason` is empty if it passed the first time."""

    case: Case
    outcome: Outcome
    reason: str = ""
    took_us: int = 0
    evidence: tuple[str, ...] = ()
    """The last messages of a failed case."""


def run_case(case: Case, bench: Bench, prepare: Callable[[Bench], None] = lambda _bench: None) -> Result:
    """Run one case. Any exception is a result."""
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
    except Exception as error:  # invalid data of a peer must not end the run
        outcome, reason = Outcome.FAILED, f"{type(error).__name__}: {error}"
    evidence = tuple(map(printable, bench.evidence())) if outcome is Outcome.FAILED else ()
    return Result(case, outcome, printable(reason), bench.now_us - began_us, evidence)


def printable(text: str) -> str:
    """Return `text` in a form for terminals, XML and UTF-8, because a reason may quote any bytes of a peer."""
    return "".join(char if char.isprintable() else "?" for char in text)


def run_cases(
    cases: Iterable[Case],
    bench: Bench,
    prepare: Callable[[Bench], None] = lambda _bench: None,
    on_result: Callable[[Result], None] = lambda _result: None,
    tries: int = 1,
) -> list[Result]:
    """Run `cases` in order against one peer; `prepare` sets its initial state.

    A network may lose messages. With `tries` above 1 a case fails only after that many failures in a row, and a
    later pass reports the earlier failure.
    """
    results: list[Result] = []
    for case in cases:
        result = run_case(case, bench, prepare)
        for count in range(2, tries + 1):
            if result.outcome is not Outcome.FAILED and not _is_doubtful(result, results):
                break
            result = _after(result, run_case(case, bench, prepare), count)
        results.append(result)
        on_result(result)
    return results


def _is_doubtful(result: Result, before: Sequence[Result]) -> bool:
    return result.reason != NOT_DRIVING and result in untested([*before, result])


def _after(last: Result, this: Result, count: int) -> Result:
    """Return the result of two runs of a case after a failed first one. Only a pass, at try `count`, replaces it.

    A robot that the first run left with turning wheels fails the next ones before they begin, which explains nothing.
    """
    if this.outcome is not Outcome.PASSED:
        return this if last.outcome is Outcome.SKIPPED else last
    return Result(this.case, this.outcome, f"at try {count}; before: {last.reason}", this.took_us)


def passed(results: Sequence[Result]) -> bool:
    """Return True if the peer conforms: no MUST failed or was left untested, and a case passed."""
    failed = any(one.outcome is Outcome.FAILED and one.case.level is Level.MUST for one in results)
    return not failed and not untested(results) and any(one.outcome is Outcome.PASSED for one in results)


def untested(results: Sequence[Result]) -> list[Result]:
    """Return MUST cases that could not run although a case of their requirement passed, or for lack of twists.

    A robot that can be armed for one driver but not for another has no such choice.
    """
    good = {one.case.id for one in results if one.outcome is Outcome.PASSED and one.case.level is Level.MUST}
    return [one for one in results if one.outcome is Outcome.SKIPPED and one.case.level is Level.MUST
            and (one.reason == NOT_DRIVING or _needs_one_of(one, good))]


def _needs_one_of(result: Result, ids: Collection[str]) -> bool:
    """Return True if all cases that the reason names, as in `(R-ARM-03)`, are among `ids`."""
    named = _NAMED.findall(result.reason)
    return bool(named) and all(name in ids for name in named)


def chosen(cases: Sequence[Case], only: Sequence[str] = (), groups: Sequence[str] = ()) -> list[Case]:
    """Return the cases named by id (or its beginning) and by group; all without names. Raises ConfigError."""
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
