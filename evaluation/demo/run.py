"""One block on the terminal that shows how a demo goes; one line a second where there is no terminal. Shell."""

import math
import sys
import time
from types import TracebackType
from typing import Final, Protocol, Self

from rich.console import Console
from rich.live import Live
from rich.table import Table

from sightline.operator_side.client.status import millis, twist_text
from sightline.protocol.messages import Status
from sightline.sim.truth import Truth

REFRESH_S: Final = 0.2
PLAIN_S: Final = 1.0


class Display(Protocol):
    """Shows a run as it goes."""

    def show(self, at_s: float, status: Status | None, truth: Truth) -> None:
        """The newest of everything; called as often as one likes."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


def display(seconds: float, stand_off_m: float) -> Display:
    """A live block on a terminal, else lines; both on stderr, so that stdout stays for the result."""
    console = Console(stderr=True)
    if console.is_terminal:
        return LiveBlock(console, seconds, stand_off_m)
    return PlainLines(stand_off_m)


def rows(status: Status | None, truth: Truth, stand_off_m: float) -> list[tuple[str, str]]:
    """What is shown, as (name, value)."""
    if status is None:
        return [("robot", "not heard yet")]
    return [
        ("state", f"{status.state}: {status.reason}"),
        ("frames", f"{status.stream.fps:.0f} fps, age {millis(status.frame_age_us)}"),
        ("wheels", twist_text(status.applied)),
        ("bearing", f"{math.degrees(truth.bearing_rad):+.1f} deg" + ("" if truth.visible else ", out of sight")),
        ("distance", f"{truth.distance_m:.2f} m, to keep {stand_off_m:.2f} m"),
    ]


class LiveBlock:
    """A table that redraws itself."""

    def __init__(self, console: Console, seconds: float, stand_off_m: float) -> None:
        self._seconds, self._stand_off_m = seconds, stand_off_m
        self._live = Live(console=console, refresh_per_second=1 / REFRESH_S, transient=True)
        self._due_s = 0.0

    def show(self, at_s: float, status: Status | None, truth: Truth) -> None:
        """Redraw if it is time."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + REFRESH_S
        until = f"of {self._seconds:g} s" if self._seconds else "s, Ctrl-C ends it"
        table = Table("following", f"{at_s:.0f} {until}", box=None)
        for row in rows(status, truth, self._stand_off_m):
            table.add_row(*row)
        self._live.update(table)

    def __enter__(self) -> Self:
        self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.stop()


class PlainLines:
    """At most one line a second."""

    def __init__(self, stand_off_m: float) -> None:
        self._stand_off_m = stand_off_m
        self._due_s = 0.0

    def show(self, at_s: float, status: Status | None, truth: Truth) -> None:
        """Print a line if it is time."""
        if time.monotonic() < self._due_s:
            return
        self._due_s = time.monotonic() + PLAIN_S
        shown = "  ".join(f"{name} {value}" for name, value in rows(status, truth, self._stand_off_m))
        print(f"{at_s:5.1f} s  {shown}", file=sys.stderr, flush=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass
