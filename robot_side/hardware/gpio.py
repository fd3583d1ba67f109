"""Two motors on an H-bridge at the pins of a Raspberry Pi: drive, pins, duty table. Shell.

`sightline calibrate drive` writes the file; `drive.options.table_file` of the drive `gpio` names it.
"""

from __future__ import annotations

import itertools
import logging
import math
import os
import time
import tomllib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Protocol, Self

from pydantic import Field, ValidationError, field_validator, model_validator

from sightline.protocol.clock import monotonic_us
from sightline.protocol.config import Config, file_text, first_problem
from sightline.protocol.errors import ConfigError, HardwareError, install_command
from sightline.robot_side.hardware.gpio_low import import_lgpio, leave_low, zero
from sightline.robot_side.ports import WheelAngles

_log: Final = logging.getLogger(__name__)

Duty = Annotated[float, Field(gt=0, le=1)]
RimSpeed = Annotated[float, Field(gt=0, le=3)]
Rows = Annotated[tuple[tuple[Duty, RimSpeed], ...], Field(min_length=1, max_length=32)]

GUESSED_ROWS = ((0.40, 0.08), (0.60, 0.12), (1.00, 0.19))
"""Guess for an uncalibrated car: 60 rpm at 6 V (the motors of the legacy article), about 2 V lost in an L298N at 7.4 V,
65 mm wheels, and no motion below the 40 % at which the legacy program turned."""


class TableConfig(Config):
    """Rows of (duty, m/s at the rim), both rising. The first row is the least duty that turns a wheel."""

    table: Rows = GUESSED_ROWS

    @field_validator("table")
    @classmethod
    def _rises(cls, rows: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for (duty, speed), (more_duty, more_speed) in itertools.pairwise(rows):
            if more_duty <= duty or more_speed <= speed:
                raise ValueError(f"[{more_duty:g}, {more_speed:g}] after [{duty:g}, {speed:g}]: both must rise")
        return rows


class _TableFile(TableConfig):
    """A table file must have a table. An empty one must not stand for the guessed rows."""

    table: Rows


class DutyTable:
    """Interpolates linearly between the rows. A faster speed than the last row gets the duty of the last row."""

    def __init__(self, rows: Sequence[tuple[float, float]]) -> None:
        self._rows = tuple(rows)

    def duty(self, speed_mps: float) -> float:
        """Return the duty (-1..1) for a speed, m/s.

        Because of static friction it is 0 below half the least speed, and the least duty from there to the least speed.
        """
        least_duty, least_mps = self._rows[0]
        wanted_mps = abs(speed_mps)
        if wanted_mps < least_mps / 2:
            return 0.0
        return _signed(_between([(mps, duty) for duty, mps in self._rows], wanted_mps, least_duty), speed_mps)

    def speed(self, duty: float) -> float:
        """Return the speed of a duty by the table, m/s; 0 below the least duty."""
        given = abs(duty)
        return 0.0 if given < self._rows[0][0] else _signed(_between(self._rows, given, self._rows[0][1]), duty)


def _between(rows: Sequence[tuple[float, float]], at: float, below: float) -> float:
    if at <= rows[0][0]:
        return below
    for (x, y), (next_x, next_y) in itertools.pairwise(rows):
        if at <= next_x:
            return min(y + (next_y - y) * (at - x) / (next_x - x), next_y)  # rounding may exceed 1
    return rows[-1][1]


def _signed(value: float, like: float) -> float:
    return -value if like < 0 else value


def table_of(text: str, where: str) -> tuple[tuple[float, float], ...]:
    """Read the rows of a table file. Raises ConfigError that names `where` and the invalid value."""
    try:
        return _TableFile.model_validate(tomllib.loads(text)).table
    except ValidationError as error:
        problem = first_problem(error, known=TableConfig.model_fields)
        raise ConfigError(f"{where}: {problem}; rows are [duty, m/s], e.g. [0.4, 0.08]") from None
    except (ValueError, RecursionError) as error:  # also for a number with too many digits
        raise ConfigError(f"{where}: invalid TOML: {error}") from None


def table_text(rows: Sequence[tuple[float, float]], head: str) -> str:
    """Format a table file with `head` as its comment. `table_of` reads it."""
    lines = "".join(f"  [{duty:.3f}, {speed:.4f}],\n" for duty, speed in rows)
    return f"# {head}\ntable = [ # duty, meters per second at the rim\n{lines}]\n"


# Output pins of a Raspberry Pi through gpiozero and lgpio: PWM, enable lines, and their state at the end. Shell.
#
# Both libraries are imported when the pins are opened, because the base install has neither.


_SPI_DEVICE: Final = Path("/dev/spidev0.0")
_SPI_PINS: Final = frozenset(range(7, 12))
_FROM_APT: Final = "or sudo apt install python3-gpiozero python3-lgpio"


class Pins(Protocol):
    """Output pins by BCM number. All methods may raise any error of the library."""

    def write(self, number: int, duty: float) -> None:
        """Drive a pin high for the share `duty` (0..1) of each PWM period."""
        ...

    def enable(self, wanted: bool) -> None:
        """Set the enable lines, if there are any, high or low."""
        ...

    def pulse(self) -> None:
        """Change the level of the pulse pin, if there is one."""
        ...

    def close(self) -> None:
        """Set all pins low and release them."""
        ...


class WiredPins(Protocol):
    """A configuration that names the pins."""

    @property
    def pins(self) -> tuple[int, int, int, int]: ...
    @property
    def enable_pins(self) -> tuple[int, ...]: ...
    @property
    def pulse_pin(self) -> int | None: ...
    @property
    def pwm_hz(self) -> int: ...


def open_pins(config: WiredPins) -> Pins:
    """Open the pins, all low.

    Raises ConfigError without gpiozero or lgpio, HardwareError if the pins are not available.
    """
    _warn_of_spi(config.pins)
    try:
        import gpiozero
    except ImportError:
        raise ConfigError(f"drive gpio needs gpiozero: {install_command('robot-pi')}, {_FROM_APT}") from None
    made = _ensure_factory(gpiozero)
    try:
        return GpiozeroPins(gpiozero, config, made)
    except Exception as error:
        raise HardwareError(
            f"GPIO pins cannot be opened: {_line(error)}; does another program hold them (a robot service, SPI)?"
        ) from None


class GpiozeroPins:
    """`made`: True if this object created the pin factory and must close it."""

    def __init__(self, gpiozero: Any, config: WiredPins, made: bool) -> None:
        self._device_class, self._made = gpiozero.Device, made
        pulse_pins = () if config.pulse_pin is None else (config.pulse_pin,)
        self._numbers = (*config.enable_pins, *config.pins, *pulse_pins)
        self._enables: list[Any] = []
        self._pulses: list[Any] = []
        self._motors: dict[int, Any] = {}
        try:
            # gpiozero's Motor has no frequency option, so each pin is a separate device.
            for number in config.enable_pins:
                self._enables.append(gpiozero.DigitalOutputDevice(number))
            for number in pulse_pins:
                self._pulses.append(gpiozero.DigitalOutputDevice(number))
            for number in config.pins:
                self._motors[number] = gpiozero.PWMOutputDevice(number, frequency=config.pwm_hz)
        except Exception:
            self.close()
            raise

    def write(self, number: int, duty: float) -> None:
        """Drive a pin high for the share `duty` of each PWM period."""
        self._motors[number].value = duty

    def enable(self, wanted: bool) -> None:
        """Set the enable lines high or low."""
        for device in self._enables:
            device.value = int(wanted)

    def pulse(self) -> None:
        """Change the level of the pulse pin."""
        for device in self._pulses:
            device.toggle()

    def close(self) -> None:
        """Set the enable lines low first, then the pins of the motors, and release them. Idempotent."""
        devices = (*self._enables, *self._motors.values(), *self._pulses)
        for device in devices:
            with suppress(Exception):  # the other pins must be set low, too
                device.value = 0
        for device in devices:
            with suppress(Exception):
                device.close()
        self._enables, self._pulses, self._motors = [], [], {}
        if self._made:
            self._made = False
            self._give_back()

    def _give_back(self) -> None:
        """Close the pin factory. gpiozero leaves pins as floating inputs, which an L298N reads as high."""
        factory, self._device_class.pin_factory = self._device_class.pin_factory, None
        chip = getattr(factory, "chip", None)
        with suppress(Exception):
            factory.close()
        if chip is not None:
            with suppress(Exception):
                leave_low(self._numbers, chip)


def _ensure_factory(gpiozero: Any) -> bool:
    """Create an lgpio factory, unless another one is configured. gpiozero's own fallbacks have no PWM."""
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
        raise ConfigError(f"drive gpio needs lgpio: {install_command('robot-pi')}, {_FROM_APT}") from None
    except Exception as error:
        raise HardwareError(
            f"no GPIO here: {_line(error)}; this drive needs a Raspberry Pi and a user in the group gpio "
            "(`--set drive.kind=log --set drive.options={}` tries the rest without wheels)"
        ) from None
    return True


def _warn_of_spi(numbers: Sequence[int]) -> None:
    used = sorted(_SPI_PINS.intersection(numbers))
    if used and _SPI_DEVICE.exists():
        named = ", ".join(map(str, used))
        _log.warning(
            "drive gpio: pins %s are SPI0's and SPI is switched on (%s): switch it off "
            "(`sudo raspi-config nonint do_spi 1`, restart) or use other pins",
            named, _SPI_DEVICE,
        )  # fmt: skip


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


# Two motors on an H-bridge (L298N) at the pins of a Raspberry Pi: duty by a calibration table, no encoders. Shell.
#
# One pin of a motor is set low before the other one is driven. Every end and every failure sets all pins low.


BcmPin = Annotated[int, Field(ge=2, le=27)]
"""BCM number, not the position on the header. 0 and 1 belong to the memory of add-on boards."""
_REVERSAL_PERIODS = 2
"""Pause in PWM periods. A new duty begins with the next period, so both pins are low before the other one is driven."""


class GpioDriveConfig(TableConfig):
    """Pins are BCM numbers. The defaults, also the PWM of 2 kHz, are those of the car in the legacy article."""

    left_forward_pin: BcmPin = 10
    left_backward_pin: BcmPin = 9
    right_forward_pin: BcmPin = 8
    right_backward_pin: BcmPin = 7
    enable_pins: Annotated[tuple[BcmPin, ...], Field(max_length=2)] = ()
    """ENA and ENB of the bridge, on one pin or two: high from the first motion until a failure or the end."""
    pulse_pin: BcmPin | None = None
    """Pin that toggles with each command of the control loop, for a cutoff: docs/how-to/hardware-cutoff.md."""
    pwm_hz: Annotated[int, Field(ge=400, le=10_000)] = 2_000
    left_reversed: bool = False
    right_reversed: bool = False
    swapped: bool = False
    """True if the motor on the left pins is the right one."""
    trim: Annotated[float, Field(ge=-0.3, le=0.3)] = 0.0
    """Share by which the left wheel is slowed (negative: the right one), for a car that drifts to the right (left)."""
    table_file: Path | None = None
    """File of `sightline calibrate drive`, in place of `table`."""
    odometry: Literal["table", "none"] = "table"
    """Without encoders: `table` predicts the wheel angles from the table, `none` gives no angles."""
    wheel_radius_m: Annotated[float, Field(gt=0.005, lt=1.0)]
    """Set from `wheels.wheel_radius_m` of the robot."""

    @property
    def pins(self) -> tuple[int, int, int, int]:
        """Pins of the motors: left forward and backward, right forward and backward."""
        return self.left_forward_pin, self.left_backward_pin, self.right_forward_pin, self.right_backward_pin

    def rows(self) -> tuple[tuple[float, float], ...]:
        """Return the rows of `table_file` or `table`. Raises ConfigError if the file cannot be read."""
        path = self.table_file
        if path is None:
            return self.table
        try:
            return table_of(file_text(path), str(path))
        except OSError as error:
            raise ConfigError(
                f"{path}: cannot be read: {error.strerror}; write one with `sightline calibrate drive`"
            ) from None

    @model_validator(mode="after")
    def _are_distinct(self) -> Self:
        numbers = [*self.pins, *self.enable_pins, *([] if self.pulse_pin is None else [self.pulse_pin])]
        twice = sorted({number for number in numbers if numbers.count(number) > 1})
        if twice:
            raise ValueError(f"pin {twice[0]} is named twice; each wire has its own")
        if self.table_file is not None and "table" in self.model_fields_set:
            raise ValueError("table and table_file are both set; keep one")
        return self


class GpioDrive:
    """`opening` and `pause` are replaced in tests. The pins are low after construction and after `close`."""

    Config = GpioDriveConfig
    zero = staticmethod(zero)

    def __init__(
        self,
        config: GpioDriveConfig,
        opening: Callable[[GpioDriveConfig], Pins] = open_pins,
        pause: Callable[[float], None] = time.sleep,
    ) -> None:
        self._config = config
        self.table = DutyTable(config.rows())
        self._pins: Pins | None = opening(config)
        left, right = _Motor(config.pins[:2], config.left_reversed), _Motor(config.pins[2:], config.right_reversed)
        self._motors = (right, left) if config.swapped else (left, right)
        self._pause = pause
        self._enabled = self._failed = False
        self._expected_mps = (0.0, 0.0)
        self._angles = WheelAngles(0.0, 0.0, monotonic_us())

    def set(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set the wheel speeds. If a wheel reverses, it waits two PWM periods."""
        if not (math.isfinite(left_rad_s) and math.isfinite(right_rad_s)):
            self._all_low()
            raise HardwareError(f"invalid wheel speeds ({left_rad_s}, {right_rad_s}): not finite; pins set low")
        radius_m, (left, right) = self._config.wheel_radius_m, self._shares
        duties = self.table.duty(left_rad_s * radius_m * left), self.table.duty(right_rad_s * radius_m * right)
        self.set_duty(*duties)

    def set_duty(self, left: float, right: float) -> None:
        """Set the duties, -1..1, forward positive. If a pin fails, it sets all pins low and raises HardwareError."""
        self._angles = self._expected()
        pins, moves = self._opened(), bool(left or right)
        if self._failed and moves:  # the gate's ramp to zero must not start the wheels again
            raise HardwareError("GPIO has failed; its pins stay low until the next zero speed")
        try:
            wanted = list(zip(self._motors, (left, right), strict=True))
            reversing = [motor.let_go(pins, duty) for motor, duty in wanted]
            if any(reversing):
                self._pause(_REVERSAL_PERIODS / self._config.pwm_hz)
            self._enable(moves or self._enabled)
            for motor, duty in wanted:
                motor.drive(pins, duty)
            pins.pulse()
        except Exception as error:
            self._failed = True
            self._all_low()
            raise HardwareError(f"GPIO: {error}; the pins are low, look at the wiring") from None
        self._failed = False
        self._expected_mps = self._speeds(left, right)

    def wheels(self) -> WheelAngles | None:
        """Return the wheel angles that the table predicts, or None without `odometry = "table"`."""
        return self._expected() if self._config.odometry == "table" else None

    def close(self) -> None:
        """Set all pins low and release them. Idempotent."""
        if self._pins is not None:
            self._all_low()
            self._pins.close()
            self._pins = None

    @property
    def _shares(self) -> tuple[float, float]:
        trim = self._config.trim
        return 1 - max(0.0, trim), 1 - max(0.0, -trim)

    def _speeds(self, left: float, right: float) -> tuple[float, float]:
        """Return the speeds at the rims. The trim slows the faster wheel, so that both turn equally."""
        shares = self._shares
        return self.table.speed(left) / shares[0], self.table.speed(right) / shares[1]

    def _expected(self) -> WheelAngles:
        now_us = monotonic_us()
        seconds, radius_m = (now_us - self._angles.t_us) / 1e6, self._config.wheel_radius_m
        left, right = (speed / radius_m * seconds for speed in self._expected_mps)
        return WheelAngles(self._angles.left_rad + left, self._angles.right_rad + right, now_us)

    def _opened(self) -> Pins:
        if self._pins is None:
            raise HardwareError("the GPIO drive is closed")
        return self._pins

    def _enable(self, wanted: bool) -> None:
        if wanted != self._enabled:
            self._opened().enable(wanted)
            self._enabled = wanted

    def _all_low(self) -> None:
        """Set each pin low separately, because one failing pin must not keep the others high."""
        self._angles, self._expected_mps = self._expected(), (0.0, 0.0)
        with suppress(Exception):
            self._enable(False)
        for motor in self._motors:
            motor.low(self._pins)


class _Motor:
    """The two pins of one motor, and their last values."""

    def __init__(self, pins: tuple[int, ...], is_reversed: bool) -> None:
        self._pins = (pins[1], pins[0]) if is_reversed else (pins[0], pins[1])
        self._duty = dict.fromkeys(pins, 0.0)

    def let_go(self, pins: Pins, duty: float) -> bool:
        """Set the pins low that `duty` does not drive. Returns True if the other pin must wait for a reversal."""
        idle = [self._pins[duty > 0]] if duty else [*self._pins]
        was_driven = [self._write(pins, number, 0.0) for number in idle]
        return any(was_driven) and duty != 0

    def drive(self, pins: Pins, duty: float) -> None:
        """Drive the pin for the direction of `duty`. The other pin is low."""
        if duty:
            self._write(pins, self._pins[duty < 0], min(1.0, abs(duty)))

    def low(self, pins: Pins | None) -> None:
        """Set both pins low, also after an error of the first."""
        for number in self._pins:
            try:
                if pins is not None:
                    pins.write(number, 0.0)
            except Exception:  # the other pin must be set low, too
                continue
            self._duty[number] = 0.0

    def _write(self, pins: Pins, number: int, duty: float) -> bool:
        if self._duty[number] == duty:
            return False
        pins.write(number, duty)
        self._duty[number] = duty
        return True
