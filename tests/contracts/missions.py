"""Contract of every mission plug-in. Run it over your own: `check_mission(choose("my:Mission", {}, VisionConfig()))`.

The frames are drawn from a seed: robots that drive, stand and jump, detections of every shape, no picture, no scan, and
scans as a broken or hostile robot sends them. Nothing here waits; time comes from the frames.
"""

import math
import random
from collections.abc import Iterator

import numpy as np

from sightline.protocol.messages import CameraModel, FrameHeader
from sightline.protocol.text import MAX_TWIST_BYTES, format_twist
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.port import Circle, Detection
from sightline.vision_side.missions.port import Plan, RangeScan, View
from sightline.vision_side.missions.registry import MissionSpec
from sightline.vision_side.missions.switch import MAX_COMMAND

CAMERA = CameraModel(width_px=320, height_px=240, fx_px=190.7, fy_px=190.7, cx_px=160.0, cy_px=120.0, z_m=0.1)
LARGE = CAMERA.model_copy(update={"width_px": 640, "height_px": 480, "fx_px": 381.4, "fy_px": 381.4, "cx_px": 320.0,
                                  "cy_px": 240.0})
LABELS = ("target", "legs", "light", "person")


def check_mission(chosen: MissionSpec, frames: int = 200, seed: int = 7) -> None:
    """Every promise in turn; an AssertionError names the one that is broken."""
    plans = _plans(chosen, views(seed, frames))
    assert plans == _plans(chosen, views(seed, frames)), "the same frames give the same plans"
    if chosen.scales:
        assert plans == _plans(chosen, views(seed, frames), LARGE), "it uses the camera model of each view"
    for plan in plans:
        _check_plan(plan)
    for kind in (_blind, _still, _hostile):
        for plan in _plans(chosen, kind(seed, frames // 2)):
            _check_plan(plan)


def _check_plan(plan: Plan) -> None:
    assert isinstance(plan, Plan), f"a plan for every frame, not {plan!r}"
    speeds = (plan.twist.linear_mps, plan.twist.angular_rad_s)
    assert all(math.isfinite(one) and abs(one) <= MAX_COMMAND for one in speeds), f"finite, sane twists, not {speeds}"
    assert len(format_twist(plan.twist)) <= MAX_TWIST_BYTES
    assert 1 <= len(plan.phase) <= 32 and "\n" not in plan.phase + plan.note, "short text on one line"
    assert plan.bearing_rad is None or math.isfinite(plan.bearing_rad)
    assert plan.distance_m is None or math.isfinite(plan.distance_m)


def _plans(chosen: MissionSpec, seen: Iterator[View], camera: CameraModel = CAMERA) -> list[Plan]:
    """Return a mission's plans up to the plan that ends it; the mission receives no further view."""
    mission, plans = chosen.build(camera), []
    for view in seen:
        plans.append(mission.step(view))
        if plans[-1].done:
            break
    return plans


def views(seed: int, frames: int) -> Iterator[View]:
    """A course of everything."""
    rng = random.Random(seed)
    pixels = np.random.default_rng(seed)
    t_us, pose = 5_000_000, (0.0, 0.0, 0.0)
    for seq in range(frames):
        dt_s = 0.0 if seq == 0 else rng.choice([0.0333, 0.0333, 0.0333, 0.0001, 0.1, 0.5])
        t_us += max(1, round(dt_s * 1e6))
        pose = _moved(rng, pose)
        bgr = pixels.integers(0, 256, (240, 320, 3), np.uint8) if seq % 3 else np.zeros((240, 320, 3), np.uint8)
        yield View(_header(rng, seq, t_us, pose), dt_s, rng.uniform(0.03, 0.43), CAMERA, _detections(rng),
                   DecodedImage(bgr, 1) if rng.random() < 0.8 else None,
                   _scan(rng, t_us) if rng.random() < 0.8 else None)


def _blind(seed: int, frames: int) -> Iterator[View]:
    """Nothing is ever seen: no picture, no detection, no scan."""
    for view in views(seed, frames):
        yield View(view.header, view.dt_s, view.latency_s, view.camera, ())


def _still(seed: int, frames: int) -> Iterator[View]:
    """Yield views of a held robot, which never moves on any command."""
    for view in views(seed, frames):
        header = FrameHeader(session="0000abcd", seq=view.header.seq, t_us=view.header.t_us)
        yield View(header, view.dt_s, view.latency_s, view.camera, view.detections, view.picture, view.scan)


def _hostile(seed: int, frames: int) -> Iterator[View]:
    """Scans within the bounds of the wire and beyond all sense."""
    scans = [
        RangeScan(0, 0.0, 0.0, 0.0, 0.0, np.zeros(0, np.float32)),
        RangeScan(2**53 - 1, 0.0, 0.0, 0.0, 1e6, np.zeros(360, np.float32)),
        RangeScan(1, 1e6, 1e6, 1e6, -1e6, np.full(4096, 3e38, np.float32)),
        RangeScan(1, -1e6, -1e6, -1e6, 1e6, np.full(4096, np.inf, np.float32)),
        RangeScan(1, -math.pi, 1e-12, 0.1, 8.0, np.linspace(0, 9, 4096, dtype=np.float32)),
    ]
    for view in views(seed, frames):
        scan = scans[view.header.seq % len(scans)]
        yield View(view.header, view.dt_s, view.latency_s, view.camera, view.detections, view.picture, scan)


def _moved(rng: random.Random, pose: tuple[float, float, float]) -> tuple[float, float, float]:
    if rng.random() < 0.02:  # odometry that jumps
        return rng.uniform(-50, 50), rng.uniform(-50, 50), rng.uniform(-40, 40)
    return pose[0] + rng.uniform(-0.02, 0.02), pose[1] + rng.uniform(-0.02, 0.02), pose[2] + rng.uniform(-0.1, 0.1)


def _header(rng: random.Random, seq: int, t_us: int, pose: tuple[float, float, float]) -> FrameHeader:
    moving = (rng.uniform(-0.5, 0.5), rng.uniform(-2.5, 2.5))
    applied = (0.0, 0.0) if rng.random() < 0.3 else moving
    latency_us = None if rng.random() < 0.3 else rng.randrange(0, 500_000)
    return FrameHeader(session="0000abcd", seq=seq, t_us=t_us, pose=pose, moving=moving, applied=applied,
                       latency_us=latency_us)


def _detections(rng: random.Random) -> tuple[Detection, ...]:
    return tuple(_detection(rng) for _ in range(rng.choice([0, 0, 1, 1, 2, 5])))


def _detection(rng: random.Random) -> Detection:
    """In view, cut by the border, beyond it, or without any size."""
    x, y, width, height = rng.uniform(-60, 380), rng.uniform(-60, 300), rng.uniform(0, 200), rng.uniform(0, 200)
    if rng.random() < 0.1:
        width = height = 0.0
    radius = max(width, height, 0.1) / 2
    circle = Circle(x + width / 2, y + height / 2, radius) if rng.random() < 0.5 else None
    return Detection(x, y, x + width, y + height, rng.random(), rng.choice(LABELS), circle)


def _scan(rng: random.Random, t_us: int) -> RangeScan:
    count = rng.choice([1, 5, 39, 70, 360])
    ranges = [rng.choice([rng.uniform(0, 4), rng.uniform(0, 0.3), math.inf]) for _ in range(count)]
    arc = rng.choice([0.07, math.pi, 2 * math.pi])
    return RangeScan(t_us - rng.randrange(0, 400_000), -arc / 2, arc / count, 0.05, 3.5, np.array(ranges, np.float32))
