"""Results as JSON, JUnit XML, a Markdown page and one HTML file. Pure."""

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
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


# The report of a run as one HTML file that a person can read, without a network or another file. Pure.


_CLASSES: Final = {Outcome.PASSED: "passed", Outcome.FAILED: "failed", Outcome.SKIPPED: "skipped"}
_STYLE: Final = """
:root { color-scheme: light dark; --line: #8884; --good: #1a7f37; --bad: #cf222e; --weak: #9a6700; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; }
h1 { margin-bottom: 0; } .verdict { font-size: 1.2rem; font-weight: 600; }
.verdict.passed, td.passed { color: var(--good); } .verdict.failed, td.failed { color: var(--bad); }
td.weak { color: var(--weak); } .note { opacity: .7; }
td.skipped { opacity: .7; } td .note { display: block; font-size: .85rem; } code { font-size: .92em; }
table { border-collapse: collapse; width: 100%; table-layout: fixed; }
td, th { border-bottom: 1px solid var(--line); padding: .35rem .5rem;
text-align: left; vertical-align: top; }
td:first-child { width: 7rem; font-family: ui-monospace, monospace; }
td:nth-child(2) { width: 4.5rem; } td:nth-child(4) { width: 7.5rem; }
td:last-child { width: 3.5rem; text-align: right; }
.reason { display: block; font-family: ui-monospace, monospace; font-size: .85rem; overflow-wrap: anywhere; }
"""


def to_html(results: Sequence[Result], side: str, peer: str) -> str:
    """The whole page; whatever a peer said in it is escaped."""
    verdict = "passed" if passed(results) else "failed"
    sections = [
        _section(group, list(members)) for group, members in groupby(results, lambda one: one.case.group)
    ]
    return "\n".join(
        [
            '<!doctype html><html lang="en"><head><meta charset="utf-8">',
            '<meta name="viewport" content="width=device-width">',
            f"<title>Sightline conformance: {_text(peer)}</title><style>{_STYLE}</style></head><body>",
            f"<h1>Conformance of a {_text(side)}</h1><p class='note'>{_text(peer)}</p>",
            f"<p class='verdict {verdict}'>{_text(summary(results))}</p>",
            "<p class='note'>Each case tests one clause of protocol/README.md. Not applicable: what the case builds on "
            "is missing here, by the peer's choice or because a case of its own has failed.</p>",
            *_failures(results),
            *sections,
            "</body></html>\n",
        ]
    )


def _text(text: str) -> str:
    return escape(printable(text))


def _failures(results: Sequence[Result]) -> list[str]:
    """What failed, before everything else; nothing where nothing did."""
    failed = [one for one in results if one.outcome is Outcome.FAILED]
    return [f"<h2>What failed</h2>\n<table>{chr(10).join(map(_row, failed))}</table>"] if failed else []


def _title(text: str) -> str:
    """With what stands between backticks as code."""
    return "".join(f"<code>{part}</code>" if at % 2 else part for at, part in enumerate(_text(text).split("`")))


def _section(group: str, results: Sequence[Result]) -> str:
    good = sum(one.outcome is Outcome.PASSED for one in results)
    rows = "\n".join(_row(one) for one in results)
    return f"<h2>{_text(group)} <span class='note'>{good} of {len(results)}</span></h2>\n<table>{rows}</table>"


def _row(one: Result) -> str:
    case = one.case
    weak = one.outcome is Outcome.FAILED and case.level is Level.SHOULD
    reason = f"<span class='reason'>{_text(one.reason)}</span>" if one.reason else ""
    return (
        f"<tr><td>{_text(case.id)}</td><td>{case.level.value}</td>"
        f"<td>{_title(case.title)}{reason}<span class='note'>{_text(case.clause)}</span></td>"
        f"<td class='{'weak' if weak else _CLASSES[one.outcome]}'>{_text(one.outcome.value)}</td>"
        f"<td>{one.took_us / 1e6:.1f} s</td></tr>"
    )
