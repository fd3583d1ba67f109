"""The report of a run as one HTML file that a person can read, without a network or another file. Pure."""

from collections.abc import Sequence
from html import escape
from itertools import groupby
from typing import Final

from sightline.conformance.case import Level
from sightline.conformance.report import summary
from sightline.conformance.runner import Outcome, Result, passed, printable

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
