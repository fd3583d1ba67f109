"""Track one target among other objects in the odometry frame. Pure.

In this frame the state of an object is its position and velocity, without the robot's motion: a Kalman filter, in which
both axes share one 2x2 covariance, because they have the same noise. The clock is the capture time of the frames.

The other visible objects are tracked, too. So the target does not change to another object when they cross or hide each
other. Each sighting is assigned to the object that it fits best, by the likelihood of its position and its look. A
sighting with another look belongs to another object, except at the position of the object, because light changes the
look but not the position. If two objects could be exchanged, neither is corrected; both are predicted until they are
apart. If one hides a part of the other, both are corrected less. A target that stays in doubt is lost. For a while
after its loss the track follows nothing that looks like another object.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sightline.protocol.messages import Pose
from sightline.vision_side.config import TrackConfig
from sightline.vision_side.tracking.appearance import OTHER, Look, difference, updated
from sightline.vision_side.tracking.locate import Sighting

# 1 sigma of the speed of a new target.
_FIRST_SPEED_MPS = 0.3
# A sighting three sigma off: the target was pushed. Without more variance the filter would lag behind it.
_SURPRISE = 9.0
_PUSHED_MPS = 0.4

# A limit for boxes of another service; a usual scene has fewer.
_MAX_OTHERS = 16
# Sightings after which an object is a rival of the target. False detections seldom last as long.
_KNOWN_AFTER = 5
# Time without a sighting after which another object is forgotten. It may have left the view for a moment. After the
# same time since the loss of the target, another object, or an object with another look, may become the target.
_MEMORY_US = 3_000_000
# The same for an object with fewer sightings. After this time, a sighting with another look is another object.
_BRIEFLY_US = 300_000
# Variance that the filter does not model: a partly hidden outline, a step, a bump.
_LEAST_NOISE_M2 = 0.05**2
# A sighting of unknown range has a larger variance along its ray. Across the ray it is as exact as any other.
_MOST_NOISE_M2 = 0.15**2
# Minus twice the log-likelihood of a look without a common color. Looks of one object differ by a tenth of that.
_LOOK_MISFIT = 12.0
# Difference of two log-likelihoods, times two, below which two objects could be exchanged: odds of 7 to 1.
_ODDS = 4.0
# Longest time in doubt before the target is lost.
_DOUBT_US = 500_000
# Time between two frames from which on the next frame may be too late: one sighting beside the target is then enough
# for another object. In a faster stream a second one follows before it has come far.
_SLOW_S = 0.09
# Time between two frames of the slowest stream. After a longer one, frames are missing.
_GAP_S = 0.5


@dataclass(frozen=True, slots=True)
class Target:
    """Position and velocity of an object in the odometry frame, and the time since its last detection."""

    x_m: float
    y_m: float
    vx_mps: float
    vy_mps: float
    unseen_us: int
    sightings: int
    number: int = 0
    """Number of the frame in which it was first followed. Another object, or the same one again, has another number."""

    def after(self, dt_s: float) -> tuple[float, float]:
        """Return the position that is expected `dt_s` later."""
        return self.x_m + self.vx_mps * dt_s, self.y_m + self.vy_mps * dt_s


class _Object:
    """Filter of one object."""

    __slots__ = ("_acceleration_mps2", "_unlike_us", "look", "state", "variance", "was_beside")

    def __init__(self, place: "_Place", acceleration_mps2: float) -> None:
        self._acceleration_mps2 = acceleration_mps2
        self.state = Target(place.x_m, place.y_m, 0.0, 0.0, 0, 1)
        self.variance = (place.noise_m2, 0.0, _FIRST_SPEED_MPS**2)
        """Variance of position, covariance, variance of velocity."""
        self.look = place.sighting.look
        self._unlike_us = 0
        """Time since its last sighting with this look."""
        self.was_beside = False
        """True after it was seen beside the target again, in a slow stream once. A sighting that fits it better is not
        of the target."""

    def advance(self, dt_s: float) -> None:
        """Predict with constant velocity and white acceleration."""
        position, both, velocity = self.variance
        power = self._acceleration_mps2**2 * dt_s
        self.variance = (position + dt_s * (2 * both + dt_s * velocity) + power * dt_s**2 / 3,
                         both + dt_s * velocity + power * dt_s / 2, velocity + power)
        was = self.state
        dt_us = round(dt_s * 1e6)
        self.state = Target(*was.after(dt_s), was.vx_mps, was.vy_mps, was.unseen_us + dt_us, was.sightings, was.number)
        self._unlike_us += dt_us

    @property
    def is_known(self) -> bool:
        """Return True if it was seen often."""
        return self.state.sightings >= _KNOWN_AFTER

    @property
    def is_rival(self) -> bool:
        """Return True if it is another object than the target."""
        return self.was_beside and self.is_known

    @property
    def is_forgotten(self) -> bool:
        """Return True if it was not seen for so long that it may have left."""
        return self.state.unseen_us > (_MEMORY_US if self.is_known else _BRIEFLY_US)

    def away_m(self, place: "_Place") -> float:
        """Return the distance of a sighting from the expected position."""
        return _apart_m(self.state, place)

    def three_sigma_m(self, place: "_Place") -> float:
        """Return the largest expected distance of a sighting from the expected position (three sigma)."""
        return math.sqrt(_SURPRISE * (self.variance[0] + place.noise_m2))

    def unlike(self, place: "_Place") -> float:
        """Return the difference of the looks of the object and of a sighting."""
        return difference(self.look, place.sighting.look)

    def misfit(self, place: "_Place") -> float:
        """Return minus twice the logarithm of the likelihood of a sighting, without its constant."""
        variance = self.variance[0] + min(max(place.noise_m2, _LEAST_NOISE_M2), _MOST_NOISE_M2)
        return self.away_m(place) ** 2 / variance + 2 * math.log(variance) + _LOOK_MISFIT * self.unlike(place)

    def rank(self, place: "_Place") -> tuple[bool, float]:
        """Return a sort key, lower for a better fit. Sightings with another look come last."""
        return self.unlike(place) >= OTHER, self.misfit(place)

    def correct(self, place: "_Place") -> None:
        """Correct the prediction with a sighting."""
        (position, both, velocity), noise, was = self.variance, place.noise_m2, self.state
        self._update_look(place)
        dx, dy = place.x_m - was.x_m, place.y_m - was.y_m
        if dx * dx + dy * dy > _SURPRISE * 2 * (position + noise):
            # The larger variances let this sighting move the estimate most of the way.
            velocity += _PUSHED_MPS**2
            position += (position + noise)
        gain, gain_velocity = position / (position + noise), both / (position + noise)
        self.variance = (position * (1 - gain), both * (1 - gain), velocity - gain_velocity * both)
        self.state = Target(was.x_m + gain * dx, was.y_m + gain * dy, was.vx_mps + gain_velocity * dx,
                            was.vy_mps + gain_velocity * dy, 0, was.sightings + 1, was.number)

    def _update_look(self, place: "_Place") -> None:
        """Update the look. Another look is that of an object in front, until it lasts: then the light has changed."""
        look, is_alike = place.sighting.look, self.unlike(place) < OTHER
        if look is not None and (is_alike or self._unlike_us > _MEMORY_US):
            self.look, self._unlike_us = updated(self.look, look) if is_alike else look, 0


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A sighting in the odometry frame."""

    x_m: float
    y_m: float
    noise_m2: float
    sighting: Sighting


class Track:
    """Follows at most one target. `target` is None without a target."""

    def __init__(self, config: TrackConfig) -> None:
        self._config = config
        self._followed: _Object | None = None
        self._others: list[_Object] = []
        self._lost: _Object | None = None
        """The last target, until another one is followed. A sighting of it does not belong to a rival."""
        self._lost_look: Look | None = None
        self._unsure_us = 0
        """Time in doubt, or since the loss of the target."""

    @property
    def target(self) -> Target | None:
        """Return the state of the target."""
        return self._followed.state if self._followed else None

    def step(self, dt_s: float, pose: Pose, sightings: Sequence[Sighting], number: int = 0) -> Sighting | None:
        """Advance the track and correct it with the newest sightings.

        Args:
            dt_s: time since the last frame.
            pose: odometry at capture, m, m, rad.
            sightings: candidates, best first. The best sighting starts a track; the best fit continues it.
            number: number of this frame.

        Returns:
            The sighting of the target, or None if it is hidden or in doubt.
        """
        places = [_Place(*to_odometry(pose, one.x_m, one.y_m), self._noise(one), one) for one in sightings]
        for one in self._objects():
            one.advance(dt_s)
        if dt_s > _GAP_S:
            self._forget_hidden()
        fits = self._fits(places)
        in_doubt = self._in_doubt(fits)
        sure = {one: place for one, place in fits.items() if one not in in_doubt}
        for one, place in [(one, self._inexact(place) if self._is_in_line(one, pose) else place)
                           for one, place in sure.items()]:
            one.correct(place)
        if self._followed is None:
            seen = self._start(dt_s, places, fits, in_doubt, number)
        else:
            seen = None if in_doubt else fits.get(self._followed)
            self._unsure_us = self._unsure_us + round(dt_s * 1e6) if in_doubt else 0
            self._end(self._followed)
        self._update_others(places, fits, self._followed if seen else None, is_slow=dt_s >= _SLOW_S)
        return seen.sighting if seen else None

    def _forget_hidden(self) -> None:
        """Forget objects that were hidden for too long, because their gates would now include distant objects."""
        if self._followed is not None:
            self._end(self._followed)
        self._others = [one for one in self._others if not one.is_forgotten]

    def _objects(self) -> list[_Object]:
        target = self._followed or self._lost
        return [target, *self._others] if target else self._others

    def _fits(self, places: list[_Place]) -> dict[_Object, _Place]:
        """Assign places to objects: first for the target and objects next to it; best fit with the same look first."""
        fits, apart_m, target = dict[_Object, _Place](), self._config.apart_m, self._followed or self._lost
        for is_first in (True, False):
            objects = [one for one in self._objects() if (one is target or one.was_beside) == is_first]
            pairs = [(one, place) for one in objects for place in places if self._is_near(one, place)]
            for one, place in sorted(pairs, key=lambda pair: pair[0].rank(pair[1])):
                if one not in fits and all(_apart_m(place, taken) > apart_m for taken in fits.values()):
                    fits[one] = place
        return fits

    def _is_near(self, one: _Object, place: _Place) -> bool:
        # The gate grows while an object is hidden, because its position becomes less certain. Its look does not.
        grown_m = self._config.gate_growth_mps * one.state.unseen_us / 1e6
        gate_m = self._config.gate_m + min(grown_m, one.three_sigma_m(place))
        is_there = one.state.unseen_us <= _BRIEFLY_US and one.away_m(place) < self._config.apart_m
        return one.away_m(place) < gate_m and (is_there or one.unlike(place) < OTHER)

    def _is_in_line(self, one: _Object, pose: Pose) -> bool:
        """Return True if an object hides a part of another one, or is hidden by it."""
        here = from_odometry(pose, one.state.x_m, one.state.y_m)
        return any(
            other is not one and other.is_known
            and _are_in_line(here, from_odometry(pose, other.state.x_m, other.state.y_m), self._config.apart_m)
            for other in self._objects()
        )

    @staticmethod
    def _inexact(place: _Place) -> _Place:
        # The outline is of a part, or of both objects.
        return replace(place, noise_m2=max(place.noise_m2, _MOST_NOISE_M2))

    def _in_doubt(self, fits: dict[_Object, _Place]) -> set[_Object]:
        """Return the target and the rivals with exchangeable sightings; otherwise an empty set."""
        target = self._followed or self._lost
        if target is None:
            return set()
        # If both are seen, the lost target is the object that is not at the place of the other.
        rivals = [one for one in self._others if one.is_rival and (self._followed or not {target, one} <= fits.keys())]
        found = {one for one in rivals if self._could_exchange(target, one, fits)}
        return {target, *found} if found else found

    def _could_exchange(self, one: _Object, other: _Object, fits: dict[_Object, _Place]) -> bool:
        exchanged = [(fits[one], one, other)] if one in fits else []
        exchanged += [(fits[other], other, one)] if other in fits else []
        worse = sum(thief.misfit(place) - owner.misfit(place) for place, owner, thief in exchanged)
        return bool(exchanged) and worse < _ODDS and all(self._is_near(thief, place) for place, _, thief in exchanged)

    def _start(
        self, dt_s: float, places: list[_Place], fits: dict[_Object, _Place], in_doubt: set[_Object], number: int
    ) -> _Place | None:
        """Follow the best sighting. For a while exclude rivals of the last target, and sightings with another look."""
        self._unsure_us += round(dt_s * 1e6)
        if self._unsure_us <= _MEMORY_US:
            taken = [place for one, place in fits.items() if one.is_rival or one in in_doubt]
            places = [one for one in places if difference(self._lost_look, one.sighting.look) < OTHER
                      and all(_apart_m(one, two) > self._config.apart_m for two in taken)]
        chosen = next(iter(places), None)
        if chosen is not None:
            known = next((one for one in self._others if fits.get(one) is chosen), None)
            self._followed, self._lost, self._unsure_us = known or self._new(chosen), None, 0
            self._followed.state = replace(self._followed.state, number=number)
        return chosen

    def _end(self, followed: _Object) -> None:
        """End the track of a target that was hidden or in doubt for too long."""
        # After doubt, the lost target may be the other object.
        followed.was_beside = self._unsure_us > _DOUBT_US
        if followed.was_beside or followed.state.unseen_us > self._config.give_up_s * 1e6:
            self._others += [followed] if followed.was_beside else []
            self._lost, self._lost_look = None if followed.was_beside else followed, followed.look
            self._followed, self._unsure_us = None, 0

    def _update_others(
        self, places: list[_Place], fits: dict[_Object, _Place], target: _Object | None, *, is_slow: bool
    ) -> None:
        """Add new objects; forget objects without a recent sighting, and parts of a visible target."""
        apart_m = self._config.apart_m
        self._others = [one for one in self._others if one is not self._followed and not one.is_forgotten
                        and not (target and _apart_m(one.state, target.state) < apart_m)]
        for one in self._others:
            one.was_beside |= target is not None and one in fits
        for place in places:
            is_apart = all(one.away_m(place) > apart_m for one in self._objects())
            if is_apart and place not in fits.values() and len(self._others) < _MAX_OTHERS:
                self._others.append(self._new(place))
                if is_slow and target is not None and target.is_known:
                    self._others[-1].was_beside = True

    def _new(self, place: _Place) -> _Object:
        return _Object(place, self._config.acceleration_mps2)

    def _noise(self, sighting: Sighting) -> float:
        """Return the variance of one position. The range error grows with the square of the range."""
        # A partly hidden outline (low score) gives a less exact range.
        range_m2, score = sighting.x_m**2 + sighting.y_m**2, sighting.detection.score * sighting.exactness
        return float((self._config.range_noise * max(range_m2, 0.1) / max(score, 0.2) ** 2) ** 2)


def _apart_m(one: "Target | _Place", other: "Target | _Place") -> float:
    return math.hypot(one.x_m - other.x_m, one.y_m - other.y_m)


def _are_in_line(one: tuple[float, float], other: tuple[float, float], apart_m: float) -> bool:
    """Return True if the nearer of two points is less than `apart_m` from the ray to the further one."""
    further_m = max(math.hypot(*one), math.hypot(*other))
    is_ahead = one[0] * other[0] + one[1] * other[1] > 0
    return is_ahead and abs(one[0] * other[1] - one[1] * other[0]) < apart_m * further_m


def to_odometry(pose: Pose, x_m: float, y_m: float) -> tuple[float, float]:
    """Convert a point relative to the robot at `pose` to the odometry frame."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return pose[0] + cos * x_m - sin * y_m, pose[1] + sin * x_m + cos * y_m


def from_odometry(pose: Pose, x_m: float, y_m: float) -> tuple[float, float]:
    """Convert a point of the odometry frame to one relative to the robot at `pose`."""
    dx, dy = x_m - pose[0], y_m - pose[1]
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    return cos * dx + sin * dy, cos * dy - sin * dx
