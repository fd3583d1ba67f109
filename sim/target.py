"""What moves the ball: nothing, a path, or pushes. Shell (PyBullet); reads no clock."""

import math
from typing import Protocol

import numpy as np

from sim.engine import pybullet
from sim.path import Place
from sim.physics import Vector
from sim.scenario import OnPath, Pushed, Static

PUSH_S = 0.4
SOLID_BALL = 1.4  # a rolling solid ball resists a push at its centre as 7/5 of its mass would


class Mover(Protocol):
    """Moves the ball before each physics step."""

    def move(self, body: int, now_us: int) -> None: ...


class Still:
    """Leaves it where it is."""

    def move(self, body: int, now_us: int) -> None:
        """Nothing."""


class PathMover:
    """Carries the ball along its path."""

    def __init__(self, client: int, target: OnPath, phase: float) -> None:
        self._client, self._target = client, target
        self._path = target.closed_path()
        self._begin_m = phase * self._path.length_m

    def place(self, now_us: int) -> Place:
        """Where the ball is at `now_us`."""
        return self._path.at(self._begin_m + self._target.speed_mps * now_us / 1e6)

    def move(self, body: int, now_us: int) -> None:
        """Put it there."""
        place = self.place(now_us)
        pybullet.resetBasePositionAndOrientation(
            body, (place.x_m, place.y_m, self._target.radius_m), (0, 0, 0, 1), physicsClientId=self._client
        )


class Pusher:
    """Pushes the ball now and then, towards a random point of its arena."""

    def __init__(self, client: int, target: Pushed, seed: int) -> None:
        self._client, self._target = client, target
        self._draw = np.random.default_rng([seed, 6])
        self._begin_us = round(self._draw.uniform(0.5, 1.5) * 1e6)
        self._force: Vector | None = None

    def move(self, body: int, now_us: int) -> None:
        """Push while a push lasts."""
        if now_us < self._begin_us:
            return
        place, _ = pybullet.getBasePositionAndOrientation(body, physicsClientId=self._client)
        if self._force is None:
            self._force = self._force_from(place)
        pybullet.applyExternalForce(body, -1, self._force, place, pybullet.WORLD_FRAME, physicsClientId=self._client)
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


def begin(client: int, target: Static | OnPath | Pushed, seed: int) -> tuple[Mover, Place]:
    """What moves `target`, and where it begins."""
    if isinstance(target, OnPath):
        phase = float(np.random.default_rng([seed, 1]).uniform(*target.phase))
        mover = PathMover(client, target, phase)
        return mover, mover.place(0)
    if isinstance(target, Pushed):
        return Pusher(client, target, seed), Place(*target.at_m, 0.0)
    return Still(), Place(*target.at_m, 0.0)
