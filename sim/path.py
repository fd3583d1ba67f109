"""A closed path of straights and arcs, by arc length: where a moving target is. Pure."""

import math
from typing import Annotated, NamedTuple

from pydantic import Field

from sightline.protocol.config import Config


class Leg(Config):
    """One piece of a path: its length along the path and how far it turns, left positive."""

    length_m: Annotated[float, Field(gt=0, le=1000)]
    turn_deg: Annotated[float, Field(ge=-3600, le=3600)] = 0.0


class Place(NamedTuple):
    """A point and the heading of whoever moves through it."""

    x_m: float
    y_m: float
    heading_rad: float


class ClosedPath:
    """Legs walked for ever, starting at `start`. Raises ValueError when the end does not meet the start."""

    def __init__(self, start: Place, legs: tuple[Leg, ...]) -> None:
        self._legs = legs
        self._starts = [start]
        for leg in legs:
            self._starts.append(_along(self._starts[-1], leg, leg.length_m))
        self.length_m = math.fsum(leg.length_m for leg in legs)
        end = self._starts[-1]
        gap_m = math.hypot(end.x_m - start.x_m, end.y_m - start.y_m)
        bend_rad = abs(math.remainder(end.heading_rad - start.heading_rad, math.tau))
        if gap_m > 0.01 or bend_rad > 0.02:
            off = f"{gap_m:.3f} m and {math.degrees(bend_rad):.1f} degrees"
            raise ValueError(f"the path does not close: it ends {off} from its start")

    def at(self, distance_m: float) -> Place:
        """The place `distance_m` along the path; laps repeat."""
        left_m = distance_m % self.length_m
        for leg, start in zip(self._legs, self._starts, strict=False):
            if left_m <= leg.length_m:
                return _along(start, leg, left_m)
            left_m -= leg.length_m
        return self._starts[0]


def _along(start: Place, leg: Leg, distance_m: float) -> Place:
    """The place `distance_m` into `leg`: the chord of an arc, which a straight is the limit of."""
    half_rad = math.radians(leg.turn_deg) * distance_m / leg.length_m / 2
    chord_m = distance_m * (math.sin(half_rad) / half_rad if abs(half_rad) > 1e-9 else 1.0)
    heading_rad = start.heading_rad + half_rad
    return Place(
        start.x_m + chord_m * math.cos(heading_rad),
        start.y_m + chord_m * math.sin(heading_rad),
        start.heading_rad + 2 * half_rad,
    )
