"""A flat world for missions that drive by range sensors: walls, posts, a unicycle with limits, delayed and lossy legs.

It knows nothing of PyBullet or transports; truth is exact, all randomness is seeded, time is virtual.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sightline.protocol.messages import STILL, FrameHeader, Pose, Twist
from tests.vision_rig import camera
from sightline.vision_side.decode import Picture
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.body import Footprint
from sightline.vision_side.missions.port import Mission, Plan, RangeScan, View
from sightline.vision_side.missions.ranging import about_robot

TICK_US = 10_000
FRAME_US = 33_333
SCAN_US = 100_000
LAG_S = 0.05
LOOK_US = 40_000  # how often the clearance is measured: the robot has moved by 1 cm
Segment = tuple[float, float, float, float]
"""x1, y1, x2, y2."""
Post = tuple[float, float, float]
"""x, y, radius."""


@dataclass(frozen=True)
class Course:
    """What stands on the floor."""

    walls: tuple[Segment, ...] = ()
    posts: tuple[Post, ...] = ()

    def outline(self, step_m: float = 0.005) -> np.ndarray:
        """Points on every surface."""
        parts = [np.empty((0, 2))]
        for x1, y1, x2, y2 in self.walls:
            share = np.linspace(0, 1, max(2, math.ceil(math.hypot(x2 - x1, y2 - y1) / step_m)))[:, None]
            parts.append(np.array([x1, y1]) * (1 - share) + np.array([x2, y2]) * share)
        for x, y, radius in self.posts:
            turn = np.linspace(0, math.tau, math.ceil(math.tau * radius / step_m), endpoint=False)
            parts.append(np.column_stack([x + radius * np.cos(turn), y + radius * np.sin(turn)]))
        return np.vstack(parts)

    def ranges(self, x_m: float, y_m: float, angles_rad: np.ndarray, reach_m: float) -> np.ndarray:
        """How far each ray from (`x_m`, `y_m`) goes; inf where it meets nothing within its reach."""
        dx, dy = np.cos(angles_rad), np.sin(angles_rad)
        best = np.full(len(angles_rad), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for x1, y1, x2, y2 in self.walls:
                ex, ey = x2 - x1, y2 - y1
                cross = dx * ey - dy * ex
                along = ((x1 - x_m) * ey - (y1 - y_m) * ex) / cross
                share = ((x1 - x_m) * dy - (y1 - y_m) * dx) / cross
                best = np.where((along > 0) & (share >= 0) & (share <= 1), np.minimum(best, along), best)
            for x, y, radius in self.posts:
                ahead = (x - x_m) * dx + (y - y_m) * dy
                off = (x - x_m) ** 2 + (y - y_m) ** 2 - ahead**2
                along = ahead - np.sqrt(radius**2 - off)
                best = np.where((off < radius**2) & (along > 0), np.minimum(best, along), best)
        return np.where(best <= reach_m, best, np.inf)


@dataclass(frozen=True)
class Eyes:
    """Small sensors at their own places, merged into one scan about (`at_x_m`, 0)."""

    places: tuple[tuple[float, float, float], ...] = (
        (0.077, 0.0, 0.0), (0.065, 0.053, math.pi / 2), (0.065, -0.053, -math.pi / 2))
    """x, y, facing."""
    rays: int = 13
    half_span_rad: float = 1.5
    reach_m: float = 0.2
    at_x_m: float = 0.0
    merged: int = 120

    def scan(self, course: Course, pose: Pose, t_us: int) -> RangeScan:
        """One merged scan: each echo in the slot that it is seen in; the nearest one of a slot counts."""
        slots = np.full(self.merged, np.inf, np.float32)
        step = math.tau / self.merged
        for x, y, facing in self.places:
            angles = facing + np.linspace(-self.half_span_rad, self.half_span_rad, self.rays)
            cos, sin = math.cos(pose[2]), math.sin(pose[2])
            at = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y
            ranges = course.ranges(*at, angles + pose[2], self.reach_m)
            for one, angle in zip(ranges, angles, strict=True):
                if math.isfinite(one):
                    ex, ey = x + one * math.cos(angle) - self.at_x_m, y + one * math.sin(angle)
                    slot = round((math.atan2(ey, ex) + math.pi) / step) % self.merged
                    slots[slot] = min(slots[slot], math.hypot(ex, ey))
        return RangeScan(t_us, -math.pi, step, 0.01, 0.3, slots)


@dataclass(frozen=True)
class Lidar:
    """One turning sensor."""

    at_x_m: float = 0.055
    rays: int = 360
    reach_m: float = 8.0
    noise_m: float = 0.0

    def scan(self, course: Course, pose: Pose, t_us: int) -> RangeScan:
        """All around."""
        angles = -math.pi + np.arange(self.rays) * math.tau / self.rays
        at = pose[0] + self.at_x_m * math.cos(pose[2]), pose[1] + self.at_x_m * math.sin(pose[2])
        ranges = course.ranges(*at, angles + pose[2], self.reach_m).astype(np.float32)
        if self.noise_m:
            draw = np.random.default_rng(t_us)
            ranges = (ranges + draw.normal(0, self.noise_m, self.rays)).astype(np.float32)
        return RangeScan(t_us, -math.pi, math.tau / self.rays, 0.05, self.reach_m, ranges)


Sight = tuple[tuple[Detection, ...], Picture | None]


@dataclass
class Row:
    """One line of the run, from the world itself."""

    t_s: float
    pose: Pose
    moving: tuple[float, float]
    clearance_m: float
    plan: Plan | None


@dataclass
class Drive:
    """One run. `latency_s` is added in all, half on each leg; `loss` on each leg."""

    mission: Mission
    course: Callable[[float], Course] | Course
    start: Pose = (0.0, 0.0, 0.0)
    sensor: Eyes | Lidar = field(default_factory=Eyes)
    body: Footprint = field(default_factory=Footprint)
    latency_s: float = 0.05
    loss: float = 0.1
    seed: int = 1
    compute_s: float = 0.01
    limits: tuple[float, float] = (0.5, 2.5)
    acceleration: tuple[float, float] = (1.0, 10.0)
    odometry_scale: float = 1.0
    held_until_s: float = 0.0
    scan_us: int = SCAN_US
    eye: Callable[[Pose, float], Sight] = lambda pose, t_s: ((), None)
    """What is in view from a pose at a time, and the picture."""

    def run(self, seconds: float, until_done: bool = True) -> list[Row]:
        """Drive for `seconds` of virtual time, or until the mission is over and the wheels stand."""
        self._set_up()
        rows: list[Row] = []
        for t_us in range(0, round(seconds * 1e6), TICK_US):
            rows.append(self._tick(t_us))
            if until_done and self._plan and self._plan.done and rows[-1].moving == (0.0, 0.0):
                break
        return rows

    def _set_up(self) -> None:
        self._rng = random.Random(self.seed)
        self._lens = camera()
        self._pose, self._odometry = self.start, self.start
        self._moving, self._applied = (0.0, 0.0), (0.0, 0.0)
        self._frame_us, self._scan_us, self._seq = self._rng.randrange(FRAME_US), self._rng.randrange(self.scan_us), 0
        self._up: list[tuple[int, FrameHeader, Sight]] = []
        self._scans: list[tuple[int, RangeScan]] = []
        self._scan: RangeScan | None = None
        self._down: list[tuple[int, int, Twist]] = []
        self._command: tuple[int, int, Twist] | None = None
        self._latency_us: int | None = None
        self._last_us: int | None = None
        self._plan: Plan | None = None

    def _tick(self, t_us: int) -> Row:
        course = self.course if isinstance(self.course, Course) else self.course(t_us / 1e6)
        half_us = round(self.latency_s * 5e5)
        if t_us >= self._scan_us:
            self._scan_us += self.scan_us
            if self._rng.random() >= self.loss:
                self._scans.append((t_us + half_us, self.sensor.scan(course, self._pose, t_us)))
        if t_us >= self._frame_us:
            self._frame_us += FRAME_US
            self._seq += 1
            if self._rng.random() >= self.loss:
                self._up.append((t_us + half_us, self._header(t_us), self.eye(self._pose, t_us / 1e6)))
        self._answer(t_us, half_us)
        self._obey(t_us)
        self._move()
        if t_us % LOOK_US == 0:
            away = about_robot(self._outline(course), self._pose)
            self._clear_m = float(np.hypot(*(away - self.body.nearest(away)).T).min(initial=9.9))
        return Row(t_us / 1e6, self._pose, self._moving, self._clear_m, self._plan)

    def _outline(self, course: Course) -> np.ndarray:
        if getattr(self, "_drawn", None) is not course:
            self._drawn, self._points = course, course.outline()
        return self._points

    def _header(self, t_us: int) -> FrameHeader:
        return FrameHeader(session="0000abcd", seq=self._seq, t_us=t_us, pose=self._odometry, moving=self._moving,
                           applied=self._applied, latency_us=self._latency_us)

    def _answer(self, t_us: int, half_us: int) -> None:
        while self._scans and self._scans[0][0] <= t_us:
            self._scan = self._scans.pop(0)[1]
        while self._up and self._up[0][0] <= t_us:
            _, header, (detections, picture) = self._up.pop(0)
            dt_s = min(0.5, (header.t_us - self._last_us) / 1e6) if self._last_us is not None else 0.0
            self._last_us = header.t_us
            view = View(header, dt_s, self.latency_s + 0.04, self._lens, detections, picture, self._scan)
            self._plan = self.mission.step(view)
            if self._rng.random() >= self.loss:
                due = t_us + half_us + round(self.compute_s * 1e6)
                self._down.append((due, header.t_us, STILL if self._plan.done else self._plan.twist))

    def _obey(self, t_us: int) -> None:
        """The gate in short: newest command, silence, limits on speed and acceleration."""
        while self._down and self._down[0][0] <= t_us:
            self._command = (t_us, *self._down.pop(0)[1:])
            self._latency_us = t_us - self._command[1]
        wanted = (0.0, 0.0)
        if self._command and t_us >= self.held_until_s * 1e6 and t_us - self._command[0] < 300_000:
            twist = self._command[2]
            excess = max(abs(twist.linear_mps) / self.limits[0], abs(twist.angular_rad_s) / self.limits[1], 1.0)
            wanted = (twist.linear_mps / excess, twist.angular_rad_s / excess)
        step = TICK_US / 1e6
        self._applied = tuple(now + max(-limit * step, min(limit * step, goal - now))
                              for now, goal, limit in zip(self._applied, wanted, self.acceleration, strict=True))

    def _move(self) -> None:
        step = TICK_US / 1e6
        moving = tuple(now + (goal - now) * step / LAG_S for now, goal in zip(self._moving, self._applied, strict=True))
        self._moving = tuple(0.0 if abs(one) < 1e-4 else one for one in moving)
        self._pose = _moved(self._pose, self._moving, step)
        self._odometry = _moved(self._odometry, self._moving, step * self.odometry_scale)


def _moved(pose: Pose, moving: tuple[float, float], step: float) -> Pose:
    x, y, yaw = pose
    middle = yaw + moving[1] * step / 2
    return x + moving[0] * math.cos(middle) * step, y + moving[0] * math.sin(middle) * step, yaw + moving[1] * step
