"""What moves a thing: nothing, a path, pushes, or one constant force. Shell (PyBullet); reads no clock."""

import math
from typing import Protocol

import numpy as np

from sightline.sim.world.engine import pybullet
from sightline.sim.path import Place
from sightline.sim.world.physics import Vector
from sightline.sim.world.start import target_phase, thing_phase, thing_place
from sightline.sim.world.bodies import ThingBodies
from sightline.sim.things import Forced, OnPath, Pushed, Static

PUSH_S = 0.4
SOLID_BALL = 1.4  # a rolling solid ball resists a push at its centre as 7/5 of its mass would


class Mover(Protocol):
    """Moves a thing before each physics step."""

    def move(self, bodies: ThingBodies, now_us: int) -> None: ...


class Still:
    """Leaves it where it is."""

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Nothing."""


class PathMover:
    """Carries it along its path."""

    def __init__(self, thing: OnPath, phase: float) -> None:
        self._thing = thing
        self._path = thing.closed_path()
        self._begin_m = phase * self._path.length_m

    def way_m(self, now_us: int) -> float:
        """How far along its path it is at `now_us`."""
        return self._begin_m + self._thing.speed_mps * max(0.0, now_us / 1e6 - self._thing.waits_s)

    def place(self, now_us: int) -> Place:
        """Where it is at `now_us`."""
        return self._path.at(self.way_m(now_us))

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Put it there."""
        bodies.put(self.place(now_us), self.way_m(now_us))


class Pusher:
    """Pushes the ball now and then, towards a random point of its arena."""

    def __init__(self, client: int, target: Pushed, seed: int) -> None:
        self._client, self._target = client, target
        self._draw = np.random.default_rng([seed, 6])
        self._begin_us = round(self._draw.uniform(0.5, 1.5) * 1e6)
        self._force: Vector | None = None

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Push while a push lasts."""
        if now_us < self._begin_us:
            return
        place = bodies.middle
        if self._force is None:
            self._force = self._force_from(place)
        _push(self._client, bodies, self._force)
        if now_us >= self._begin_us + PUSH_S * 1e6:
            self._begin_us = now_us + round(self._draw.uniform(*self._target.push_every_s) * 1e6)
            self._force = None

    def _force_from(self, place: Vector) -> Vector:
        target = self._target
        angle_rad, share = self._draw.uniform(0, math.tau), math.sqrt(self._draw.uniform())
        aim_x = target.at_m[0] + target.arena_m * share * math.cos(angle_rad) - place[0]
        aim_y = target.at_m[1] + target.arena_m * share * math.sin(angle_rad) - place[1]
        force_n = SOLID_BALL * target.mass_kg * self._draw.uniform(*target.push_mps) / PUSH_S
        far_m = math.hypot(aim_x, aim_y) or 1.0
        return (force_n * aim_x / far_m, force_n * aim_y / far_m, 0.0)


class Force:
    """Pushes the ball the same way for ever."""

    def __init__(self, client: int, target: Forced) -> None:
        self._client, self._from_us = client, target.from_s * 1e6
        heading_rad = math.radians(target.heading_deg)
        self._force: Vector = (target.force_n * math.cos(heading_rad), target.force_n * math.sin(heading_rad), 0.0)

    def move(self, bodies: ThingBodies, now_us: int) -> None:
        """Push."""
        if now_us >= self._from_us:
            _push(self._client, bodies, self._force)


def _push(client: int, bodies: ThingBodies, force: Vector) -> None:
    pybullet.applyExternalForce(
        bodies.bodies[0], -1, force, bodies.middle, pybullet.WORLD_FRAME, physicsClientId=client
    )


def begin(client: int, target: Static | OnPath | Pushed | Forced, seed: int) -> tuple[Mover, Place, float]:
    """What moves the target, where it begins, and how far it has come on its path by then."""
    if isinstance(target, OnPath):
        return _on_path(target, target_phase(target, seed))
    if isinstance(target, Pushed):
        return Pusher(client, target, seed), Place(*target.at_m, 0.0), 0.0
    if isinstance(target, Forced):
        return Force(client, target), Place(*target.at_m, math.radians(target.heading_deg)), 0.0
    return Still(), thing_place(target, 0, seed), 0.0


def begin_thing(thing: Static | OnPath, number: int, seed: int) -> tuple[Mover, Place, float]:
    """The same for whatever else there is."""
    if isinstance(thing, OnPath):
        return _on_path(thing, thing_phase(thing, number, seed))
    return Still(), thing_place(thing, number, seed), 0.0


def _on_path(thing: OnPath, phase: float) -> tuple[Mover, Place, float]:
    mover = PathMover(thing, phase)
    return mover, mover.place(0), mover.way_m(0)
