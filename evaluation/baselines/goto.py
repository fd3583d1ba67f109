"""Go-to-goal with wall following. Pure.

Two PD laws, one at a time, and a machine of three states (to the goal, left contour, right contour) at 10 Hz.
Its faults are kept: differences per step instead of per second, an angle that wraps wrongly near half a turn, a
turn by the clock, gaps between its conditions, and no memory, so that it can circle forever.
"""

import math
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, FrameHeader, Pose, Twist
from sightline.vision_side.missions.goto import Meters
from sightline.vision_side.missions.port import Plan, RangeScan, View

_STEP_US = 100_000  # it ran at 10 Hz
_REACH_M = 0.2
_RAY_RAD = 0.25  # 13 rays over 3 rad
_SENSORS = {"front": (0.077, 0.0, -1.5), "left": (0.065, 0.053, 0.0708), "right": (0.065, -0.053, -3.0708)}
"""Sensors of its robot: position ahead and left of the axle's midpoint, and the angle of the first ray."""
_SAME_RAY_RAD = 0.2


class GotoBaselineConfig(Config):
    """Numbers of the legacy law: gains per step of 0.1 s, lengths in meters, speeds in m/s and rad/s."""

    waypoints: Annotated[tuple[tuple[Meters, Meters], ...], Field(min_length=1, max_length=64)]
    position_kp: float = 0.3
    position_kd: float = 0.08
    angle_kp: float = 1.2
    angle_kd: float = 0.2
    tolerance_m: Annotated[float, Field(gt=0, le=1)] = 0.05
    tolerance_rad: Annotated[float, Field(gt=0, le=1)] = 0.05
    max_linear_mps: Annotated[float, Field(gt=0, le=2)] = 0.5
    wall_m: float = 0.13
    """Distance that it keeps from a wall, and at which it turns away from one."""
    too_near_m: float = 0.12
    off_from_m: float = 0.05
    off_to_m: float = 0.08
    """It turns while the distance error is above the first value and below the second."""
    contour_mps: Annotated[float, Field(gt=0, le=2)] = 0.1
    contour_rad_s: Annotated[float, Field(gt=0, le=6)] = 1.0
    turn_us: Annotated[int, Field(ge=0)] = 1_500_000


class GotoBaseline:
    """The three-state machine."""

    Config = GotoBaselineConfig
    wants_scan: ClassVar[bool] = True
    needs_camera: ClassVar[bool] = False

    def __init__(self, config: GotoBaselineConfig, camera: CameraModel) -> None:  # noqa: ARG002
        self._config = config
        self._reached = 0
        self._side = 0.0  # 0 to the goal, 1 left contour (the wall on the right), -1 right contour
        self._turned = False
        self._error = (10.0, 10.0, 10.0)  # x, y, angle: its initial values
        self._linear = self._angular = 0.0
        self._next_us = 0
        self._rays: dict[str, list[float]] = {}

    def step(self, view: View) -> Plan:
        """Return the twist of the last step. A new step is computed every 0.1 s."""
        if view.scan is None:
            return Plan(STILL, "no ranges", "the range sensors are silent")
        if view.header.t_us >= self._next_us:
            self._next_us = view.header.t_us + _STEP_US
            self._rays = _three_sensors(view.scan)
            self._run(view.header)
        if self._reached == len(self._config.waypoints):
            return Plan(STILL, "arrived", self._score(), done=True)
        phase = "to goal" if not self._side else "left contour" if self._side > 0 else "right contour"
        return Plan(Twist(linear_mps=self._linear, angular_rad_s=self._angular), phase, self._score())

    def _score(self) -> str:
        return f"reached {self._reached} of {len(self._config.waypoints)}"

    def _run(self, header: FrameHeader) -> None:
        if self._reached == len(self._config.waypoints):
            return
        if self._side:
            self._contour(header)
        else:
            self._navigate(header.pose)

    def _errors(self, pose: Pose) -> tuple[float, float, float]:
        """Return the errors in x, y and angle, with the angle wrap of the legacy law."""
        goal = self._config.waypoints[self._reached]
        dx, dy = goal[0] - pose[0], goal[1] - pose[1]
        yaw = abs(pose[2]) if abs(pose[2]) > 3 else pose[2]
        angle = math.atan2(dy, dx) - yaw
        if abs(angle) > 3:
            angle = 3.14 - yaw + angle % 3.14
        return dx, dy, angle

    def _navigate(self, pose: Pose) -> None:
        config, before = self._config, self._error
        dx, dy, angle = self._error = self._errors((pose[0], pose[1], math.remainder(pose[2], math.tau)))
        away = math.hypot(dx, dy)
        if away > math.hypot(before[0], before[1]):
            self._linear = self._angular = 0.0
        if away <= config.tolerance_m:
            self._linear = self._angular = 0.0
            self._reached += 1
        elif abs(angle) > config.tolerance_rad:
            self._angular = config.angle_kp * angle + config.angle_kd * (angle - before[2])
        else:
            speed = config.position_kp * away + config.position_kd * math.hypot(dx - before[0], dy - before[1])
            self._linear = min(speed, config.max_linear_mps)
        self._meet()

    def _meet(self) -> None:
        """Stop for an obstacle ahead, and choose the contour by the shorter of the two center rays."""
        front = self._rays["front"]
        if min(front[6], front[7]) < _REACH_M:
            self._linear = self._angular = 0.0
            self._turned = False
            self._side = -1.0 if front[6] > front[7] else 1.0

    def _contour(self, header: FrameHeader) -> None:
        """Approach, turn for a fixed time, then follow the wall until the goal is on its side."""
        config, front = self._config, self._rays["front"]
        if self._turned:
            self._follow_wall()
            pose = header.pose
            if self._errors((pose[0], pose[1], math.remainder(pose[2], math.tau)))[2] * self._side > 0:
                self._side = 0.0
        elif max(front[6], front[7]) > config.wall_m:
            self._linear, self._angular = config.contour_mps, 0.0
        else:
            self._linear, self._angular = 0.0, self._side * config.contour_rad_s
            self._next_us = header.t_us + config.turn_us
            self._turned = True

    def _follow_wall(self) -> None:
        config, front = self._config, self._rays["front"]
        wall = self._rays["right" if self._side > 0 else "left"]
        rear = wall[3] if self._side > 0 else wall[10]
        beside = wall[7] if self._side > 0 else wall[6]
        error = (wall[6] + wall[7]) / 2 - config.wall_m
        self._linear, self._angular = 0.0, 0.0
        if -config.off_to_m < error < -config.off_from_m or min(front[6], front[7]) < config.too_near_m:
            self._angular = self._side * config.contour_rad_s
        elif config.off_from_m < error < config.off_to_m or (rear > _REACH_M and beside > _REACH_M):
            self._angular = -self._side * config.contour_rad_s
        else:
            self._linear = config.contour_mps


def _three_sensors(scan: RangeScan) -> dict[str, list[float]]:
    """Convert the scan, measured from the axle's midpoint, to the readings of each sensor, which the law needs."""
    angles = scan.angle_min_rad + np.arange(len(scan.ranges_m)) * scan.angle_increment_rad
    seen = np.isfinite(scan.ranges_m) & (scan.ranges_m <= scan.range_max_m)
    x_m, y_m = scan.ranges_m[seen] * np.cos(angles[seen]), scan.ranges_m[seen] * np.sin(angles[seen])
    return {name: _rays(x_m - ahead_m, y_m - left_m, first_rad)
            for name, (ahead_m, left_m, first_rad) in _SENSORS.items()}


def _rays(x_m: NDArray[Any], y_m: NDArray[Any], first_rad: float) -> list[float]:
    """Return the 13 rays of a sensor, each the echo nearest to its direction. Without a near echo a ray has no hit."""
    away_m, angles = np.hypot(x_m, y_m), np.arctan2(y_m, x_m)
    rays = [math.inf] * 13
    for index in range(13):
        off = np.abs(np.remainder(angles - first_rad - _RAY_RAD * index + math.pi, math.tau) - math.pi)
        off[away_m > _REACH_M] = math.inf
        if len(off) and off.min() <= _SAME_RAY_RAD:
            rays[index] = float(away_m[off.argmin()])
    return rays
