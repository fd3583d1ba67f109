"""A camera for the peers of `bench loop`: the recorded pictures at their pace, stamped when shown. Shell (a clock).

The caller sleeps itself (`film.next_in_s()`), as its own loop does: a thread's sleep or a coroutine's. Pictures that
nobody came for in time are not made up for, as with the folder camera of the robot service.
"""

import time
from pathlib import Path


class Film:
    """`fps` pictures a second, looped."""

    def __init__(self, folder: Path, fps: float) -> None:
        self._jpegs = [path.read_bytes() for path in sorted(folder.glob("*.jpg"))]
        self._interval_s = 1 / fps
        self._due_s = time.monotonic()
        self._shown = 0

    def next_in_s(self) -> float:
        """How long to sleep until the next picture."""
        now_s = time.monotonic()
        self._due_s = max(self._due_s + self._interval_s, now_s)
        return self._due_s - now_s

    def shoot(self) -> tuple[int, bytes]:
        """(capture time in microseconds, JPEG)."""
        self._shown += 1
        return time.monotonic_ns() // 1000, self._jpegs[self._shown % len(self._jpegs)]
