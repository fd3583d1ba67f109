"""Provide each competitor with a camera, a detector and a tally. Shell (a clock)."""

import json
import time
from pathlib import Path
from typing import Protocol

from sightline.protocol.clock import monotonic_us


class Vision(Protocol):
    """Converts images to `linear|angular`."""

    def answer(self, t_us: int, jpeg: bytes, /) -> str:
        """Return the command for an image captured at `t_us`. Raises ValueError for an image without an answer."""
        ...


# A camera for the peers of `bench loop`: recorded images at their pace, stamped when shown. Shell (a clock).
#
# The caller sleeps (`film.next_in_s()`) as its own loop does, in a thread or in a coroutine. Missed
# images are not repeated, as with the folder camera of the robot service.


class RecordedFrames:
    """`fps` images a second, looped."""

    def __init__(self, folder: Path, fps: float) -> None:
        self._jpegs = [path.read_bytes() for path in sorted(folder.glob("*.jpg"))]
        self._interval_s = 1 / fps
        self._due_s = time.monotonic()
        self._shown = 0

    def next_in_s(self) -> float:
        """Return the time until the next image, in s."""
        now_s = time.monotonic()
        self._due_s = max(self._due_s + self._interval_s, now_s)
        return self._due_s - now_s

    def shoot(self) -> tuple[int, bytes]:
        """Return (capture time in microseconds, JPEG)."""
        self._shown += 1
        return time.monotonic_ns() // 1000, self._jpegs[self._shown % len(self._jpegs)]


# The captures of one contestant of `bench loop`, and the time of each result. Shell.  Stored in memory, at the cost of
# an append, and written at the end. All processes of a machine share its monotonic clock.


class Tally:
    """Times in microseconds of the monotonic clock."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._captured_us: list[int] = []
        self._commands_us: list[tuple[int, int]] = []
        self.hot_us: float | None = None
        """Median of one step without pacing, if measured."""

    def capture(self, t_us: int) -> None:
        """Record that an image was captured at `t_us`."""
        self._captured_us.append(t_us)

    def validate(self, t_us: int) -> None:
        """Record that the answer to the image of `t_us` is parsed and ready for the motors."""
        self._commands_us.append((t_us, monotonic_us()))
        if len(self._commands_us) == 1:
            print("first answer", flush=True)

    def save(self) -> None:
        """Write everything to the file."""
        record = {"captured_us": self._captured_us, "commands_us": self._commands_us, "hot_us": self.hot_us}
        self._path.write_text(json.dumps(record))
