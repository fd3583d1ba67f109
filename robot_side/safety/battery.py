"""Derive a speed limit from the battery voltage: full speed, half of it, or zero. Pure."""

import math
from enum import Enum
from typing import Final, Self

from pydantic import Field, model_validator

from sightline.protocol.config import Config
from sightline.robot_side.safety.states import Cause

# Time without a valid reading after which the battery counts as low.
SILENT_US: Final = 5_000_000


class BatteryLimits(Config):
    """Voltages of the battery, part of the limits of the gate. The defaults are those of two lithium cells."""

    low_battery_v: float = Field(default=7.0, le=100, description="the speed limit is halved below this voltage")
    empty_battery_v: float = Field(default=6.4, gt=0, description="HOLD below this voltage")
    battery_hysteresis_v: float = Field(
        default=0.3,
        ge=0,
        le=10,
        description="low and empty end only this far above their voltage, which recovers when the motors stop",
    )

    @model_validator(mode="after")
    def _empty_is_below_low(self) -> Self:
        if self.empty_battery_v >= self.low_battery_v:
            raise ValueError("empty_battery_v must be below low_battery_v")
        return self


class BatteryLevel(Enum):
    """State of charge, from full to empty. SILENT: no valid reading for 5 s."""

    OK = "ok"
    LOW = "low"
    SILENT = "silent"
    EMPTY = "empty"


_CAUSES: Final = {
    BatteryLevel.LOW: Cause(0.5, "the battery is low; half speed"),
    BatteryLevel.SILENT: Cause(0.5, "the battery is silent; half speed"),
    BatteryLevel.EMPTY: Cause(0.0, "the battery is empty"),
}


class BatteryMonitor:
    """Tracks the battery level from voltage readings.

    A level ends only `battery_hysteresis_v` above the voltage at which it began.
    """

    def __init__(self, config: BatteryLimits) -> None:
        self._config = config
        self._level = BatteryLevel.OK
        self._newest: tuple[float, int] | None = None

    def see(self, volts: float, t_us: int) -> None:
        """Take a reading. A value that is not finite is ignored.

        Args:
            volts: battery voltage, V.
            t_us: time of the reading on the robot's clock, us.
        """
        if math.isfinite(volts):
            self._level = self._after(volts)
            self._newest = volts, t_us

    def _after(self, volts: float) -> BatteryLevel:
        config = self._config
        # The voltage recovers when the motors stop. Without hysteresis the robot would start again on an empty battery.
        empty_v, low_v = config.empty_battery_v, config.low_battery_v
        if self._level is BatteryLevel.EMPTY:
            empty_v += config.battery_hysteresis_v
        if self._level is not BatteryLevel.OK:
            low_v += config.battery_hysteresis_v
        if volts < empty_v:
            return BatteryLevel.EMPTY
        return BatteryLevel.LOW if volts < low_v else BatteryLevel.OK

    def volts(self, now_us: int) -> float | None:
        """Return the newest reading in V, or None if it is older than `SILENT_US`."""
        if self._newest is None or now_us - self._newest[1] > SILENT_US:
            return None
        return self._newest[0]

    def level(self, now_us: int) -> BatteryLevel:
        """Return the level now."""
        # Silence must not raise the limit of an empty battery from zero to half.
        silent = self.volts(now_us) is None and self._level is not BatteryLevel.EMPTY
        return BatteryLevel.SILENT if silent else self._level

    def causes(self, now_us: int) -> tuple[Cause, ...]:
        """Return the cause that limits the speed now, or an empty tuple."""
        cause = _CAUSES.get(self.level(now_us))
        return () if cause is None else (cause,)
