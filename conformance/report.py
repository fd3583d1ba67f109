"""Results as JSON and JUnit XML. Pure."""

import json
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

from sightline.conformance.case import Case, Level
from sightline.conformance.runner import Outcome, Result, passed, printable, untested
from sightline.protocol.errors import ConfigError


def counts(results: Sequence[Result]) -> Counter[str]:
    """Count each outcome, with failed SHOULDs separately."""
    return Counter(_counted_as(one) for one in results)


def _counted_as(one: Result) -> str:
    weak = one.outcome is Outcome.FAILED and one.case.level is Level.SHOULD
    return "SHOULD failed" if weak else one.outcome.value


def summary(results: Sequence[Result]) -> str:
    """Return one line: whether the peer conforms, the counts, and why a MUST was not tested."""
    found = counts(results)
    names = (Outcome.PASSED.value, Outcome.FAILED.value, "SHOULD failed", Outcome.SKIPPED.value)
    figures = ", ".join(f"{found[name]} {name}" for name in names if found[name] or name == Outcome.PASSED.value)
    left = untested(results)
    more = f"; {len(left)} MUST could not be tested, first {left[0].case.id}: {left[0].reason}" if left else ""
    return f"{'conforms' if passed(results) else 'does NOT conform'}: {figures}, of {len(results)} cases{more}"


def to_dict(results: Sequence[Result], side: str, peer: str) -> dict[str, Any]:
    """Return the JSON object for scripts, as of every validating command."""
    return {
        "ok": passed(results),
        "side": side,
        "peer": peer,
        "counts": dict(counts(results)),
        "checks": [to_check(one) for one in results],
    }


def from_lines(text: str, cases: Sequence[Case], side: str, peer: str, file: str) -> list[Result]:
    """Read the results of an earlier run of the same peer, one JSON object a line. The last line may be cut.

    Raises ConfigError for a damaged file and for another peer.
    """
    known = {case.id: case for case in cases}
    results: list[Result] = []
    for number, line in enumerate(text.splitlines(keepends=True), 1):
        if not line.endswith("\n"):
            break
        try:
            fields = json.loads(line)
            found = fields["side"], fields["peer"]
            outcome, reason, took_us = Outcome(fields["value"]), str(fields["reason"]), round(fields["seconds"] * 1e6)
            case = known.get(fields["name"])
        except (ValueError, KeyError, TypeError):
            raise ConfigError(f"damaged --resume {file}, line {number}: not a result; remove the line") from None
        if found != (side, peer):
            raise ConfigError(f"--resume {file}: line {number} is of {found[0]} {found[1]}, not of {side} {peer}; "
                              "name another file")
        if case is not None:
            results.append(Result(case, outcome, reason, took_us))
    return results


LINE_START: Final = '{"name": '
"""Start of each line of `to_line`."""


def to_line(one: Result, side: str, peer: str) -> str:
    """Return the result of one case as one line of JSON."""
    return json.dumps({**to_check(one), "side": side, "peer": peer})


def to_check(one: Result) -> dict[str, Any]:
    """Return the result of one case in the form of the report."""
    case = one.case
    return {
        "name": case.id,
        "value": one.outcome.value,
        "unit": "",
        "bound": Outcome.PASSED.value,
        "ok": _counted_as(one) != Outcome.FAILED.value,
        "level": case.level.value,
        "group": case.group,
        "clause": case.clause,
        "title": case.title,
        "reason": one.reason,
        "seconds": round(one.took_us / 1e6, 3),
        "evidence": list(one.evidence),
    }


def to_junit(results: Sequence[Result], side: str, peer: str) -> str:
    """Return JUnit XML: a failed MUST is a failure; failed SHOULD and not applicable cases are skipped."""
    found = counts(results)
    skipped = str(found["SHOULD failed"] + found[Outcome.SKIPPED.value])
    seconds = f"{sum(one.took_us for one in results) / 1e6:.3f}"
    head = {"name": printable(f"sightline conform {side} {peer}"), "tests": str(len(results)), "time": seconds}
    suite = ET.Element("testsuite", {**head, "failures": str(found[Outcome.FAILED.value]), "skipped": skipped})
    for one in results:
        names = {"classname": f"{side}.{one.case.group}", "name": f"{one.case.id} {one.case.title}"}
        element = ET.SubElement(suite, "testcase", {**names, "time": f"{one.took_us / 1e6:.3f}"})
        if one.outcome is not Outcome.PASSED:
            tag = "failure" if _counted_as(one) == Outcome.FAILED.value else "skipped"
            reported = {"message": printable(one.reason), "type": one.case.level.value}
            ET.SubElement(element, tag, reported if tag == "failure" else {"message": reported["message"]})
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"
