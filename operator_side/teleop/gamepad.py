"""Reads a gamepad with a dead man's button from a Linux input device, as shares of the speeds. Shell.

Source of the codes: linux/input-event-codes.h, which all gamepads use.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final

from sightline.operator_side.preflight import needs
from sightline.protocol.errors import HardwareError

EV_SYN: Final = 0
EV_KEY: Final = 1
EV_ABS: Final = 3
SYN_REPORT: Final = 0
SYN_DROPPED: Final = 3
"""The kernel dropped events because the reader was slow. A release may be among them. The events up to the next
SYN_REPORT are incomplete, and the state of the device must be read again.

Source: Linux kernel, Documentation/input/event-codes.rst.
"""
ABS_X, ABS_Y, ABS_RX = 0, 1, 3
BTN_SOUTH, BTN_EAST, BTN_TL, BTN_TR = 0x130, 0x131, 0x136, 0x137
_DEAD_MAN: Final = frozenset((BTN_TL, BTN_TR))
_DEAD_ZONE: Final = 0.12
"""Share of the axis around the center that counts as zero, because sticks rarely return to their exact center."""


class PadKey(Enum):
    """Buttons with an action when pressed."""

    STOP = "stop"
    HAND_OVER = "hand over"


_BUTTONS: Final = {BTN_EAST: PadKey.STOP, BTN_SOUTH: PadKey.HAND_OVER}


@dataclass(slots=True)
class Pad:
    """Left stick: forward and back. Either stick sideways: turning. Hold a shoulder button to drive.

    A stick that is pushed when the button is pressed drives only after both sticks were at their centers.
    `ranges` are the (least, most) values of each axis, from the device.
    """

    ranges: dict[int, tuple[int, int]]
    _axes: dict[int, float] = field(default_factory=dict)
    _held: set[int] = field(default_factory=set)
    _stopped: bool = False
    _was_centered: bool = False
    """True if the sticks were at their centers since a shoulder button was pressed."""
    is_lost: bool = False
    """True from SYN_DROPPED until `on_state`. Meanwhile only STOP acts."""

    def on_event(self, kind: int, code: int, value: int) -> PadKey | None:
        """Process one event. Returns a button with an action. After STOP, a shoulder button must be pressed again."""
        if (kind, code) == (EV_SYN, SYN_DROPPED):
            self._held.clear()
            self._stopped, self.is_lost = False, True
        elif self.is_lost:
            return PadKey.STOP if (kind, code, value) == (EV_KEY, BTN_EAST, 1) else None
        elif kind == EV_ABS and code in self.ranges:
            self._axes[code] = self._share(code, value)
        elif kind == EV_KEY and code in _DEAD_MAN:
            (self._held.add if value else self._held.discard)(code)
            self._stopped &= bool(self._held)
        elif kind == EV_KEY and value == 1 and code in _BUTTONS:
            self._stopped = bool(self._held)
            return _BUTTONS[code]
        self._was_centered = bool(self._held) and (self._was_centered or self._position == (0.0, 0.0))
        return None

    def on_state(self, axes: Mapping[int, int], keys: Iterable[int] = ()) -> PadKey | None:
        """Process the present values of the axes and the pressed keys. A shoulder button must be pressed again.

        ABS_RX counts after its first event, because it is a trigger of some gamepads, which is never at a center.
        """
        self.is_lost = False
        for code, value in axes.items():
            if code != ABS_RX or code in self._axes:
                self.on_event(EV_ABS, code, value)
        return PadKey.STOP if BTN_EAST in keys else None

    @property
    def shares(self) -> tuple[float, float] | None:
        """Return (linear, angular) shares, -1..1, or None while no shoulder button is held. Stick left turns left."""
        if not self._held or self._stopped:
            return None
        return self._position if self._was_centered else (0.0, 0.0)

    @property
    def _position(self) -> tuple[float, float]:
        sideways = [self._axes.get(code, 0.0) for code in (ABS_X, ABS_RX)]
        return -self._axes.get(ABS_Y, 0.0), -max(sideways, key=abs)

    def _share(self, code: int, value: int) -> float:
        least, most = self.ranges[code]
        share = max(-1.0, min(1.0, (2 * value - least - most) / max(1, most - least)))
        if abs(share) < _DEAD_ZONE:
            return 0.0
        return (abs(share) - _DEAD_ZONE) / (1 - _DEAD_ZONE) * (1 if share > 0 else -1)


# --- the device, for `sightline teleop --gamepad` ----------------------------------------------------------------


_ANY: Final = "auto"


class Gamepad:
    """An open input device; `fileno` is for `select`."""

    def __init__(self, path: str) -> None:
        """Open `path`, or the first gamepad for "auto". Raises HardwareError, and ConfigError without evdev."""
        with needs("gamepad"):
            import evdev
        self._device: Any = _first(evdev) if path == _ANY else _opened(evdev, path)
        axes = dict(self._device.capabilities(absinfo=True).get(EV_ABS, []))
        if ABS_Y not in axes:
            raise HardwareError(f"{self._device.path} ({self._device.name}) has no stick; name a gamepad")
        self.name: str = self._device.name
        known = {code: axes[code] for code in (ABS_X, ABS_Y, ABS_RX) if code in axes}
        self.pad = Pad({code: (info.min, info.max) for code, info in known.items()})
        self.pad.on_state({code: info.value for code, info in known.items()})  # the device reports changes only

    def fileno(self) -> int:
        """Return the descriptor, for `select`."""
        return int(self._device.fd)

    def read(self) -> list[PadKey]:
        """Process the waiting events. Raises HardwareError if the gamepad is gone."""
        try:
            events = [(one.type, one.code, one.value) for one in self._device.read()]
            keys = [self.pad.on_event(*event) for event in events]
            if self.pad.is_lost and events[-1][:2] == (EV_SYN, SYN_REPORT):
                keys.append(self._read_state())
        except BlockingIOError:
            return []
        except OSError as error:
            raise HardwareError(
                f"gamepad {self.name}: {error.strerror}; the robot stops, connect the gamepad again"
            ) from None
        return [key for key in keys if key is not None]

    def _read_state(self) -> PadKey | None:
        """Read axes and keys after lost events.

        This is done after all events that were read, because EVIOCGKEY also removes waiting key events, and an older
        press must not outlive its release.
        """
        keys = self._device.active_keys()
        return self.pad.on_state({code: self._device.absinfo(code).value for code in self.pad.ranges}, keys)

    def close(self) -> None:
        """Close the device."""
        self._device.close()


def _opened(evdev: Any, path: str) -> Any:
    try:
        return evdev.InputDevice(path)
    except OSError as error:
        fix = ("add your user to the group input" if isinstance(error, PermissionError)
               else "connect it, or take the first gamepad with --gamepad auto")
        raise HardwareError(f"gamepad {path}: {error.strerror}; {fix}") from None


def _first(evdev: Any) -> Any:
    for path in sorted(evdev.list_devices()):
        device = _opened(evdev, path)
        if {BTN_SOUTH, BTN_TL} <= set(device.capabilities().get(EV_KEY, [])):
            return device
        device.close()
    raise HardwareError("no gamepad found in /dev/input/event*; connect it, and add your user to the group input")
