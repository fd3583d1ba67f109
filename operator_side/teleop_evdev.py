"""A gamepad through Linux's input devices, for `sightline teleop --gamepad`. Shell."""

from __future__ import annotations

from typing import Any, Final

from sightline.operator_side.preflight import needs
from sightline.operator_side.teleop.gamepad import ABS_RX, ABS_X, ABS_Y, BTN_SOUTH, BTN_TL, EV_ABS, EV_KEY, Pad, PadKey
from sightline.protocol.errors import HardwareError

_ANY: Final = "auto"


class Gamepad:
    """An open device; `fileno` for `select`."""

    def __init__(self, path: str) -> None:
        """Open `path`, or the first gamepad for "auto". Raises HardwareError, and ConfigError without evdev."""
        with needs("gamepad"):
            import evdev
        self._device: Any = _first(evdev) if path == _ANY else _opened(evdev, path)
        axes = dict(self._device.capabilities(absinfo=True).get(EV_ABS, []))
        if ABS_Y not in axes:
            raise HardwareError(f"{self._device.path} ({self._device.name}) has no stick; is it a gamepad?")
        self.name: str = self._device.name
        known = (ABS_X, ABS_Y, ABS_RX)
        self.pad = Pad({code: (info.min, info.max) for code, info in axes.items() if code in known})

    def fileno(self) -> int:
        """For `select`."""
        return int(self._device.fd)

    def read(self) -> list[PadKey]:
        """Take what has come. Raises HardwareError when the pad is gone."""
        try:
            events = [(one.type, one.code, one.value) for one in self._device.read()]
        except BlockingIOError:
            return []
        except OSError as error:
            raise HardwareError(f"gamepad {self.name}: {error.strerror}; the robot was told to stand still") from None
        return [key for event in events if (key := self.pad.on_event(*event)) is not None]

    def close(self) -> None:
        """Give it back."""
        self._device.close()


def _opened(evdev: Any, path: str) -> Any:
    try:
        return evdev.InputDevice(path)
    except OSError as error:
        raise HardwareError(f"gamepad {path}: {error.strerror}; its user must be in the group input") from None


def _first(evdev: Any) -> Any:
    for path in sorted(evdev.list_devices()):
        device = _opened(evdev, path)
        if {BTN_SOUTH, BTN_TL} <= set(device.capabilities().get(EV_KEY, [])):
            return device
        device.close()
    raise HardwareError("no gamepad is found among /dev/input/event*: plug it in, and be in the group input")
