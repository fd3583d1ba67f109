"""What a run of the kit leaves for machines: JSON, JUnit XML, and the Markdown page of several runs. Pure."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Final

from sightline.conformance.case import Level
from sightline.conformance.runner import Outcome, Result, passed, printable

_MARKS: Final = {Outcome.PASSED: "ok", Outcome.FAILED: "FAIL", Outcome.SKIPPED: "n/a"}

_PREFACE: Final = """Made by `sightline conform page` from runs of the kit; `python -m tests.conformance.page_runs`
runs it over these peers and writes this page. A case that a peer's choices leave nothing to test in (no guests, no
scan, no port of the older dialect, no token, another transport) counts as not applicable. Clauses are those of
[protocol/README.md](../protocol/README.md)."""

_LISTED_ELSEWHERE: Final = ("codec",)
"""Sides without a table of every case: a codec's are the golden vectors, each of which says what it is for."""


def counts(results: Sequence[Result]) -> Counter[str]:
    """How many of each outcome; failed SHOULDs apart."""
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
    """One object for scripts, as every command that judges prints it."""
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
            said = {"message": printable(one.reason), "type": one.case.level.value}
            ET.SubElement(element, tag, said if tag == "failure" else {"message": said["message"]})
    return ET.tostring(suite, encoding="unicode", xml_declaration=True) + "\n"


def to_page(runs: Sequence[Mapping[str, Any]]) -> str:
    """The Markdown page of several runs (their JSON): peers, what did not pass at once, every case of each side."""
    lines = ["# Conformance", "", _PREFACE, ""]
    lines += ["| peer | side | conforms | passed | failed | SHOULD failed | not applicable | cases |", "|" + "---|" * 8]
    for run in runs:
        found = run["counts"]
        figures = (found.get(name, 0) for name in ("passed", "failed", "SHOULD failed", "not applicable"))
        row = [run["peer"], run["side"], "yes" if run["ok"] else "no", *figures, len(run["checks"])]
        lines.append("| " + " | ".join(str(cell) for cell in row) + " |")
    for run in runs:
        lines += _remarks(run)
    for side in dict.fromkeys(run["side"] for run in runs if run["side"] not in _LISTED_ELSEWHERE):
        lines += _case_table(side, [run for run in runs if run["side"] == side])
    return "\n".join(lines) + "\n"


def _remarks(run: Mapping[str, Any]) -> list[str]:
    told = [check for check in run["checks"] if check["reason"]]
    if not told:
        return []
    alike: dict[tuple[str, str], list[str]] = {}
    for one in told:
        alike.setdefault((one["value"], one["reason"]), []).append(one["name"])
    lines = ["", f"## {run['peer']}: what did not pass at once", "", "| cases | outcome | why |", "|---|---|---|"]
    return lines + [f"| {', '.join(names)} | {what} | {_cell(why)} |" for (what, why), names in alike.items()]


def _case_table(side: str, runs: Sequence[Mapping[str, Any]]) -> list[str]:
    peers = [run["peer"] for run in runs]
    lines = ["", f"## Cases: {side}", "", f"| case | | clause | what | {' | '.join(peers)} |",
             "|" + "---|" * (4 + len(peers))]
    outcomes = [{check["name"]: _MARKS[Outcome(check["value"])] for check in run["checks"]} for run in runs]
    cases = {check["name"]: check for run in runs for check in run["checks"]}
    for name, check in cases.items():
        found = " | ".join(outcome.get(name, "") for outcome in outcomes)
        lines.append(f"| {name} | {check['level']} | {check['clause']} | {_cell(check['title'])} | {found} |")
    return lines


def _cell(text: str) -> str:
    return " ".join(printable(text).replace("|", "\\|").split())
