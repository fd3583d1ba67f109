"""A process of the bench that speaks to the robot: vision itself, a driver by script, or a person. Shell.

    python -m sightline.evaluation.faults.peer OPTIONS_AS_JSON

It does its part until SIGUSR1, and from then on what `fault` names.
"""

import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Literal

from sightline.operator_side.faults.ledger import EventLog
from sightline.protocol.config import Config

Role = Literal["vision", "driver", "operator"]


class PeerOptions(Config):
    """What one peer is to do."""

    role: Role
    endpoint: str
    ledger: Path
    robot: str = "r1"
    source: str = "vision"
    """The role that a scripted driver takes on the wire."""
    fault: str = ""
    config: Path | None = None
    """Vision's own configuration file."""
    linear_mps: float = 0.5
    angular_rad_s: float = 0.4
    recording: Path | None = None
    """A driver writes what it sent here; a replay reads it."""
    seconds: float | None = None
    """End by itself after this long."""


class Trigger:
    """Set by SIGUSR1."""

    def __init__(self) -> None:
        self.pulled = threading.Event()
        signal.signal(signal.SIGUSR1, self._pull)

    def _pull(self, _number: int, _frame: FrameType | None) -> None:
        self.pulled.set()


def main() -> int:
    """Run one peer; returns its exit code."""
    options = PeerOptions.model_validate_json(sys.argv[1])
    trigger, ledger = Trigger(), EventLog(options.ledger)
    return _entry(options.role)(options, trigger.pulled, ledger)


def _entry(role: Role) -> Callable[[PeerOptions, threading.Event, EventLog], int]:
    """Imported late: only vision needs OpenCV."""
    if role == "vision":
        from sightline.operator_side.faults.vision import run_vision

        return run_vision
    if role == "driver":
        from sightline.operator_side.faults.driver import run_driver

        return run_driver
    from sightline.operator_side.faults.person import run_operator

    return run_operator


if __name__ == "__main__":
    sys.exit(main())
