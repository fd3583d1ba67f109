"""A Raspberry Pi's output pins through gpiozero and lgpio: PWM, enable lines, and how they are left behind. Shell.

Both libraries are imported when the pins are opened; the robot's base install has neither.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.robot_side.hardware.gpio_low import import_lgpio, leave_low

_SPI_DEVICE: Final = Path("/dev/spidev0.0")
_SPI_PINS: Final = frozenset(range(7, 12))
_INSTALL: Final = "pip install 'sightline[robot-pi]', or sudo apt install python3-gpiozero python3-lgpio"


class Pins(Protocol):
    """Output pins by BCM number. All methods may raise whatever the library raises."""

    def write(self, number: int, duty: float) -> None:
        """Drive a pin high for that share (0..1) of each PWM period."""
        ...

    def enable(self, wanted: bool) -> None:
        """The enable lines high or low, where there are any."""
        ...

    def close(self) -> None:
        """All low, then given back."""
        ...


class WiredPins(Protocol):
    """What is asked of a configuration here."""

    @property
    def pins(self) -> tuple[int, int, int, int]: ...
    @property
    def enable_pins(self) -> tuple[int, ...]: ...
    @property
    def pwm_hz(self) -> int: ...


def open_pins(config: WiredPins) -> Pins:
    """All pins low.

    Raises ConfigError without gpiozero or lgpio, HardwareError where the pins cannot be had.
    """
    _warn_of_spi(config.pins)
    try:
        import gpiozero
    except ImportError:
        raise ConfigError(f"drive gpio needs gpiozero: {_INSTALL}") from None
    made = _ensure_factory(gpiozero)
    try:
        return GpiozeroPins(gpiozero, config, made)
    except Exception as error:
        raise HardwareError(
            f"GPIO pins cannot be opened: {_line(error)}; does another program hold them (a robot service, SPI)?"
        ) from None


class GpiozeroPins:
    """`made`: whether the pin factory is ours to close."""

    def __init__(self, gpiozero: Any, config: WiredPins, made: bool) -> None:
        self._device_class, self._made = gpiozero.Device, made
        self._numbers = (*config.enable_pins, *config.pins)
        self._enables: list[Any] = []
        self._motors: dict[int, Any] = {}
        try:
            # gpiozero's Motor takes no frequency, so each pin is a device of its own.
            for number in config.enable_pins:
                self._enables.append(gpiozero.DigitalOutputDevice(number))
            for number in config.pins:
                self._motors[number] = gpiozero.PWMOutputDevice(number, frequency=config.pwm_hz)
        except Exception:
            self.close()
            raise

    def write(self, number: int, duty: float) -> None:
        """Drive a pin high for that share of each PWM period."""
        self._motors[number].value = duty

    def enable(self, wanted: bool) -> None:
        """The enable lines high or low."""
        for device in self._enables:
            device.value = int(wanted)

    def close(self) -> None:
        """Enable lines first, then the motors' pins; idempotent."""
        for device in (*self._enables, *self._motors.values()):
            with suppress(Exception):  # the rest still has to go down
                device.value = 0
        for device in (*self._enables, *self._motors.values()):
            with suppress(Exception):
                device.close()
        self._enables, self._motors = [], {}
        if self._made:
            self._made = False
            self._give_back()

    def _give_back(self) -> None:
        """gpiozero leaves pins as inputs without a pull, and an L298N takes a floating input for high."""
        factory, self._device_class.pin_factory = self._device_class.pin_factory, None
        chip = getattr(factory, "chip", None)
        with suppress(Exception):
            factory.close()
        if chip is not None:
            with suppress(Exception):
                leave_low(self._numbers, chip)


def _ensure_factory(gpiozero: Any) -> bool:
    """lgpio, unless GPIOZERO_PIN_FACTORY or the program chose another; gpiozero's own fall-backs have no PWM."""
    device = gpiozero.Device
    if device.pin_factory is not None:
        return False
    if os.environ.get("GPIOZERO_PIN_FACTORY"):
        device.ensure_pin_factory()
        return True
    try:
        import_lgpio()
        from gpiozero.pins.lgpio import LGPIOFactory

        device.pin_factory = LGPIOFactory()
    except ImportError:
        raise ConfigError(f"drive gpio needs lgpio: {_INSTALL}") from None
    except Exception as error:
        raise HardwareError(
            f"no GPIO here: {_line(error)}; this drive needs a Raspberry Pi and a user in the group gpio "
            "(`--set drive.kind=log` tries the rest without wheels)"
        ) from None
    return True


def _warn_of_spi(numbers: Sequence[int]) -> None:
    used = sorted(_SPI_PINS.intersection(numbers))
    if used and _SPI_DEVICE.exists():
        named = ", ".join(map(str, used))
        print(
            f"drive gpio: pins {named} are SPI0's and SPI is switched on ({_SPI_DEVICE}): switch it off "
            "(`sudo raspi-config nonint do_spi 1`, restart) or use other pins",
            file=sys.stderr, flush=True,
        )  # fmt: skip


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
