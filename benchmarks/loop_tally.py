"""What one contestant of `bench loop` captured, and when each answer was judged. Shell.

Kept in memory, at the cost of an append, and written at the end. All processes of a machine share its monotonic clock.
"""

import json
from pathlib import Path

from sightline.protocol.clock import monotonic_us


class Tally:
    """Times in microseconds of the monotonic clock."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._captured_us: list[int] = []
        self._judged_us: list[tuple[int, int]] = []
        self.hot_us: float | None = None
        """Median of one step without pacing, where it was measured."""

    def capture(self, t_us: int) -> None:
        """A picture was captured at `t_us`."""
        self._captured_us.append(t_us)

    def judge(self, t_us: int) -> None:
        """The answer to the picture of `t_us` is there, parsed and ready for the motors."""
        self._judged_us.append((t_us, monotonic_us()))
        if len(self._judged_us) == 1:
            print("first answer", flush=True)

    def save(self) -> None:
        """Write everything to the file."""
        record = {"captured_us": self._captured_us, "judged_us": self._judged_us, "hot_us": self.hot_us}
        self._path.write_text(json.dumps(record))
