"""Every case for a codec, and running them against a program on a pipe. Shell.

    results = run_codec(["node", "codec_adapter.mjs"], CASES)
"""

import time
from collections.abc import Callable, Sequence
from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Case, Level, NotApplicableError, Suite
from sightline.conformance.codec import ProgramError, same
from sightline.protocol.conformance.codec_process import CodecProgram
from sightline.protocol.conformance.codec_questions import CodecCase, codec_cases
from sightline.conformance.runner import Outcome, Result

END: Final = "C-CODEC-9001"


def _on_a_pipe(_bench: Bench) -> None:
    raise NotApplicableError("a codec is asked on a pipe, not over a network")


def _cases(asked: Sequence[CodecCase]) -> tuple[Case, ...]:
    suite = Suite("C")
    for one in asked:
        level = Level.MUST if one.must else Level.SHOULD
        suite.add(Case(f"C-CODEC-{one.number}", level, one.clause, one.purpose, _on_a_pipe))
    title = "The program ends, with 0, when its input ends."
    suite.add(Case(END, Level.SHOULD, "17.3 A codec on a pipe", title, _on_a_pipe))
    return tuple(suite.cases)


_SENT: Final = {f"C-CODEC-{one.number}": one for one in codec_cases()}
CASES: Final[tuple[Case, ...]] = _cases(tuple(_SENT.values()))


def run_codec(
    command: Sequence[str], cases: Sequence[Case] = CASES, on_result: Callable[[Result], None] = lambda _result: None
) -> list[Result]:
    """Ask the program of `command` about each of `cases`.

    One that dies, hangs or answers what is no answer fails the case it was in; what it cannot be asked any more is not
    applicable. Raises ConfigError if it cannot be started.
    """
    results: list[Result] = []
    gone = ""
    with CodecProgram(command) as program:
        for case in cases:
            began_s = time.monotonic()
            outcome, reason = (Outcome.SKIPPED, "the program is gone") if gone else (Outcome.PASSED, "")
            try:
                if not gone:
                    outcome, reason = _result(program, case)
            except ProgramError as fault:
                gone = reason = str(fault)
                outcome = Outcome.FAILED
            results.append(Result(case, outcome, reason, round((time.monotonic() - began_s) * 1e6)))
            on_result(results[-1])
    return results


def _result(program: CodecProgram, case: Case) -> tuple[Outcome, str]:
    """Ask one case's questions. Raises ProgramError."""
    if case.id == END:
        program.finish()
        return Outcome.PASSED, ""
    wrong, unsupported = "", ""
    for question, answer in program.ask(_SENT[case.id].questions()):
        if "unsupported" in answer:
            unsupported = f"the program does not know questions of kind {question.kind}"
        wrong = wrong or ("" if unsupported else same(dict(question.expected), answer))
    if wrong:
        return Outcome.FAILED, wrong
    return (Outcome.SKIPPED, unsupported) if unsupported else (Outcome.PASSED, "")
