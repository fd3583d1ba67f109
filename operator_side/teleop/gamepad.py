"""What a gamepad means to `sightline teleop`: sticks to shares of the speeds, a dead man's button. Pure.

Codes are those of the Linux input layer (linux/input-event-codes.h), which pads of all makers follow.
"""

from dataclasses import dataclass, field
from enum import Enum
from typing import Final

EV_SYN: Final = 0
EV_KEY: Final = 1
EV_ABS: Final = 3
SYN_DROPPED: Final = 3
"""Events were lost: nobody had read for long. A release may be among them."""
ABS_X, ABS_Y, ABS_RX = 0, 1, 3
BTN_SOUTH, BTN_EAST, BTN_TL, BTN_TR = 0x130, 0x131, 0x136, 0x137
_DEAD_MAN: Final = frozenset((BTN_TL, BTN_TR))
_DEAD_ZONE: Final = 0.12
"""Sticks rarely return to their exact middle."""


class PadKey(Enum):
    """Buttons that act when pressed."""

    STOP = "stop"
    HAND_OVER = "hand over"


_BUTTONS: Final = {BTN_EAST: PadKey.STOP, BTN_SOUTH: PadKey.HAND_OVER}


@dataclass(slots=True)
class Pad:
    """Left stick: forward and back. Either stick sideways: turning. Hold a shoulder button to drive.

    `ranges` are the (least, most) of each axis, as the device says them.
    """

    ranges: dict[int, tuple[int, int]]
    _axes: dict[int, float] = field(default_factory=dict)
    _held: set[int] = field(default_factory=set)
    _stopped: bool = False

    def on_event(self, kind: int, code: int, value: int) -> PadKey | None:
        """Take one event; a button that acts is returned. STOP also asks for the shoulder button anew."""
        if kind == EV_ABS and code in self.ranges:
            self._axes[code] = self._share(code, value)
        elif (kind, code) == (EV_SYN, SYN_DROPPED):
            self._held.clear()
            self._axes.clear()
            self._stopped = False
        elif kind == EV_KEY and code in _DEAD_MAN:
            (self._held.add if value else self._held.discard)(code)
            self._stopped &= bool(self._held)
        elif kind == EV_KEY and value == 1 and code in _BUTTONS:
            self._stopped = bool(self._held)
            return _BUTTONS[code]
        return None

    @property
    def shares(self) -> tuple[float, float] | None:
        """(linear, angular) shares, -1..1; None while no shoulder button is held. Stick left turns left."""
        if not self._held or self._stopped:
            return None
        sideways = [self._axes.get(code, 0.0) for code in (ABS_X, ABS_RX)]
        return -self._axes.get(ABS_Y, 0.0), -max(sideways, key=abs)

    def _share(self, code: int, value: int) -> float:
        least, most = self.ranges[code]
        share = max(-1.0, min(1.0, (2 * value - least - most) / max(1, most - least)))
        if abs(share) < _DEAD_ZONE:
            return 0.0
        return (abs(share) - _DEAD_ZONE) / (1 - _DEAD_ZONE) * (1 if share > 0 else -1)
