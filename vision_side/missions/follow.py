"""The default mission: turn toward one target and keep a distance to it; search for a lost target. Pure.

Track, prediction, steering and search are separate files. A detection is located as a sphere of known size. A box from
another service is located by its height or width.
"""

import math
from dataclasses import replace
from typing import ClassVar, Final

from sightline.protocol.config import Config as Settings
from sightline.protocol.messages import STILL, CameraModel, FrameHeader, Pose, Twist
from sightline.vision_side.config import (
    BoxesConfig,
    LatencyConfig,
    SearchConfig,
    SteerConfig,
    TargetConfig,
    TrackConfig,
)
from sightline.vision_side.detect.port import Detection, is_followable
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.tracking.appearance import look_of
from sightline.vision_side.tracking.locate import Sighting, locate_box, locate_sphere
from sightline.vision_side.tracking.prediction import MotionPredictor, PredictedMotion
from sightline.vision_side.tracking.steering import Aim, Search, Steer
from sightline.vision_side.tracking.track import Target, Track, from_odometry

PERSON: Final = "person"
"""Label of a whole human, as in COCO."""
PERSON_M: Final = {"height_m": 1.7, "width_m": 0.45}
"""Size of a standing adult, used if the configuration has no size. Without it a human is located as a ball at 0.3 m."""

_LOOKS_EACH: Final = 8
"""Frames between two looks of a single object. A look changes slowly, and takes a tenth of the rest of a step."""
PERSON_APART_M: Final = 0.4
"""Least distance between two humans. A nearer detection is a part of the same human."""


class Follow:
    """Follows one target. `phase` is tracking, coasting, searching or lost.

    Bearing and distance are those of the track at capture time, over the floor from the lens.
    """

    class Config(Settings):
        """The sections of the vision configuration with these names."""

        target: TargetConfig = TargetConfig()
        track: TrackConfig = TrackConfig()
        steer: SteerConfig = SteerConfig()
        latency: LatencyConfig = LatencyConfig()
        search: SearchConfig = SearchConfig()
        boxes: BoxesConfig = BoxesConfig()

    scales: ClassVar[bool] = True
    has_look: ClassVar[bool] = True
    """True if the middle of a box shows the object. The middle of a box around two legs shows the background."""

    def __init__(self, config: Config, camera: CameraModel) -> None:
        self._config = config
        self._camera = camera
        self._sizes = _sizes(config)
        self._track = Track(_track(config))
        self._steer = Steer(config.steer, config.target.stand_off_m)
        self._search = Search(config.search)
        self._motion_predictor = MotionPredictor(config.latency)
        self._last_us: int | None = None

    def step(self, view: View) -> Plan:
        """Compute the plan for one frame."""
        self._camera = view.camera
        places, gap_s = self._places(view), self._gap_s(view)
        self._receive(view)
        seen = self._track.step(gap_s, view.header.pose, self._sightings(places, view, gap_s),
                                view.header.seq)
        plan = self._act(view, seen)
        self._motion_predictor.sent(view.header.t_us, plan.twist)
        return plan

    def _gap_s(self, view: View) -> float:
        """Return the seconds since the last frame. With the limit of `dt_s`, an old track would not end."""
        last_us, self._last_us = self._last_us, view.header.t_us
        # A `dt_s` of 0 means that the time of the last frame was false.
        if last_us is None or view.dt_s == 0:
            return view.dt_s
        return max(view.dt_s, (view.header.t_us - last_us) / 1e6)

    def _receive(self, view: View) -> None:
        """Update the latency estimate. Shrink the integrals by a command that the robot did not apply."""
        header, dt_s = view.header, view.dt_s
        self._motion_predictor.measure(header.latency_us, dt_s)
        expected = self._motion_predictor.expected(header.t_us)
        if expected is not None and header.applied == (0.0, 0.0):
            self._steer.unmet(dt_s, -expected[0], -expected[1])

    def _places(self, view: View) -> list[Sighting | None]:
        """Locate each detection: as a sphere, or as a box from another service or with a configured size."""
        otherwise_m, sizes = self._expected_m(view.header.pose), self._sizes
        return [
            locate_box(one, self._camera, sizes, otherwise_m) if self._is_box(one, view)
            else locate_sphere(one, self._camera, self._config.target.radius_m)
            for one in view.detections if self._is_meant(one, view)
        ]

    def _is_box(self, one: Detection, view: View) -> bool:
        """Return True for a box: a detection without pixels, or without an outline if a size is configured."""
        sizes = self._sizes
        sized = sizes.height_m is not None or sizes.width_m is not None
        return view.picture is None or (sized and one.outline_px is None)

    def _is_meant(self, one: Detection, view: View) -> bool:
        """Return True if the label fits. Boxes from another service were selected at arrival."""
        label = self._config.target.label
        return (view.picture is None and not label) or is_followable(one.label, label)

    def _sightings(self, places: list[Sighting | None], view: View, gap_s: float) -> list[Sighting]:
        """Return the places within the range. Measure the look of an object only if it can matter."""
        most_m = self._config.target.max_range_m
        near = [one for one in places if one and one.x_m**2 + one.y_m**2 <= most_m**2]
        is_alone = len(near) == 1 and self._is_expected(near[0], view, gap_s)
        if view.picture is None or not self.has_look or (is_alone and view.header.seq % _LOOKS_EACH):
            return near
        return [replace(one, look=look_of(view.picture, one.detection)) for one in near]

    def _is_expected(self, one: Sighting, view: View, gap_s: float) -> bool:
        """Return True if the target was in the last frame, and `one` is at its expected position."""
        target = self._track.target
        if target is None or target.unseen_us:
            return False
        expected = from_odometry(view.header.pose, *target.after(gap_s))
        return math.dist((one.x_m, one.y_m), expected) < self._config.track.apart_m

    def _expected_m(self, pose: Pose) -> float:
        """Return the assumed distance of a box of unknown size, in m: its last distance, or the stand-off."""
        target, boxes = self._track.target, self._sizes
        if target is None or (boxes.height_m is None and boxes.width_m is None):
            return self._config.target.stand_off_m
        x, y = from_odometry(pose, target.x_m, target.y_m)
        return math.hypot(x - self._camera.x_m, y - self._camera.y_m)

    def _act(self, view: View, seen: Sighting | None) -> Plan:
        target = self._track.target
        if target is None:
            return self._look_around(view)
        header = view.header
        x, y = from_odometry(header.pose, target.x_m, target.y_m)
        x, y = x - self._camera.x_m, y - self._camera.y_m
        bearing_rad = math.atan2(y, x)
        self._search.reset(bearing_rad)
        twist = self._steer_to(target, header, view.dt_s)
        phase = "tracking" if seen else "coasting"
        box = seen.detection if seen else None
        return Plan(twist, phase, target=box, bearing_rad=bearing_rad, distance_m=math.hypot(x, y), track=target)

    def _steer_to(self, target: Target, header: FrameHeader, dt_s: float) -> Twist:
        latency_s = self._motion_predictor.latency_s
        then = self._motion_predictor.motion(header.t_us, header.pose, header.moving, header.applied)
        aim = aim_at(target, then, self._camera, latency_s)
        return self._steer.step(dt_s, aim, latency_s, self._may_drive(target))

    def _may_drive(self, target: Target) -> bool:
        config = self._config.track
        return target.sightings >= config.confirm and target.unseen_us <= config.coast_s * 1e6

    def _look_around(self, view: View) -> Plan:
        self._steer.reset()
        twist = self._search.step(view.dt_s, view.header.pose, view.header.applied)
        return Plan(STILL, "lost") if twist is None else Plan(twist, "searching")


def _sizes(config: Follow.Config) -> BoxesConfig:
    """Return the size of the object in a box: as configured, or the size of an adult for the label `person`."""
    boxes = config.boxes
    is_sized = boxes.height_m is not None or boxes.width_m is not None
    return boxes if is_sized or config.target.label != PERSON else boxes.model_copy(update=PERSON_M)


def _track(config: Follow.Config) -> TrackConfig:
    """Return the track configuration. For the label `person`, the least distance of objects is that of humans."""
    track = config.track
    if config.target.label != PERSON:
        return track
    return track.model_copy(update={"apart_m": max(track.apart_m, PERSON_APART_M)})


def aim_at(target: Target, robot: PredictedMotion, camera: CameraModel, ahead_s: float) -> Aim:
    """Predict `target` `ahead_s` from now, relative to the lens of `robot`."""
    x, y = from_odometry(robot.pose, *target.after(ahead_s))
    vx, vy = from_odometry((0.0, 0.0, robot.pose[2]), target.vx_mps, target.vy_mps)
    return Aim(x - camera.x_m, y - camera.y_m, vx, vy, camera.x_m)
