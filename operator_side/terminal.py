"""Live output of commands: lines that redraw in place, and a progress bar. Shell (a terminal)."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from sightline.operator_side.table import colored, uses_color
from sightline.protocol.log import printable

_REFRESH_S: Final = 0.2
_PLAIN_S: Final = 1.0


class LiveBlock:
    """Shows lines in place: `with LiveBlock() as live: live.show(lines)`. Without a terminal it prints once a second.

    Args:
        is_progress: write to stderr, because stdout is for the result. Remove the block at the end. Without a terminal,
            print one line each time.
    """

    def __init__(self, is_progress: bool = False) -> None:
        console = Console(stderr=is_progress)
        self._stream = sys.stderr if is_progress else sys.stdout
        self._is_progress, self._due_s = is_progress, 0.0
        redraws = console.is_terminal and not console.is_dumb_terminal
        self._live = Live(console=console, auto_refresh=False, transient=is_progress) if redraws else None

    def show(self, lines: Sequence[str]) -> None:
        """Show the newest lines. Calls that come too often are skipped."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + (_PLAIN_S if self._live is None else _REFRESH_S)
        lines = [printable(line) for line in lines]
        if self._live is not None:
            self._live.update(self._text("\n".join(lines)), refresh=True)
        elif self._is_progress:
            print("  ".join(lines), file=sys.stderr, flush=True)
        else:
            print("\n".join(lines) + "\n", flush=True)

    def _text(self, block: str) -> Text:
        return Text.from_ansi(colored(block) if uses_color(self._stream) else block, no_wrap=True, overflow="ellipsis")

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()


@contextmanager
def progress_bar(total: int, what: str = "runs") -> Iterator[Callable[..., None]]:
    """Show a progress bar in this context, if stderr is a terminal. Yields `advance(steps=1)`."""
    console = Console(stderr=True)
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=total)
        yield lambda steps=1: bar.advance(task, steps)
