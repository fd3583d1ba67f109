"""A small closed loop for steering: unicycle with limits, delayed and lossy legs, drawn or exact sightings. Pure.

It knows nothing of PyBullet or transports; truth is exact, all randomness is seeded, time is virtual.
"""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np

from sightline.protocol.messages import CameraModel, FrameHeader, Twist
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.pipeline import Frame, Observation, Pipeline

TICK_US = 4_000
FRAME_US = 33_333
BALL_RADIUS_M = 0.1
YELLOW_BGR = (13, 199, 242)
FLOOR_BGR = (140, 150, 155)
Path = Callable[[float], tuple[float, float]]


def camera(width_px: int = 320, height_px: int = 240, pitch_rad: float = 0.0) -> CameraModel:
    """The simulated robot's lens: 80 degrees wide, 0.055 m ahead of the axle, 0.06 m up."""
    focal_px = width_px / 2 / math.tan(math.radians(40))
    return CameraModel(width_px=width_px, height_px=height_px, fx_px=focal_px, fy_px=focal_px, cx_px=width_px / 2,
                       cy_px=height_px / 2, x_m=0.055, z_m=0.06, pitch_rad=pitch_rad, calibrated=True)


def ball_about_lens(model: CameraModel, x_m: float, y_m: float, z_m: float = BALL_RADIUS_M) -> np.ndarray:
    """(right, down, ahead) in the camera frame of a point about the axle's midpoint."""
    ahead, left, up = x_m - model.x_m, y_m - model.y_m, z_m - model.z_m
    cos, sin = math.cos(model.pitch_rad), math.sin(model.pitch_rad)
    return np.array([-left, ahead * sin - up * cos, ahead * cos + up * sin])


def draw_ball(model: CameraModel, centre: np.ndarray, picture: np.ndarray, colour: tuple[int, int, int] = YELLOW_BGR,
              radius_m: float = BALL_RADIUS_M) -> None:
    """Draw a sphere as a pinhole camera sees it, edges anti-aliased."""
    if centre[2] <= radius_m:
        return
    rows, columns = np.mgrid[0:model.height_px, 0:model.width_px] + 0.5
    right, down = (columns - model.cx_px) / model.fx_px, (rows - model.cy_px) / model.fy_px
    rays = np.stack([right, down, np.ones(rows.shape)], -1)
    length = np.linalg.norm(rays, axis=-1)
    away = np.linalg.norm(centre)
    angle = np.arccos(np.clip(rays @ centre / (length * away), -1, 1))
    pixel_rad = 1 / (model.fx_px * length)  # close enough for an edge one pixel wide
    share = np.clip((math.asin(radius_m / away) - angle) / pixel_rad + 0.5, 0, 1)[..., None]
    picture[:] = (picture * (1 - share) + np.array(colour) * share).astype(np.uint8)


def jpeg_of(picture: np.ndarray, quality: int = 80) -> bytes:
    """`picture` as baseline JPEG."""
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()


def scene(model: CameraModel, x_m: float, y_m: float, noise: float = 2.0, seed: int = 1, **ball) -> np.ndarray:
    """A plain room with one ball at (`x_m`, `y_m`) about the axle's midpoint."""
    picture = np.empty((model.height_px, model.width_px, 3), np.uint8)
    picture[:] = FLOOR_BGR
    draw_ball(model, ball_about_lens(model, x_m, y_m), picture, **ball)
    speckle = np.random.default_rng(seed).normal(0, noise, picture.shape)
    return np.clip(picture + speckle, 0, 255).astype(np.uint8)


class ExactEye:
    """A detector that is told the outline, with noise in pixels; sees nothing out of view."""

    def __init__(self, model: CameraModel, noise_px: float, rng: random.Random) -> None:
        self.model, self.noise_px, self.rng = model, noise_px, rng
        self.centre = np.zeros(3)

    def detect(self, picture: object) -> tuple[Detection, ...]:
        """The ball at `centre`, if its middle is in view."""
        model, (right, down, ahead) = self.model, self.centre.tolist()
        if ahead <= 0.15:
            return ()
        cx, cy = model.cx_px + model.fx_px * right / ahead, model.cy_px + model.fy_px * down / ahead
        if not (0 < cx < model.width_px and 0 < cy < model.height_px):
            return ()
        outline = self._outline() + np.array([self.rng.gauss(0, self.noise_px), self.rng.gauss(0, self.noise_px)])
        outline = (outline - [cx, cy]) * (1 + self.rng.gauss(0, 0.01)) + [cx, cy]
        (x1, y1), (x2, y2) = outline.min(axis=0), outline.max(axis=0)
        circle = Circle(cx, cy, (x2 - x1) / 2)
        return (Detection(x1, y1, x2, y2, 1.0, "target", circle, outline),)

    def _outline(self) -> np.ndarray:
        away = np.linalg.norm(self.centre)
        axis, alpha = self.centre / away, math.asin(BALL_RADIUS_M / away)
        one = np.cross(axis, [0.0, 1.0, 0.0])
        one /= np.linalg.norm(one)
        two = np.cross(axis, one)
        turn = np.linspace(0, 2 * math.pi, 48, endpoint=False)[:, None]
        rays = math.cos(alpha) * axis + math.sin(alpha) * (np.cos(turn) * one + np.sin(turn) * two)
        model = self.model
        return rays[:, :2] / rays[:, 2:] * (model.fx_px, model.fy_px) + (model.cx_px, model.cy_px)


@dataclass
class Truth:
    """One line of the run, taken each tick from the world itself."""

    t_s: float
    bearing_rad: float
    distance_m: float
    moving: tuple[float, float]
    robot: tuple[float, float, float]
    seen: Observation | None


@dataclass
class Rig:
    """One run. `latency_s` is added in all, half on each leg; `loss` on each leg."""

    path: Path
    latency_s: float = 0.05
    loss: float = 0.1
    seed: int = 1
    start: tuple[float, float, float] = (0.0, 0.0, 0.0)
    noise_px: float = 0.3
    drawn: bool = False
    held_until_s: float = 0.0
    odometry_scale: float = 1.0
    compute_s: float = 0.008
    config: VisionConfig = field(default_factory=VisionConfig)
    blind: Callable[[float], bool] = lambda t_s: False

    def run(self, seconds: float) -> list[Truth]:
        """Drive for `seconds` of virtual time."""
        self._set_up()
        return [self._tick(t_us) for t_us in range(0, round(seconds * 1e6), TICK_US)]

    def _set_up(self) -> None:
        self._rng = random.Random(self.seed)
        self._model = camera()
        self._eye = ExactEye(self._model, self.noise_px, self._rng)
        self.pipeline = Pipeline(self.config, self._model, None if self.drawn else self._eye)
        self._robot, self._odometry = self.start, (0.0, 0.0, 0.0)
        self._moving, self._applied, self._wanted = (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)
        self._next_frame_us, self._seq, self._latency_us = 0, 0, None
        self._up: list[tuple[int, Frame, np.ndarray]] = []
        self._down: list[tuple[int, int, Twist]] = []
        self._command: tuple[int, int, Twist] | None = None
        self._seen: Observation | None = None
        self._blank = jpeg_of(np.zeros((self._model.height_px, self._model.width_px, 3), np.uint8))

    def _tick(self, t_us: int) -> Truth:
        if t_us >= self._next_frame_us:
            self._capture(t_us)
        self._answer(t_us)
        self._obey(t_us)
        self._move()
        return self._truth(t_us)

    def _target_about_robot(self, t_us: int) -> tuple[float, float]:
        tx, ty = self.path(t_us / 1e6)
        x, y, yaw = self._robot
        dx, dy = tx - x, ty - y
        return math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx

    def _capture(self, t_us: int) -> None:
        self._next_frame_us += FRAME_US
        self._seq += 1
        header = FrameHeader(session="0000abcd", seq=self._seq, t_us=t_us, pose=self._odometry, moving=self._moving,
                             applied=self._applied, latency_us=self._latency_us)
        where = self._target_about_robot(t_us)
        if self.blind(t_us / 1e6):
            where = (-10.0, 0.0)
        jpeg = jpeg_of(scene(self._model, *where, seed=self._seq)) if self.drawn else self._blank
        if self._rng.random() >= self.loss:
            due = t_us + round(self.latency_s * 5e5)
            self._up.append((due, Frame(header, jpeg), ball_about_lens(self._model, *where)))

    def _answer(self, t_us: int) -> None:
        while self._up and self._up[0][0] <= t_us:
            _, frame, self._eye.centre = self._up.pop(0)
            answer = self.pipeline.step(frame)
            self._seen = answer.seen
            if answer.twist is not None and self._rng.random() >= self.loss:
                due = t_us + round((self.latency_s / 2 + self.compute_s) * 1e6)
                self._down.append((due, frame.header.t_us, answer.twist))

    def _obey(self, t_us: int) -> None:
        """The gate in short: newest command, silence, age, limits on speed and acceleration."""
        while self._down and self._down[0][0] <= t_us:
            self._command = (t_us, *self._down.pop(0)[1:])
            self._latency_us = t_us - self._command[1]
        wanted = (0.0, 0.0)
        if self._command and t_us >= self.held_until_s * 1e6 and t_us - self._command[0] < 300_000:
            age_s = (t_us - self._command[1]) / 1e6
            factor = max(0.0, min(1.0, (0.4 - age_s) / 0.25))
            twist = self._command[2]
            excess = max(abs(twist.linear_mps) / 0.5, abs(twist.angular_rad_s) / 2.5, 1e-9)
            scale = min(1.0, factor / excess)
            wanted = (twist.linear_mps * scale, twist.angular_rad_s * scale)
        step = TICK_US / 1e6
        self._applied = tuple(now + max(-limit * step, min(limit * step, goal - now))
                              for now, goal, limit in zip(self._applied, wanted, (2.0, 10.0), strict=True))

    def _move(self) -> None:
        step, lag = TICK_US / 1e6, 0.05
        self._moving = tuple(now + (goal - now) * step / lag
                             for now, goal in zip(self._moving, self._applied, strict=True))
        self._robot = _moved(self._robot, self._moving, step)
        self._odometry = _moved(self._odometry, self._moving, step * self.odometry_scale)

    def _truth(self, t_us: int) -> Truth:
        x, y = self._target_about_robot(t_us)
        ahead = x - self._model.x_m
        return Truth(t_us / 1e6, math.atan2(y, ahead), math.hypot(y, ahead), self._moving, self._robot, self._seen)


def _moved(pose: tuple[float, float, float], moving: tuple[float, float], step: float) -> tuple[float, float, float]:
    x, y, yaw = pose
    middle = yaw + moving[1] * step / 2
    return x + moving[0] * math.cos(middle) * step, y + moving[0] * math.sin(middle) * step, yaw + moving[1] * step


def acquired_at(run: list[Truth], stand_off_m: float = 0.8) -> float | None:
    """First moment with the bearing within 5 degrees and the distance within 0.10 m."""
    return next((row.t_s for row in run
                 if abs(row.bearing_rad) < math.radians(5) and abs(row.distance_m - stand_off_m) < 0.1), None)


def errors_after(run: list[Truth], from_s: float, stand_off_m: float = 0.8) -> tuple[float, float]:
    """RMS of bearing (degrees) and of distance (m) from `from_s` to the end."""
    rows = [row for row in run if row.t_s >= from_s]
    bearing = math.sqrt(sum(row.bearing_rad**2 for row in rows) / len(rows))
    distance = math.sqrt(sum((row.distance_m - stand_off_m) ** 2 for row in rows) / len(rows))
    return math.degrees(bearing), distance


def still(x_m: float, y_m: float) -> Path:
    """A ball that lies there."""
    return lambda t_s: (x_m, y_m)


def circle(radius_m: float = 1.2, speed_mps: float = 0.25, about: tuple[float, float] = (0.8, 1.2)) -> Path:
    """Counter-clockwise, starting below its centre."""
    def at(t_s: float) -> tuple[float, float]:
        turn = t_s * speed_mps / radius_m - math.pi / 2
        return about[0] + radius_m * math.cos(turn), about[1] + radius_m * math.sin(turn)
    return at


def eight(radius_m: float = 1.0, speed_mps: float = 0.25) -> Path:
    """Two circles that touch at the start: left first, then right."""
    lap_s = 2 * math.pi * radius_m / speed_mps

    def at(t_s: float) -> tuple[float, float]:
        side = 1 if (t_s // lap_s) % 2 == 0 else -1
        turn = (t_s % lap_s) / lap_s * 2 * math.pi
        return 0.8 + radius_m * math.sin(turn), side * radius_m * (1 - math.cos(turn))
    return at
