"""Duty <-> speed at a wheel's rim, by a calibration table, and the table's file. Pure.

`sightline calibrate drive` writes the file; `drive.options.table_file` of the drive `gpio` names it.
"""

import itertools
import tomllib
from collections.abc import Sequence
from typing import Annotated

from pydantic import Field, ValidationError, field_validator

from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError

Duty = Annotated[float, Field(gt=0, le=1)]
RimSpeed = Annotated[float, Field(gt=0, le=3)]
Rows = Annotated[tuple[tuple[Duty, RimSpeed], ...], Field(min_length=1, max_length=32)]

GUESSED_ROWS = ((0.40, 0.08), (0.60, 0.12), (1.00, 0.19))
"""Until the car is measured: 60 rpm at 6 V (the older write-up's motors), about 2 V lost in an L298N on 7.4 V, wheels
of 65 mm, and nothing below the 40 % at which that write-up turned."""


class TableConfig(Config):
    """Rows of (duty, metres per second at the rim), both rising. The first row is the least duty that turns a wheel."""

    table: Rows = GUESSED_ROWS

    @field_validator("table")
    @classmethod
    def _rises(cls, rows: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        for (duty, speed), (more_duty, more_speed) in itertools.pairwise(rows):
            if more_duty <= duty or more_speed <= speed:
                raise ValueError(f"[{more_duty:g}, {more_speed:g}] after [{duty:g}, {speed:g}]: both must rise")
        return rows


class DutyTable:
    """Straight lines between the rows. Whatever is faster than the last row gets the last row's duty."""

    def __init__(self, rows: Sequence[tuple[float, float]]) -> None:
        self._rows = tuple(rows)

    def duty(self, speed_mps: float) -> float:
        """The duty (-1..1) for a speed; 0 below half the least speed, the least duty up to that: stiction."""
        least_duty, least_mps = self._rows[0]
        wanted_mps = abs(speed_mps)
        if wanted_mps < least_mps / 2:
            return 0.0
        return _signed(_between([(mps, duty) for duty, mps in self._rows], wanted_mps, least_duty), speed_mps)

    def speed(self, duty: float) -> float:
        """The speed that a duty gives, as far as the table knows: 0 below the least duty."""
        given = abs(duty)
        return 0.0 if given < self._rows[0][0] else _signed(_between(self._rows, given, self._rows[0][1]), duty)


def _between(rows: Sequence[tuple[float, float]], at: float, below: float) -> float:
    if at <= rows[0][0]:
        return below
    for (x, y), (next_x, next_y) in itertools.pairwise(rows):
        if at <= next_x:
            return y + (next_y - y) * (at - x) / (next_x - x)
    return rows[-1][1]


def _signed(value: float, like: float) -> float:
    return -value if like < 0 else value


def table_of(text: str, where: str) -> tuple[tuple[float, float], ...]:
    """The rows of a table file. Raises ConfigError naming `where` and what is wrong."""
    try:
        return TableConfig.model_validate(tomllib.loads(text)).table
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where}: is no TOML: {error}") from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in first["loc"])
        raise ConfigError(f"{where}: {place}: {first['msg']}; rows are [duty, m/s], e.g. [0.4, 0.08]") from None


def table_text(rows: Sequence[tuple[float, float]], head: str) -> str:
    """A table file with `head` as its comment; `table_of` reads it."""
    lines = "".join(f"  [{duty:.3f}, {speed:.4f}],\n" for duty, speed in rows)
    return f"# {head}\ntable = [ # duty, metres per second at the rim\n{lines}]\n"
