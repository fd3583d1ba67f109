"""Mission `goto`: footprint, progress checker, and driving to waypoints. Pure."""

import math
from typing import Annotated, ClassVar, Self

import numpy as np
from pydantic import Field, model_validator

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, Pose, Twist
from sightline.vision_side.config import LatencyConfig
from sightline.vision_side.missions.planner import CELL_M, Costmap, Planner, Point
from sightline.vision_side.missions.port import Plan, RangeScan, View
from sightline.vision_side.missions.ranges import Points, PoseMemory, about_robot, echoes, in_odometry
from sightline.vision_side.tracking.prediction import MotionPredictor, PredictedMotion
from sightline.vision_side.tracking.track import to_odometry

_STILL_MPS = 1e-6


class Footprint(Config):
    """A rectangle around the midpoint of the axle. The defaults are those of the Thymio."""

    front_m: Annotated[float, Field(ge=0, le=2)] = 0.08
    rear_m: Annotated[float, Field(ge=0, le=2)] = 0.03
    half_width_m: Annotated[float, Field(gt=0.01, le=2)] = 0.056

    @property
    def radius_m(self) -> float:
        """Return the radius of the circle around the axle that contains the robot in every direction."""
        return math.hypot(max(self.front_m, self.rear_m), self.half_width_m)

    def nearest(self, points: Points) -> Points:
        """Return the point of the footprint nearest to each of `points`, relative to the robot."""
        return np.column_stack([np.clip(points[:, 0], -self.rear_m, self.front_m),
                                np.clip(points[:, 1], -self.half_width_m, self.half_width_m)])


def braking_mps(room_m: float, delay_s: float, brake_mps2: float) -> float:
    """Return the highest speed from which the robot stops within `room_m`, if it brakes after `delay_s`."""
    if room_m <= 0:
        return 0.0
    lost = brake_mps2 * delay_s
    return math.sqrt(lost * lost + 2 * brake_mps2 * room_m) - lost


def clear_of(points: Points, body: Footprint, twist: tuple[float, float], keep_m: float, brake_mps2: float) -> float:
    """Return the share (0..1) of `twist` that keeps the robot at least `keep_m` from all `points`.

    Only speed toward a point counts. Motion along a wall or away from it is not limited.
    """
    if not len(points):
        return 1.0
    spots = body.nearest(points)
    away = points - spots
    clearance = np.hypot(away[:, 0], away[:, 1])
    normal = away / np.maximum(clearance, 1e-6)[:, None]
    closing = normal[:, 0] * (twist[0] - twist[1] * spots[:, 1]) + normal[:, 1] * twist[1] * spots[:, 0]
    allowed = np.sqrt(2 * brake_mps2 * np.maximum(clearance - keep_m, 0.0))
    towards = closing > _STILL_MPS
    return float(min(1.0, (allowed[towards] / closing[towards]).min(initial=1.0)))


# The decision "cannot reach": every visible way is closed, or there is no progress for too long. Pure.


_GAIN_M = 0.1
_DETOUR_M, _MAX_DETOURS = 0.3, 8
_APPLIED = 1e-3
_MOVED_M, _MOVED_RAD = 0.02, 0.1


class ProgressCheckerConfig(Config):
    """Waiting times before the mission ends without success."""

    closed_s: Annotated[float, Field(ge=0, le=60)] = 1.5
    """Waiting time with every way closed. A false echo or a passer-by may disappear."""
    stuck_s: Annotated[float, Field(gt=0, le=3600)] = 20.0
    """Longest time of driving without progress on the known way and without new obstacles."""


class ProgressChecker:
    """Counts the time without progress."""

    def __init__(self, config: ProgressCheckerConfig) -> None:
        self._config = config
        self.start_again()

    def start_again(self) -> None:
        """Reset for a new goal."""
        self._closed_s = self._stuck_s = 0.0
        self._best_m = math.inf
        self._discoveries = -1
        self._detours = 0
        self._stands_at: Pose | None = None

    def step(self, view: View, left_m: float | None, discoveries: int) -> str:
        """Return the reason to give up, or "". `left_m` is the rest of the way, None if there is no way.

        Only driving counts as being stuck. A robot that is held (disarmed, stopped) may wait forever.
        """
        if left_m is None:
            self._closed_s += view.dt_s
            return "every way that was seen is closed" if self._closed_s >= self._config.closed_s else ""
        self._closed_s = 0.0
        if discoveries != self._discoveries:
            self._discoveries, self._best_m, self._stuck_s, self._detours = discoveries, left_m, 0.0, 0
        elif left_m < self._best_m - _GAIN_M:
            self._best_m, self._stuck_s = left_m, 0.0
        else:
            self._wait(view, left_m)
        if self._stuck_s < self._config.stuck_s:
            return ""
        no_motion = "its wheels are commanded, but it does not move: check motors and encoders"
        return no_motion if self._stands_at else f"no progress in {self._config.stuck_s:.0f} s"

    def _wait(self, view: View, left_m: float) -> None:
        """Wait for progress.

        A few longer plans do not count as a standstill, because the robot must drive them first.
        """
        if left_m > self._best_m + _DETOUR_M and self._detours < _MAX_DETOURS:
            self._best_m = left_m
            self._detours += 1
        if max(map(abs, view.header.applied)) > _APPLIED:
            pose = view.header.pose
            self._stands_at = pose if not self._stuck_s else self._stands_at
            if self._stands_at and (math.dist(pose[:2], self._stands_at[:2]) > _MOVED_M
                                    or abs(pose[2] - self._stands_at[2]) > _MOVED_RAD):
                self._stands_at = None
            self._stuck_s += view.dt_s


# Mission `goto`: drive to waypoints around obstacles that short-range sensors detect, or report a failure. Pure.
#
# The robot drives straight to the goal if no known obstacle is between them. Otherwise it drives along the wall, at the
# clearance, on the shortest way around the known obstacles. The sensor range limits the speed: an obstacle just beyond
# the range must still leave the clearance. Waypoints are in the odometry frame, in meters.


Meters = Annotated[float, Field(ge=-100, le=100)]

_NEAR_M = 0.8  # the brake ignores points beyond this distance
_BRAKE_SLACK_M = 0.017  # for steering errors and cells of 0.03 m, and so that the robot can still turn after it stopped
_ROOMY_M = 0.03  # extra clearance without a long detour, so that the brake does not act next to a wall
_OUTSIDE_M = 1.2 * CELL_M  # with the nearest free cell further away, the robot is too near to an obstacle
_SHY_RAD_S = 0.4
_WHEELS_S = 0.03  # delay of the wheels behind the speed ramp of the gate
_TURN_RAD = math.radians(25)  # a turn by more than this brings the robot's corners to the front
_CORNER_SLACK_M = 0.002
_SIDE_RAD, _SIDE_M = math.radians(45), 0.15  # least advantage of a way on the other side of an obstacle


class GotoConfig(Config):
    """Goal, robot and clearance of a `goto` mission."""

    waypoints: Annotated[tuple[tuple[Meters, Meters], ...], Field(min_length=1, max_length=64)]
    """(x, y) in the odometry frame, in their order."""
    body: Footprint = Footprint()
    sensor_x_m: Annotated[float, Field(ge=-2, le=2)] = 0.0
    """Position of the range sensor, forward of the axle."""
    sight_m: Annotated[float, Field(gt=0, le=50)] = 0.2
    """Range of the sensors beyond the robot's front. It limits the speed into unknown space."""
    clearance_m: Annotated[float, Field(ge=0.01, le=2)] = 0.112
    """Least distance between the robot's outline and any echo."""
    tolerance_m: Annotated[float, Field(ge=0.01, le=1)] = 0.05
    max_linear_mps: Annotated[float, Field(gt=0, le=2)] = 0.5
    max_angular_rad_s: Annotated[float, Field(gt=0, le=6)] = 2.5
    bearing_kp: Annotated[float, Field(gt=0, le=20)] = 5.0
    """Gain of the bearing, 1/s. Times latency it never exceeds 0.9, as for following."""
    drive_within_rad: Annotated[float, Field(gt=0, le=1.5)] = 0.7
    """Forward speed fades to zero as the bearing of the way grows to this value."""
    brake_mps2: Annotated[float, Field(gt=0, le=10)] = 0.8
    """Assumed deceleration for stopping; less than the robot can reach."""
    creep_mps: Annotated[float, Field(gt=0, le=1)] = 0.1
    """Speed for backing out."""
    max_scan_age_s: Annotated[float, Field(gt=0, le=2)] = 0.4
    patience: ProgressCheckerConfig = ProgressCheckerConfig()
    latency: LatencyConfig = LatencyConfig()

    @model_validator(mode="after")
    def _must_see_beyond_the_clearance(self) -> Self:
        least_m = self.clearance_m + _BRAKE_SLACK_M
        if self.sight_m <= least_m:
            raise ValueError(f"sight_m of {self.sight_m:g} m must be more than {least_m:g} m, that is clearance_m and "
                             f"{_BRAKE_SLACK_M:g} m: with less the robot would never move")
        return self


class Goto:
    """Drives to each waypoint in turn."""

    Config = GotoConfig
    wants_scan: ClassVar[bool] = True
    needs_camera: ClassVar[bool] = False

    def __init__(self, config: GotoConfig, camera: CameraModel) -> None:  # noqa: ARG002  part of the interface
        self._config = config
        self._keep_m = config.body.radius_m + config.clearance_m
        self._ground = Costmap()
        self._poses = PoseMemory()
        self._motion_predictor = MotionPredictor(config.latency)
        self._patience = ProgressChecker(config.patience)
        self._reached = 0
        self._route: Planner | None = None
        self._planned = -1
        self._scan: RangeScan | None = None
        self._carrot: Point | None = None
        self._ended: Plan | None = None

    def step(self, view: View) -> Plan:
        """Compute the twist toward the next waypoint."""
        self._poses.add(view.header)
        self._motion_predictor.measure(view.header.latency_us, view.dt_s)
        self._look(view)
        plan = self._ended or self._next(view)
        if plan.done:
            self._ended = plan
        self._motion_predictor.sent(view.header.t_us, plan.twist)
        return plan

    def _look(self, view: View) -> None:
        """Add a new scan to the costmap."""
        scan = view.scan
        if scan is None or (self._scan is not None and scan.t_us <= self._scan.t_us):
            return
        self._scan = scan
        pose, sensor_x_m = self._poses.at(scan.t_us), self._config.sensor_x_m
        self._ground.see(to_odometry(pose, sensor_x_m, 0.0), in_odometry(echoes(scan, sensor_x_m), pose))

    def _next(self, view: View) -> Plan:
        if self._scan is None or view.header.t_us - self._scan.t_us > self._config.max_scan_age_s * 1e6:
            return Plan(STILL, "no ranges", "the range sensors are silent; without them nothing moves")
        while math.dist(view.header.pose[:2], self._goal()) <= self._config.tolerance_m:
            self._reached += 1
            self._route = self._carrot = None
            self._patience.start_again()
            if self._reached == len(self._config.waypoints):
                return Plan(STILL, "arrived", self._score(), done=True)
        return self._towards(view)

    def _goal(self) -> Point:
        return self._config.waypoints[min(self._reached, len(self._config.waypoints) - 1)]

    def _score(self) -> str:
        return f"reached {self._reached} of {len(self._config.waypoints)}"

    def _towards(self, view: View) -> Plan:
        robot = (view.header.pose[0], view.header.pose[1])
        route = self._plan(robot)
        entry = route.entry(robot, self._config.clearance_m + 2 * CELL_M)
        left_m = route.left_m(entry) if entry else None
        reason = self._patience.step(view, left_m, self._ground.discoveries)
        if reason:
            return Plan(STILL, "cannot reach", f"{self._score()}: cannot reach waypoint {self._reached + 1}: {reason}",
                        done=True)
        if entry is None:
            return Plan(STILL, "closed in", self._score())
        out = route.middle(entry)
        if math.dist(out, robot) > _OUTSIDE_M and self._room(self._then(view)) is not None:
            return self._leave(view, out)
        self._carrot = self._chosen(route, robot, route.carrot(robot, entry), route.left_m(entry))
        return self._drive(view, route, self._carrot)

    def _leave(self, view: View, out: Point) -> Plan:
        """Leave an obstacle that is too near: straight forward or backward, then turn where there is room."""
        then = self._then(view)
        bearing_rad = _bearing(then.pose, self._room(then) or out)
        backs = abs(bearing_rad) > math.pi / 2
        turn_rad = math.remainder(bearing_rad + math.pi, math.tau) if backs else bearing_rad
        creep = self._config.creep_mps * max(0.0, math.cos(1.3 * turn_rad))
        twist = self._braked(then.pose, -creep if backs else creep, max(-_SHY_RAD_S, min(_SHY_RAD_S, 2 * turn_rad)))
        return Plan(twist, "backing out" if backs else "going out", self._score())

    def _room(self, then: PredictedMotion) -> Point | None:
        """Return the point to approach slowly before a turn, so that the corners of the robot keep their clearance.

        It is computed for the place where the robot can stop. A robot that still moves toward a wall must not turn yet.
        """
        rolls_m = then.linear_mps * abs(then.linear_mps) / (2 * self._config.brake_mps2)
        pose: Pose = (*to_odometry(then.pose, rolls_m, 0.0), then.pose[2])
        points = about_robot(self._ground.points(), pose)
        if not len(points):
            return None
        away_m = np.hypot(points[:, 0], points[:, 1])
        x, y = points[int(np.argmin(away_m))].tolist()
        if away_m.min() >= self._keep_m - _CORNER_SLACK_M or abs(x) < abs(y):
            return None
        return to_odometry(pose, -math.copysign(0.1, x), 0.0)

    def _then(self, view: View) -> PredictedMotion:
        """Predict the robot at the time when the command acts."""
        header = view.header
        return self._motion_predictor.motion(header.t_us, header.pose, header.moving, header.applied)

    def _chosen(self, route: Planner, robot: Point, carrot: Point, left_m: float) -> Point:
        """Return `carrot`, or the previous one if that is on another side and its way is hardly longer."""
        old = self._carrot
        if old is None or math.dist(robot, old) < self._config.clearance_m or not route.sees(robot, old):
            return carrot
        aside_rad = _bearing((*robot, 0.0), carrot) - _bearing((*robot, 0.0), old)
        if abs(math.remainder(aside_rad, math.tau)) < _SIDE_RAD:
            return carrot
        return old if math.dist(robot, old) + route.left_from(old) < left_m + _SIDE_M else carrot

    def _plan(self, robot: Point) -> Planner:
        route = self._route
        if route is None or self._planned != self._ground.version or not route.covers(robot):
            route = self._route = Planner(self._ground.cells(), robot, self._goal(), self._keep_m,
                                        self._keep_m + _ROOMY_M)
            self._planned = self._ground.version
        return route

    def _drive(self, view: View, route: Planner, carrot: Point) -> Plan:
        header, config, then = view.header, self._config, self._then(view)
        bearing_rad = _bearing(then.pose, carrot)
        room = self._room(then) if abs(bearing_rad) > _TURN_RAD else None
        if room is not None:
            return self._leave(view, room)
        goal_m = math.dist(header.pose[:2], route.goal)
        linear = self._speed(math.dist(then.pose[:2], route.goal), bearing_rad, self._sight_mps(then))
        kp = min(config.bearing_kp, 0.9 / max(self._motion_predictor.latency_s, 1e-3))
        angular = max(-config.max_angular_rad_s, min(config.max_angular_rad_s, kp * bearing_rad))
        phase = "to goal" if carrot == route.goal else "along wall"
        note = f"{self._score()}, {goal_m:.2f} m to waypoint {self._reached + 1}"
        return Plan(self._braked(then.pose, linear, angular), phase, note,
                    bearing_rad=_bearing(header.pose, route.goal), distance_m=goal_m)

    def _speed(self, goal_m: float, bearing_rad: float, sight_mps: float) -> float:
        """Limit the speed by the remaining distance, the heading error and the sensor range."""
        config = self._config
        fade = max(0.0, 1.0 - (bearing_rad / config.drive_within_rad) ** 2)
        arriving = max(0.03, min(braking_mps(goal_m, 0.1, config.brake_mps2 / 2), 2.0 * goal_m))
        return min(arriving, fade * config.max_linear_mps, fade * sight_mps)

    def _sight_mps(self, then: PredictedMotion) -> float:
        """Limit the speed so that an obstacle just beyond the sensor range still leaves the clearance.

        The range starts at the place of the newest scan, so the speed decreases when scans are late or lost.
        """
        config = self._config
        seen_from = self._poses.at(self._scan.t_us) if self._scan else then.pose
        room_m = config.sight_m - config.clearance_m - _BRAKE_SLACK_M - math.dist(seen_from[:2], then.pose[:2])
        return braking_mps(room_m, _WHEELS_S, config.brake_mps2)

    def _braked(self, pose: Pose, linear: float, angular: float) -> Twist:
        """Slow down the twist toward known obstacles."""
        points = about_robot(self._ground.points(), pose)
        near = points[(abs(points) < _NEAR_M).all(axis=1)]
        keep_m = self._config.clearance_m + _BRAKE_SLACK_M
        share = clear_of(near, self._config.body, (linear, 0.0), keep_m, self._config.brake_mps2)
        return Twist(linear_mps=linear * share, angular_rad_s=angular)


def _bearing(pose: Pose, point: Point) -> float:
    """Return the bearing of a point, left positive, within half a turn."""
    return math.remainder(math.atan2(point[1] - pose[1], point[0] - pose[0]) - pose[2], math.tau)
