"""`World`: robot, motors, things and sensors on one clock. Shell (PyBullet)."""

import math
from random import Random
from typing import Any, Self

from sightline.robot_side.ports import Ranges, WheelAngles
from sightline.sim.bus import Label
from sightline.sim.robot import RobotModel, Wheels, outline
from sightline.sim.scenario import OnPath, Place, Rolling, Scenario, Thing
from sightline.sim.truth import Truth
from sightline.sim.world.bodies import LightBodies, Mover, ThingBodies, begin, begin_thing
from sightline.sim.world.camera import SceneCamera
from sightline.sim.world.effects import Defects, Shutter, published_model
from sightline.sim.world.engine import pybullet
from sightline.sim.world.physics import WALL, Vector, add_floor, add_robot, add_wall, open_client
from sightline.sim.world.sensors import Lidar, leg_labels
from sightline.sim.world.start import light_begin, robot_start
from sightline.sim.world.surroundings import surfaces, surroundings
from sightline.sim.world.view import Moment, Past, Scenery

SLIP_EVERY_STEPS = 25  # 0.1 s of 4 ms steps


class Motor:
    """Latches the given speed and follows it as a small gear motor does."""

    def __init__(self, model: Wheels, step_s: float, seed: str) -> None:
        self._model = model
        self._most_change_rad_s = model.max_accel_mps2 / model.radius_m * step_s
        self._follow = 1.0 - math.exp(-step_s / model.lag_s) if model.lag_s else 1.0
        self._draw = Random(seed)
        self._wanted_rad_s = self._ramped_rad_s = self._speed_rad_s = 0.0
        self._steps = 0
        self._kept = 1.0
        self._turned_rad = self._shaft_rad = 0.0

    def set(self, speed_rad_s: float) -> None:
        """Latch a speed, limited to the motor's own. Raises ValueError unless finite."""
        if not math.isfinite(speed_rad_s):
            raise ValueError(f"wheel speed {speed_rad_s}")
        most = self._model.max_rad_s
        self._wanted_rad_s = max(-most, min(most, speed_rad_s))

    def step(self) -> float:
        """Advance one physics step. Returns the speed at which the wheel should roll over the floor, rad/s."""
        change = self._wanted_rad_s - self._ramped_rad_s
        self._ramped_rad_s += max(-self._most_change_rad_s, min(self._most_change_rad_s, change))
        self._speed_rad_s += (self._ramped_rad_s - self._speed_rad_s) * self._follow
        if self._model.slip and self._steps % SLIP_EVERY_STEPS == 0:
            self._kept = 1.0 - self._draw.uniform(0.0, 2.0 * self._model.slip)
        self._steps += 1
        return self._speed_rad_s * self._kept

    def rolled(self, turned_rad: float) -> None:
        """Update the encoder with the angle of the wheel since the start, rad."""
        self._shaft_rad += (turned_rad - self._turned_rad) / self._kept
        self._turned_rad = turned_rad

    @property
    def angle_rad(self) -> float:
        """Return the counted angle of the shaft, including slip, in whole encoder steps."""
        step_rad = math.tau / self._model.encoder_steps
        return math.floor(self._shaft_rad / step_rad) * step_rad


# The simulated world: robot, target and other things on one clock. Shell (PyBullet); reads no clock of its own.
#
# Bitwise the same for the same scenario, robot, seed and calls. Lockstep steps it; the real-time service steps it
# against deadlines.


STEP_US = 4000
"""250 Hz: every time in the world is a whole number of these."""
STANDING_MPS = 0.01  # a slower robot does not cause a contact
CLEARANCE_SEEN_M = 1.0
"""Beyond this distance, clearance is not measured."""


class World:
    """One run of a scenario."""

    def __init__(self, scenario: Scenario, robot: RobotModel, seed: int) -> None:
        self.scenario, self.robot, self.seed = scenario, robot, seed
        self.walls = scenario.walls
        pinhole = robot.camera.camera_model()
        self.camera_model = published_model(pinhole, scenario.look)
        self._shutter = Shutter(pinhole, scenario.look)
        self.now_us = 0
        self._surroundings = surroundings(scenario, seed)
        self._client = client = open_client(STEP_US)
        self._obstacles: list[int] = []
        self._movers: list[tuple[Mover, ThingBodies]] = []
        self._add_things()
        self._light = LightBodies(client, scenario.light, light_begin(scenario.light, seed)) if scenario.light else None
        self._obstacles += self._light.bodies if self._light else ()
        reach = outline(robot)
        self._front_m = reach.front_m
        self._reach_m = math.hypot(max(reach.front_m, reach.rear_m), reach.half_width_m)
        self._walkers = [one for one in self._movers[1:] if isinstance(one[1].thing, OnPath)]
        self._sides: dict[int, bool] = {}
        self._passes = 0
        self._motors = [Motor(robot.wheels, STEP_US / 1e6, f"{seed} {side}") for side in ("left", "right")]
        self._see(client)
        self._defects = Defects(scenario.look, robot.camera.width_px, robot.camera.height_px, seed)
        self._lidar = Lidar(client, robot.lidar, seed)
        self._target_velocity: Vector = (0.0, 0.0, 0.0)
        self._wall_contacts = self._target_contacts = self._target_contacts_by_robot = 0

    def _see(self, client: int) -> None:
        """Prepare the bodies that the camera draws: those of now, or those of its past."""
        things = self.scenario.things + self._surroundings.things
        scenario, room = self.scenario.model_copy(update={"things": things}), self._surroundings.walls
        latency_us = 1000 * scenario.look.latency_ms
        self._past = Past(scenario, room, self.seed, STEP_US, latency_us) if latency_us else None
        bodies = [bodies for _, bodies in self._movers]
        self._scenery = self._past.scenery if self._past else Scenery(client, scenario, bodies, self._light)
        self._scene = SceneCamera(
            self._scenery.client, self._shutter.canvas, scenario.walls + room, self.seed,
            surfaces=surfaces(scenario, self.seed),
        )
        if self._past:
            self._past.record(self._now())

    def _now(self) -> Moment:
        camera = self.robot.camera
        _, angular = self._body.velocity()
        target = self._target.pose if isinstance(self.scenario.target, Rolling) else None
        return Moment(self.now_us, *self._mounted(camera.x_m, camera.z_m), angular[2], target)

    def _add_things(self) -> None:
        """Add floor, walls, target, robot, then the rest."""
        client, scenario, robot = self._client, self.scenario, self.robot
        self._floor = add_floor(client)
        self._obstacles += [add_wall(client, wall) for wall in scenario.walls + self._surroundings.walls]
        mover, target_at, way_m = begin(client, scenario.target, self.seed)
        self._target = ThingBodies(client, scenario.target, target_at, way_m, is_target=True)
        self._target_at = self._target.middle
        self._movers.append((mover, self._target))
        at = robot_start(scenario.start, target_at, robot.camera.x_m, self.seed)
        self._body = add_robot(client, robot, at)
        for number, thing in enumerate(scenario.things + self._surroundings.things, start=1):
            self._add_thing(thing, *begin_thing(thing, number, self.seed))
        for _, bodies in self._movers:
            if isinstance(bodies.thing, OnPath):
                # It has no mass that could yield, so it would push a standing robot away.
                self._body.pass_through(bodies.bodies)

    def _add_thing(self, thing: Thing, mover: Mover, at: Place, way_m: float) -> None:
        bodies = ThingBodies(self._client, thing, at, way_m, is_target=False)
        self._movers.append((mover, bodies))
        self._obstacles += bodies.bodies

    def set_wheels(self, left_rad_s: float, right_rad_s: float) -> None:
        """Set wheel speeds, forward positive; they hold until the next call. Raises ValueError unless finite."""
        self._motors[0].set(left_rad_s)
        self._motors[1].set(right_rad_s)

    def step(self) -> None:
        """Advance by `STEP_US`."""
        for mover, bodies in self._movers:
            mover.move(bodies, self.now_us + STEP_US)
        if self._light:
            self._light.move(self.now_us + STEP_US)
        self._body.drive(self._motors[0].step(), self._motors[1].step())
        pybullet.stepSimulation(physicsClientId=self._client)
        self.now_us += STEP_US
        for motor, angle_rad in zip(self._motors, self._body.wheel_angles(), strict=True):
            motor.rolled(angle_rad)
        self._follow_target()
        self._count_contacts()
        self._count_passes()
        if self._past:
            self._past.record(self._now())

    def _follow_target(self) -> None:
        before, self._target_at = self._target_at, self._target.middle
        rate = 1e6 / STEP_US
        x, y, z = ((now - then) * rate for now, then in zip(self._target_at, before, strict=True))
        self._target_velocity = (x, y, z)

    def _count_contacts(self) -> None:
        touched = {
            point[2]
            for point in pybullet.getContactPoints(self._body.body, physicsClientId=self._client)
            if point[8] <= 0
        } - {self._floor, self._body.body} | self._overlapped()
        target = touched.intersection(self._target.bodies)
        self._wall_contacts += bool(touched - target)
        if target:
            self._target_contacts += 1
            self._target_contacts_by_robot += self._is_robots_doing()

    def _overlapped(self) -> set[int]:
        """Return the bodies on a path that the robot overlaps. The engine does not let the two push each other."""
        (x_m, y_m, _), _ = self._body.pose()
        return {
            body for _, walker in self._movers if isinstance(walker.thing, OnPath)
            if math.dist((x_m, y_m), walker.middle[:2]) < self._reach_m + walker.thing.swept_m
            for body in walker.bodies
            if any(point[8] <= 0 for point in pybullet.getClosestPoints(
                self._body.body, body, 0.0, physicsClientId=self._client))
        }

    def _count_passes(self) -> None:
        """Count each thing on a path that passes between the lens and the target."""
        camera = self.robot.camera
        (lens_x_m, lens_y_m, _), _ = self._mounted(camera.x_m, camera.z_m)
        x_m, y_m = self._target_at[0] - lens_x_m, self._target_at[1] - lens_y_m
        for _, walker in self._walkers:
            off_x_m, off_y_m = walker.middle[0] - lens_x_m, walker.middle[1] - lens_y_m
            is_left = x_m * off_y_m - y_m * off_x_m > 0
            is_between = 0 < x_m * off_x_m + y_m * off_y_m < x_m**2 + y_m**2
            self._passes += is_between and self._sides.get(walker.bodies[0], is_left) != is_left
            self._sides[walker.bodies[0]] = is_left

    def _is_robots_doing(self) -> bool:
        """Return True if the robot moves toward the target faster than the target toward the robot."""
        (x_m, y_m, _), _ = self._body.pose()
        ahead_x_m, ahead_y_m = self._target_at[0] - x_m, self._target_at[1] - y_m
        gap_m = max(math.hypot(ahead_x_m, ahead_y_m), 1e-6)
        mine, _ = self._body.velocity()
        other = self._target_velocity
        mine_mps = (mine[0] * ahead_x_m + mine[1] * ahead_y_m) / gap_m
        other_mps = -(other[0] * ahead_x_m + other[1] * ahead_y_m) / gap_m
        return mine_mps > max(other_mps, STANDING_MPS)

    def wheel_angles(self) -> WheelAngles:
        """Return the angles that the encoders count."""
        return WheelAngles(self._motors[0].angle_rad, self._motors[1].angle_rad, self.now_us)

    def wheels_turned(self) -> tuple[float, float]:
        """Return the angle of each wheel over the floor, rad, not quantized, for logs."""
        return self._body.wheel_angles()

    def scan(self) -> Ranges:
        """Return the scan of the lidar now."""
        lidar = self.robot.lidar
        place, turn = self._mounted(lidar.x_m, lidar.z_m)
        return self._lidar.scan(place, _yaw(turn), self.now_us)

    def render(self, quality_percent: int = 100, scale_percent: int = 100) -> bytes:
        """Return the camera image now as JPEG, at shares of the configured quality and side lengths."""
        moment = self._past.show() if self._past else self._now()
        casters = self._scenery.hulls() if self.scenario.look.shadows else ()
        drawn = self._scene.draw(moment.place, moment.turn, casters)
        picture = self._shutter.exposed(drawn, moment.turn_rad_s)
        return self._defects.jpeg(picture, quality_percent, scale_percent, moment.t_us)

    def labels(self) -> tuple[Label, ...]:
        """Return the labels of an image now, if the scenario has labels."""
        people = [bodies for bodies in self._scenery.things if bodies.thing.shape == self.scenario.labels]
        moment = self._past.show() if self._past else self._now()
        return leg_labels(self._scenery.client, people, self._shutter, moment)

    def _mounted(self, x_m: float, z_m: float) -> tuple[Vector, Any]:
        """Return position and orientation of a part of the robot."""
        return pybullet.multiplyTransforms(*self._body.pose(), (x_m, 0, z_m), (0, 0, 0, 1))  # type: ignore[no-any-return]

    def truth(self) -> Truth:
        """Return the true state now."""
        place, turn = self._body.pose()
        yaw_rad = _yaw(turn)
        linear, angular = self._body.velocity()
        lens, _ = self._mounted(self.robot.camera.x_m, self.robot.camera.z_m)
        x_m, y_m = self._target_at[0] - lens[0], self._target_at[1] - lens[1]
        bearing_rad = math.remainder(math.atan2(y_m, x_m) - yaw_rad, math.tau)
        return Truth(
            t_us=self.now_us, x_m=place[0], y_m=place[1], yaw_rad=yaw_rad,
            linear_mps=linear[0] * math.cos(yaw_rad) + linear[1] * math.sin(yaw_rad), angular_rad_s=angular[2],
            target_x_m=self._target_at[0], target_y_m=self._target_at[1], target_z_m=self._target_at[2],
            bearing_rad=bearing_rad, distance_m=math.hypot(x_m, y_m), visible=self._sees(lens, bearing_rad),
            wall_contacts=self._wall_contacts, target_contacts=self._target_contacts,
            target_contacts_by_robot=self._target_contacts_by_robot,
            clearance_m=self._clearance_m() if self.scenario.goals_m else None,
            passes=self._passes,
            light=self._light.state if self._light else "",
            past_line_m=self._past_line_m(place, yaw_rad),
        )

    def _clearance_m(self) -> float:
        """Return the distance from the robot's body to the nearest obstacle, at most `CLEARANCE_SEEN_M`."""
        nearest_m = CLEARANCE_SEEN_M
        for obstacle in self._obstacles:
            for point in pybullet.getClosestPoints(
                self._body.body, obstacle, nearest_m, physicsClientId=self._client
            ):
                nearest_m = min(nearest_m, point[8])
        return nearest_m

    def _past_line_m(self, place: Vector, yaw_rad: float) -> float | None:
        """Return the distance of the robot's front beyond the stop line of the light, in m."""
        if self.scenario.light is None:
            return None
        front = (place[0] + self._front_m * math.cos(yaw_rad), place[1] + self._front_m * math.sin(yaw_rad))
        return self.scenario.light.past_line_m(*front)

    def _sees(self, lens: Vector, bearing_rad: float) -> bool:
        if abs(bearing_rad) > math.radians(self.robot.camera.hfov_deg) / 2:
            return False
        hit = pybullet.rayTest(lens, self._target_at, collisionFilterMask=WALL, physicsClientId=self._client)[0]
        return bool(hit[0] < 0)

    def close(self) -> None:
        """Free PyBullet's memory; idempotent."""
        if self._past:
            self._past.close()
        if pybullet.isConnected(self._client):
            pybullet.disconnect(self._client)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _yaw(turn: Any) -> float:
    return float(pybullet.getEulerFromQuaternion(turn)[2])
