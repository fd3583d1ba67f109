"""A traffic light and its stop line as bodies of one PyBullet client. Shell (PyBullet); reads no clock."""

import math

from sightline.sim.world.engine import pybullet
from sightline.sim.light import Light, Part, color_of
from sightline.sim.world.physics import FLOOR, ROBOT, TARGET, WALL, group
from sightline.sim.world.bodies import ball_visual

LINE_RGB = (0.92, 0.92, 0.92)
LINE_WIDE_M = 1.2
_LINE_DEEP_M = 0.05
_LINE_HIGH_M = 0.002
_NOTHING = -1


class LightBodies:
    """Housing, pole and lamps, or one box, lit as the schedule says."""

    def __init__(self, client: int, light: Light, begin: float) -> None:
        self._client, self._light, self._begin = client, light, begin
        self.state = light.state_at(begin, 0)
        self._turn = pybullet.getQuaternionFromEuler([0, 0, math.radians(light.faces_deg)])
        self._parts = [(part, self._add(part)) for part in light.parts()]
        self._add_line()

    @property
    def bodies(self) -> frozenset[int]:
        """All that could be touched or is lit."""
        return frozenset(body for _, body in self._parts)

    def move(self, now_us: int) -> None:
        """Change colour when it is time."""
        state = self._light.state_at(self._begin, now_us)
        if state == self.state:
            return
        self.state = state
        for part, body in self._parts:
            rgba = [*color_of(part, state), 1]
            pybullet.changeVisualShape(body, -1, rgbaColor=rgba, physicsClientId=self._client)

    def _add(self, part: Part) -> int:
        client, half, colour = self._client, [side / 2 for side in part.size_m], color_of(part, self.state)
        if part.shape == "ball":
            visual = ball_visual(client, part.size_m[0], colour)
            return int(pybullet.createMultiBody(0, _NOTHING, visual, part.at_m, self._turn, physicsClientId=client))
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=client)
        visual = self._box_visual(half, colour)
        body = int(pybullet.createMultiBody(0, shape, visual, part.at_m, self._turn, physicsClientId=client))
        group(client, body, WALL, FLOOR | ROBOT | TARGET)
        return body

    def _add_line(self) -> None:
        """A strip that lies on the floor and is only seen."""
        visual = self._box_visual([_LINE_DEEP_M / 2, LINE_WIDE_M / 2, _LINE_HIGH_M / 2], LINE_RGB)
        at = (*self._light.ahead(self._light.line_m), _LINE_HIGH_M / 2)
        pybullet.createMultiBody(0, _NOTHING, visual, at, self._turn, physicsClientId=self._client)

    def _box_visual(self, half: list[float], colour: tuple[float, float, float]) -> int:
        return int(pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half, rgbaColor=[*colour, 1], specularColor=[0, 0, 0],
            physicsClientId=self._client,
        ))
