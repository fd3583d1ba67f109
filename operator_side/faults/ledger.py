"""What the bench's own processes note while they run, whatever becomes of them: one line per event. Shell (files).

    good,T_US,FRAME_US      a command that the robot should obey was sent, citing the frame captured at FRAME_US
    injected,T_US,0         the fault was done once more
    told,T_US,0             a person's request was sent
"""

import os
from pathlib import Path
from typing import Final

from sightline.evaluation.faults.evidence import SentCommand
from sightline.protocol.clock import monotonic_us

GOOD: Final = "good"
INJECTED: Final = "injected"
REQUESTED: Final = "told"


class EventLog:
    """Appends; a line is in the file when `note` returns."""

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)

    def note(self, kind: str, frame_us: int = 0) -> None:
        """Note one event, now."""
        os.write(self._file, f"{kind},{monotonic_us()},{frame_us}\n".encode())


def read_events(path: Path, kind: str) -> list[SentCommand]:
    """The events of `kind`, oldest first; none while there is no file."""
    if not path.exists():
        return []
    rows = [line.split(",") for line in path.read_text("ascii").split("\n")[:-1]]
    return [SentCommand(int(t), int(frame)) for what, t, frame in rows if what == kind]
