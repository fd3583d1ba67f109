"""Run the table of mutants: one line each, as it ends. Shell.

    python -m tests.conformance.mutants            each mutant at the cases that must catch it
    python -m tests.conformance.mutants --all      at all cases; exits with 5 if a mutant survives or a row is bad
    python -m tests.conformance.mutants NAME       only mutants whose peer and name contain NAME
"""

import sys

from tests.conformance.mutants import peers
from tests.conformance.mutants.operators import OperatorError


def outcome_of(stage, mutant, everything):
    """Return the cases that failed, and what is wrong with that, or an empty text."""
    cases = [case for case in peers.CASES[mutant.peer] if everything or mutant.survives or case.id in mutant.caught_by]
    try:
        failed = list(peers.failed(stage.results(mutant.peer, mutant, cases)))
    except OperatorError as error:
        return [], str(error)
    missed = [name for name in mutant.caught_by if name not in failed]
    if missed:
        return failed, f"not caught by {', '.join(missed)}"
    return failed, f"listed as not caught: {mutant.survives}" if mutant.survives and failed else ""


def main(arguments):
    """Return the exit code."""
    everything = "--all" in arguments
    names = [one for one in arguments if one != "--all"]
    mutants, problems = peers.table()
    print(*(f"error: {line}" for line in problems), sep="\n", end="\n" if problems else "")
    bad = len(problems)
    with peers.Stage() as stage:
        for mutant in mutants:
            if all(name in str(mutant) for name in names):
                failed, wrong = outcome_of(stage, mutant, everything)
                bad += bool(wrong)
                print("FAIL" if wrong else "ok", mutant, "|", wrong or ", ".join(failed) or mutant.survives, flush=True)
    return 5 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
