"""The bodies in front of the camera, now or some time ago. Shell (PyBullet); reads no clock.

A camera with latency delivers an image of the past. The past is another client with the same bodies, put
where they were. Motion by the clock is recomputed, motion by physics is recorded.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from sightline.sim.scenario import Rolling, Scenario, Wall
from sightline.sim.world.bodies import LightBodies, Mover, Points, Pose, ThingBodies, begin, begin_thing
from sightline.sim.world.camera import corners_of
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import Vector, add_wall, open_client
from sightline.sim.world.start import light_begin


class Moment(NamedTuple):
    """The lens at a time, and the target if physics moves it."""

    t_us: int
    place: Vector
    """Of the lens."""
    turn: Any
    """Of the lens, as a quaternion."""
    turn_rad_s: float
    """Rate at which the lens turns, rad/s, left positive."""
    target: Pose | None
    """Of a target that physics moves."""


class Scenery:
    """The bodies of one client that a camera sees."""

    def __init__(
        self, client: int, scenario: Scenario, things: Sequence[ThingBodies], light: LightBodies | None
    ) -> None:
        """Store the bodies. `things` include the target."""
        self.client, self.things = client, things
        self._light = light
        self._walls = [corners_of(wall)[0] for wall in scenario.walls]

    def hulls(self) -> list[Points]:
        """Return points (N, 3) of each convex body that casts a shadow. The lamp is inside the walls of the room."""
        hulls = [hull for thing in self.things for hull in thing.hulls()]
        return [*self._walls, *hulls, *(self._light.hulls() if self._light else ())]


class Past:
    """The scenery at a fixed time before now."""

    def __init__(self, scenario: Scenario, room: Sequence[Wall], seed: int, step_us: int, latency_us: int) -> None:
        """Build the scenery. `room`: walls in addition to those of the scenario."""
        self._client = client = open_client(step_us)
        for wall in (*scenario.walls, *room):
            add_wall(client, wall)
        target, at, way_m = begin(client, scenario.target, seed)
        self._target = ThingBodies(client, scenario.target, at, way_m, is_target=True)
        is_rolling = isinstance(scenario.target, Rolling)
        self._movers: list[tuple[Mover, ThingBodies]] = [] if is_rolling else [(target, self._target)]
        for number, thing in enumerate(scenario.things, start=1):
            mover, at, way_m = begin_thing(thing, number, seed)
            self._movers.append((mover, ThingBodies(client, thing, at, way_m, is_target=False)))
        light = scenario.light
        self._light = LightBodies(client, light, light_begin(light, seed)) if light else None
        things = [self._target, *(bodies for _, bodies in self._movers if bodies is not self._target)]
        self.scenery = Scenery(client, scenario, things, self._light)
        self._latency_us = latency_us
        self._moments: deque[Moment] = deque()

    def record(self, moment: Moment) -> None:
        """Record a moment, after each step of the world."""
        self._moments.append(moment)
        while len(self._moments) > 1 and self._moments[1].t_us <= moment.t_us - self._latency_us:
            self._moments.popleft()

    def show(self) -> Moment:
        """Put all bodies where they were, and return that moment, or the first one of the run."""
        moment = self._moments[0]
        for mover, bodies in self._movers:
            mover.move(bodies, moment.t_us)
        if moment.target:
            self._target.put_pose(moment.target)
        if self._light:
            self._light.move(moment.t_us)
        return moment

    def close(self) -> None:
        """Free PyBullet's memory; idempotent."""
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)
