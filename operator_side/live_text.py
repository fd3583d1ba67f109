"""Lines on the terminal that are shown anew in place; one block a second where there is no terminal. Shell."""

import sys
import time
from collections.abc import Sequence
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.live import Live
from rich.text import Text

PLAIN_S: Final = 1.0


class LiveText:
    """`with LiveText() as live: live.show(lines)`."""

    def __init__(self) -> None:
        console = Console()
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._due_s = 0.0

    def show(self, lines: Sequence[str]) -> None:
        """The newest; called as often as one likes."""
        if self._live is not None:
            self._live.update(Text("\n".join(lines), no_wrap=True, overflow="ellipsis"), refresh=True)
        elif time.monotonic() >= self._due_s:
            self._due_s = time.monotonic() + PLAIN_S
            print("\n".join(lines) + "\n", file=sys.stdout, flush=True)

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()
