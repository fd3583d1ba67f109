"""Results as JSON and JUnit XML. Pure."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from typing import Any

from sightline.conformance.case import Level
from sightline.conformance.runner import Outcome, Result, passed, printable


def counts(results: Sequence[Result]) -> Counter[str]:
    """Count each outcome, with failed SHOULDs separately."""
    return Counter(_counted_as(one) for one in results)


def _counted_as(one: Result) -> str:
    weak = one.outcome is Outcome.FAILED and one.case.level is Level.SHOULD
    return "SHOULD failed" if weak else one.outcome.value


def summary(results: Sequence[Result]) -> str:
    """One line: does the peer conform, and how many of what."""
    found = counts(results)
    names = (Outcome.PASSED.value, Outcome.FAILED.value, "SHOULD failed", Outcome.SKIPPED.value)
    figures = ", ".join(f"{found[name]} {name}" for name in names if found[name] or name == Outcome.PASSED.value)
    return f"{'conforms' if passed(results) else 'does NOT conform'}: {figures}, of {len(results)} cases"


def to_dict(results: Sequence[Result], side: str, peer: str) -> dict[str, Any]:
    """One object for scripts, as every command that validates prints it."""
    return {
        "ok": passed(results),
        "side": side,
        "peer": peer,
        "counts": dict(counts(results)),
        "checks": [_check(one) for one in results],
    }


def _check(one: Result) -> dict[str, Any]:
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
    }


def to_junit(results: Sequence[Result], side: str, peer: str) -> str:
    """JUnit XML: a failed MUST is a failure; a failed SHOULD and what is not applicable are skipped, with a reason."""
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
