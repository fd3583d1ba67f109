"""One process of one peer: `python -m sightline.benchmarks.peers NAME ROLE SETTINGS`. Shell.

ROLE is robot, vision or (the floor) alone; SETTINGS is JSON. It runs until SIGTERM and then writes its tally.
"""

import importlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Final

from sightline.benchmarks.peers.contest import RecordedFrames, Tally, Vision

_RETRY_S: Final = 0.1
_ZENOH: Final = ("callback", "ring", "newest")
"""Peers of one module; each is named for its vision function."""


def main(name: str, role: str, settings: dict[str, Any]) -> None:
    """Play `role` of peer `name`."""
    module, vision = ("zenoh_peers", name) if name in _ZENOH else (name, "vision")
    play = _part(importlib.import_module(f"sightline.benchmarks.peers.{module}"), role, vision, settings)
    while True:
        try:
            play()
        except ConnectionRefusedError:  # the listener may start later
            time.sleep(_RETRY_S)


def _part(peer: ModuleType, role: str, vision: str, settings: dict[str, Any]) -> Callable[[], None]:
    if role == "vision":
        signal.signal(signal.SIGTERM, lambda *_: os._exit(0))
        return partial(getattr(peer, vision), _vision(settings), settings["port"])
    tally, film = Tally(Path(settings["tally"])), RecordedFrames(Path(settings["pictures"]), settings["fps"])
    signal.signal(signal.SIGTERM, lambda *_: _end(tally))
    if role == "alone":
        slow = settings["delay_ms"] or settings["busy_ms"]
        return partial(peer.alone, film, _vision(settings), tally, hot=not slow)
    return partial(peer.robot, film, tally, settings["port"])


def _vision(settings: dict[str, Any]) -> Vision:
    """Import and build the detector only where it is needed, because the imports are large."""
    if settings["vision"] == "legacy":
        from sightline.benchmarks.peers.classic_detector import ClassicVision

        return ClassicVision(settings["delay_ms"], settings["busy_ms"])
    from sightline.benchmarks.loop.vision import PipelineVision as OurVision

    return OurVision(settings["width_px"], settings["height_px"], settings["delay_ms"], settings["busy_ms"])


def _end(tally: Tally) -> None:
    """Save and exit immediately, regardless of the transport's threads."""
    tally.save()
    os._exit(0)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))
