"""Records when this machine stalled, so that stamps of that time are not trusted. Shell.

    python -m sightline.evaluation.faults.sampler FILE

A separate process at the priority of the simulation's receiving thread. One line per hole: `from_us,to_us`.
"""

import os
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final, NamedTuple

from sightline.protocol.clock import monotonic_us

PERIOD_S: Final = 0.005
STALL_US: Final = 20_000


class Hole(NamedTuple):
    """A period in which nothing ran here."""

    from_us: int
    to_us: int


def sample(path: Path) -> None:
    """Wake every 5 ms, forever, and log every pause over 20 ms."""
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    last_us = monotonic_us()
    print("sampling", flush=True)
    while True:
        time.sleep(PERIOD_S)
        woke_us = monotonic_us()
        if woke_us - last_us > STALL_US:
            os.write(file, f"{last_us},{woke_us}\n".encode())
        last_us = woke_us


def read_holes(path: Path) -> list[Hole]:
    """Read all holes so far."""
    return [Hole(*map(int, line.split(","))) for line in path.read_text("ascii").split("\n")[:-1]]


def stalled_us(holes: Iterable[Hole], from_us: int, to_us: int) -> int:
    """Return the longest hole that touches the window, us, or 0."""
    return max((end - start for start, end in holes if start < to_us and end > from_us), default=0)


if __name__ == "__main__":
    sample(Path(sys.argv[1]))
