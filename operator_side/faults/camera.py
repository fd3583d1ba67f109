"""The simulated camera, made to fail: a camera plug-in that does what the file `mode` in its folder names. Shell.

Every picture that was spoiled is noted in `camera.ledger` beside it.
"""

import ctypes
import time
from dataclasses import replace
from pathlib import Path
from typing import Final

from operator_side.faults.ledger import INJECTED, Ledger
from protocol.errors import HardwareError
from robot_side.ports import Picture
from sim.bus import SimCamera, SimSocketConfig

MODE: Final = "camera.mode"
LEDGER: Final = "camera.ledger"
GIL_HELD_S: Final = 1
SLOW_S: Final = 0.2
_SOF0: Final = b"\xff\xc0\x00\x11\x08"


class FaultyCamera:
    """A `Camera`. Modes: gil, unplugged, frozen, black, slow, bomb, resized; anything else leaves it as it is."""

    class Config(SimSocketConfig):
        """`folder` holds the mode and the ledger."""

        folder: Path

    def __init__(self, config: Config) -> None:
        self._camera = SimCamera(SimSocketConfig(socket_dir=config.socket_dir))
        self.model = self._camera.model
        self._mode = config.folder / MODE
        self._ledger = Ledger(config.folder / LEDGER)
        self._last: Picture | None = None
        self._held = False

    def read(self, timeout_s: float) -> Picture | None:
        """As `Camera` says, after what the mode does."""
        mode = self._mode.read_text("ascii") if self._mode.exists() else ""
        picture = self._camera.read(timeout_s)
        if picture is None or mode not in FAULTS:
            self._last = picture or self._last
            return picture
        if mode == "gil" and self._held:
            return picture
        self._held = mode == "gil"
        self._ledger.note(INJECTED)
        return FAULTS[mode](picture, self._last or picture)

    def close(self) -> None:
        """As `Camera` says."""
        self._camera.close()


def _hold_gil(now: Picture, _last: Picture) -> Picture:
    ctypes.PyDLL(None).sleep(GIL_HELD_S)  # PyDLL does not let go of the interpreter's lock
    return now


def _unplugged(_now: Picture, _last: Picture) -> Picture:
    raise HardwareError("the camera is unplugged, as the bench told it to be; plug it in again")


def _frozen(now: Picture, last: Picture) -> Picture:
    return replace(now, jpeg=last.jpeg)


def _slow(now: Picture, _last: Picture) -> Picture:
    time.sleep(SLOW_S)
    return now


def _black(now: Picture, _last: Picture) -> Picture:
    return replace(now, jpeg=_picture(320, 240))


def _resized(now: Picture, _last: Picture) -> Picture:
    return replace(now, jpeg=_picture(160, 120))


def _bomb(now: Picture, _last: Picture) -> Picture:
    """A small file that claims 65500 x 65500 pixels: its decoder would fill the memory."""
    jpeg = _picture(64, 64)
    at = jpeg.index(_SOF0) + len(_SOF0)
    return replace(now, jpeg=jpeg[:at] + b"\xff\xdc\xff\xdc" + jpeg[at + 4 :])


def _picture(width_px: int, height_px: int) -> bytes:
    import cv2
    import numpy as np

    return bytes(cv2.imencode(".jpg", np.zeros((height_px, width_px, 3), np.uint8))[1])


FAULTS: Final = {
    "gil": _hold_gil, "unplugged": _unplugged, "frozen": _frozen, "slow": _slow, "black": _black, "bomb": _bomb,
    "resized": _resized,
}
