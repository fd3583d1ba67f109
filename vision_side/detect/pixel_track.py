"""Where in the picture a thing should be: a Kalman filter of its place, a smoothed size, and a gate. Pure."""

import math
from typing import Final

from sightline.vision_side.detect.port import Circle

_ACCELERATION: Final = 6.0  # picture widths per s^2: a robot that begins to turn as hard as it may
_FIRST_SPEED: Final = 1.5  # picture widths per s: a robot that turns as fast as it may
_NOISE_PX: Final = 0.7
_SIGMAS: Final = 4.0
_GATE_RADII, _GATE_WIDTHS = 1.5, 0.06  # whatever the filter thinks: further off it is another thing
_LEAST_SIZE, _MOST_SIZE = 0.65, 1.55  # of the radius, from one picture to the next
_SIZE_PART: Final = 0.4  # of a new radius; what is partly hidden looks smaller for a while


class PixelTrack:
    """The place of one thing, both axes with one covariance, since nothing prefers one of them."""

    def __init__(self, circle: Circle, width_px: int) -> None:
        self.cx_px, self.cy_px, self.radius_px = circle.cx_px, circle.cy_px, circle.radius_px
        self._vx, self._vy = 0.0, 0.0
        self._width_px = width_px
        self._variance = (_NOISE_PX**2, 0.0, (_FIRST_SPEED * width_px) ** 2)

    @property
    def gate_px(self) -> float:
        """How far off it may be found."""
        most = _GATE_RADII * self.radius_px + _GATE_WIDTHS * self._width_px
        return min(most, _SIGMAS * math.sqrt(self._variance[0]) + 0.5 * self.radius_px)

    def away_px(self, circle: Circle) -> float:
        """From where it should be."""
        return math.hypot(circle.cx_px - self.cx_px, circle.cy_px - self.cy_px)

    def admits(self, circle: Circle) -> bool:
        """Whether that may be it, by place and size."""
        size = circle.radius_px / self.radius_px
        return self.away_px(circle) <= self.gate_px and _LEAST_SIZE <= size <= _MOST_SIZE

    def advance(self, dt_s: float) -> None:
        """Constant velocity, with white acceleration."""
        position, both, velocity = self._variance
        power = (_ACCELERATION * self._width_px) ** 2 * dt_s
        self._variance = (position + dt_s * (2 * both + dt_s * velocity) + power * dt_s**2 / 3,
                          both + dt_s * velocity + power * dt_s / 2, velocity + power)
        self.cx_px += self._vx * dt_s
        self.cy_px += self._vy * dt_s

    def correct(self, circle: Circle) -> None:
        """Take in where it was found."""
        position, both, velocity = self._variance
        gain, gain_velocity = position / (position + _NOISE_PX**2), both / (position + _NOISE_PX**2)
        dx, dy = circle.cx_px - self.cx_px, circle.cy_px - self.cy_px
        self.cx_px, self.cy_px = self.cx_px + gain * dx, self.cy_px + gain * dy
        self._vx, self._vy = self._vx + gain_velocity * dx, self._vy + gain_velocity * dy
        self.radius_px += _SIZE_PART * (circle.radius_px - self.radius_px)
        self._variance = (position * (1 - gain), both * (1 - gain), velocity - gain_velocity * both)
