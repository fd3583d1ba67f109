"""Prints tables and blocks of lines with aligned columns, and colors for states. Shell (a terminal).

The output does not depend on the width of the terminal, so a script reads the same lines as an operator.
"""

import os
import re
import sys
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import Final, TextIO

from sightline.protocol.log import printable

_GREEN, _YELLOW, _RED = "32", "33", "31"
_COLORS: Final = {
    "ACTIVE": _GREEN, "DEGRADED": _YELLOW, "HOLD": _YELLOW, "DISARMED": _YELLOW, "STOPPED": _RED, "FAULT": _RED,
    "passed": _GREEN, "FAILED": _RED, "FAIL": _RED, "BAD": _RED,
}  # fmt: skip
_COLORED: Final = re.compile(rf"\b({'|'.join(_COLORS)})\b")


def table_lines(rows: Iterable[Sequence[str]]) -> list[str]:
    """Format rows as lines with two spaces between columns. The last cell of a row does not widen its column."""
    rows = [tuple(row) for row in rows]
    widths = [max(map(len, column)) for column in zip_longest(*(row[:-1] for row in rows), fillvalue="")]
    padded = ([*(f"{cell:<{width}}" for cell, width in zip(row[:-1], widths, strict=False)), *row[-1:]] for row in rows)
    return ["  ".join(cells).rstrip() for cells in padded]


def print_table(rows: Iterable[Sequence[str]]) -> None:
    """Print rows of cells on stdout."""
    print_block(table_lines(rows))


def print_block(lines: Iterable[str]) -> None:
    """Print lines on stdout, with colors for states on a terminal."""
    text = "\n".join(map(printable, lines))  # a peer may have written a part of the lines
    print(colored(text) if uses_color(sys.stdout) else text, flush=True)


def colored(text: str) -> str:
    """Return `text` with ANSI colors for the names of states and results."""
    return _COLORED.sub(lambda found: f"\x1b[{_COLORS[found[1]]}m{found[1]}\x1b[0m", text)


def uses_color(stream: TextIO | None) -> bool:
    """Return True if colors may be written: to a terminal, unless NO_COLOR is set (https://no-color.org)."""
    is_terminal = stream is not None and stream.isatty()  # None means a closed output
    return is_terminal and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
