"""Missions `traffic-light` and `traffic-light-boxes`: follow a lane and stop at its lights. Pure."""

import math
from typing import Annotated, ClassVar

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.config import Config as Settings
from sightline.protocol.messages import STILL, CameraModel, Pose, Twist
from sightline.vision_side.config import BoxesConfig, LatencyConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.lane import Lane, LaneConfig, Line
from sightline.vision_side.missions.lights import UNKNOWN, BoxLightReader, DetectedLight, HousingLightReader, LampConfig
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.tracking.locate import locate_box
from sightline.vision_side.tracking.prediction import MotionPredictor, PredictedMotion
from sightline.vision_side.tracking.track import to_odometry

_FRAMES = 2  # green counts after this many readings without another color or UNKNOWN between; others immediately
_AT_REST_MPS = 0.01
_CROSSED_M = 0.15  # a robot further beyond the line has crossed it, or started there: its stops are more exact


class StopConfig(Config):
    """Stopping and starting at a light."""

    line_m: Annotated[float, Field(ge=0, le=20)] = 0.6
    """Distance of the line before the light."""
    front_m: Annotated[float, Field(ge=0, le=2)] = 0.07
    """Distance of the robot's front ahead of its axle. The front must not cross the line."""
    margin_m: Annotated[float, Field(ge=0, le=1)] = 0.1
    """Stopping distance before the line. It covers the range error of the light and leaves all of it in view."""
    brake_mps2: Annotated[float, Field(gt=0, le=10)] = 0.5
    """Deceleration for a line that is seen in time."""
    hardest_mps2: Annotated[float, Field(gt=0, le=10)] = 1.2
    """Highest deceleration, when a light turns yellow. If it is not sufficient, the robot clears the line."""
    hidden_s: Annotated[float, Field(ge=0, le=10)] = 0.4
    """Time without a reading after which a light counts as red."""
    cleared_m: Annotated[float, Field(ge=0, le=5)] = 0.3
    """Distance of the front beyond the line at which the robot forgets the light."""


class StopLine:
    """The stop line of one light.

    `colour` is the color in use. `clearing` is True after the line, or if it is too late to stop.
    """

    def __init__(self, config: StopConfig) -> None:
        self._config = config
        self.colour = UNKNOWN
        self.clearing = False
        self._candidate, self._count = UNKNOWN, 0
        self._unseen_s = 0.0
        self._was_green = False

    def see(self, colour: str, dt_s: float) -> None:
        """Update the state of the light with one frame. It is unknown if no light is detected or readable."""
        self._unseen_s = 0.0 if colour != UNKNOWN else self._unseen_s + dt_s
        if colour == UNKNOWN:
            if self._unseen_s > self._config.hidden_s:
                self.colour = self._candidate = UNKNOWN
            return
        self._count = self._count + 1 if colour == self._candidate else 1
        self._candidate = colour
        if colour != "green" or self._count >= _FRAMES:
            self.colour = colour

    def speed(self, left_m: float, moving_mps: float, cruise_mps: float) -> float:
        """Return the speed for `left_m` from the robot's front to the line."""
        self._decide(left_m, moving_mps)
        if self.clearing or self.colour == "green":
            return cruise_mps
        room_m = left_m - self._config.margin_m
        return min(cruise_mps, math.sqrt(2 * self._config.brake_mps2 * max(0.0, room_m)), max(0.0, 3.0 * room_m))

    def _decide(self, left_m: float, moving_mps: float) -> None:
        """Set `clearing` after the line, or if the hardest braking from the end of green would end beyond it."""
        if left_m < -_CROSSED_M:
            self.clearing = True
        elif self.colour == "green":
            self.clearing = left_m <= 0 and moving_mps > 0
        elif self._was_green and left_m < moving_mps**2 / (2 * self._config.hardest_mps2):
            self.clearing = True
        elif left_m > 0 and moving_mps < _AT_REST_MPS:
            self.clearing = False  # the robot stands before the line and can wait
        self._was_green = self.colour == "green"


# Missions `traffic-light` and `traffic-light-boxes`: drive along a lane of blocks and follow its lights. Pure.
#
# The detected blocks give the lane, the image gives the color of the light, and the size of the light gives the
# distance of its line. The robot passes each block at its side. A detection in the box of a light is not a block.
# `note` begins with the state: `light red`, `light yellow`, `light green`, `light unknown`, or `no light`.


Place = tuple[float, float]

_SAME_M, _SAME_SHARE = 0.3, 0.15  # largest distance of two sightings of one light: constant, and share of its range
_OUTER_PX = 3.0  # a lamp's edge may lie this far outside the housing's box


class TrafficLightConfig(Settings):
    """The lane, the light, the line, and the driving."""

    lane: LaneConfig = LaneConfig()
    lamp: LampConfig = LampConfig()
    stop: StopConfig = StopConfig()
    latency: LatencyConfig = LatencyConfig()
    label: Annotated[str, Field(max_length=64)] = "target"
    """Label of the lane's blocks; empty for any."""
    block_height_m: Annotated[float, Field(gt=0.01, le=5)] = 0.281
    """Height of a block. It gives the distance of a block."""
    max_range_m: Annotated[float, Field(gt=0.3, le=50)] = 4.0
    """Largest range of blocks and lights. Further ones are too inaccurate."""
    cruise_mps: Annotated[float, Field(gt=0, le=2)] = 0.3
    look_ahead_m: Annotated[float, Field(gt=0.1, le=5)] = 0.6
    """Distance ahead of the point of the center line toward which the robot steers."""
    max_angular_rad_s: Annotated[float, Field(gt=0, le=6)] = 1.5


class TrafficLight:
    """Lights with three lamps in a housing."""

    Config = TrafficLightConfig
    scales: ClassVar[bool] = True
    reader: ClassVar[type[HousingLightReader] | type[BoxLightReader]] = HousingLightReader

    def __init__(self, config: TrafficLightConfig, camera: CameraModel) -> None:
        self._config, self._camera = config, camera
        self._reader = self.reader(config.lamp)
        self._lane = Lane(config.lane)
        self._motion_predictor = MotionPredictor(config.latency)
        self._light: Place | None = None
        self._sure = 0.0
        self._stop = StopLine(config.stop)

    def step(self, view: View) -> Plan:
        """Compute the twist along the lane."""
        self._camera = view.camera
        self._motion_predictor.measure(view.header.latency_us, view.dt_s)
        plan = self._plan(view)
        self._motion_predictor.sent(view.header.t_us, plan.twist)
        return plan

    def _plan(self, view: View) -> Plan:
        if view.picture is None:
            return Plan(STILL, "no image", "traffic lights need an image")
        pose = view.header.pose
        known = [one for one in view.detections if not self._is_light(one, pose)]
        lights = self._reader.read(view.picture, known)
        blocks = [one for one in known if not any(_inside(one, light.box) for light in lights)]
        self._lane.see(pose, self._block_places(blocks, pose))
        line = self._lane.line
        if line is None:
            return Plan(STILL, "no lane", f"{self._shown()}; no block of the lane in view")
        self._look(lights, line, view)
        return self._drive(line, view)

    def _shown(self) -> str:
        return "no light" if self._light is None else f"light {self._stop.colour}"

    def _is_light(self, one: Detection, pose: Pose) -> bool:
        """Return True if a detection is at the place of the known light."""
        place = self._place(one, pose, self._config.block_height_m, None) if self._light else None
        return bool(place and self._light and math.dist(place, self._light) < _SAME_M)

    def _block_places(self, blocks: list[Detection], pose: Pose) -> list[Place]:
        meant = [one for one in blocks if self._config.label in ("", one.label)]
        places = [self._place(one, pose, self._config.block_height_m, None) for one in meant]
        return [one for one in places if one is not None]

    def _place(self, one: Detection, pose: Pose, height_m: float, width_m: float | None) -> Place | None:
        """Locate an object of known size in the odometry frame. Returns None if it is cut off or too far away."""
        if self._is_cut(one) and width_m is None:
            return None
        sighting = locate_box(one, self._camera, BoxesConfig(height_m=height_m, width_m=width_m), 0.0)
        if sighting is None or not 0.05 < math.hypot(sighting.x_m, sighting.y_m) <= self._config.max_range_m:
            return None
        return to_odometry(pose, sighting.x_m, sighting.y_m)

    def _is_cut(self, one: Detection) -> bool:
        return one.y1_px < 1 or one.y2_px > self._camera.height_px - 1

    # --- the light -----------------------------------------------------------------------------------------------

    def _look(self, lights: list[DetectedLight], line: Line, view: View) -> None:
        """Select the next light, and update its place and its color."""
        pose = view.header.pose
        if self._light and self._left_m(line, self._light, pose) < -self._config.stop.cleared_m:
            self._light, self._stop = None, StopLine(self._config.stop)
        known_m = self._left_m(line, self._light, pose) if self._light else math.inf
        next_m, shown = math.inf, UNKNOWN
        for one in lights:
            place = self._light_place(one, pose)
            if place is None:
                continue
            left_m = self._left_m(line, place, pose)
            if not self._is_known(place, pose) and (one.colour == UNKNOWN or left_m >= known_m):
                continue  # a dark shape may be any object; the known light counts as red while it is hidden
            if -self._config.stop.cleared_m <= left_m < next_m:
                next_m, shown = left_m, one.colour
                self._meet(place, pose, self._is_cut(one.box) or shown == UNKNOWN)
        if self._light:
            self._stop.see(shown, view.dt_s)

    def _light_place(self, one: DetectedLight, pose: Pose) -> Place | None:
        """Return the center of a light. The measured front is nearer by half its depth."""
        lamp, is_box = self._config.lamp, self.reader is BoxLightReader
        height_m = lamp.box_height_m if is_box else lamp.housing_height_m
        depth_m = lamp.box_depth_m if is_box else lamp.housing_depth_m
        seen_m = height_m + depth_m * self._underside(one.box)
        face = self._place(one.box, pose, seen_m, lamp.box_width_m if is_box else lamp.housing_width_m)
        if face is None:
            return None
        away_m = math.dist(face, pose[:2])
        share = 1 + depth_m / 2 / max(away_m, 0.1)
        return pose[0] + share * (face[0] - pose[0]), pose[1] + share * (face[1] - pose[1])

    def _underside(self, box: Detection) -> float:
        """Return the visible depth below the face of a light. A housing above the lens is seen from below."""
        return max(0.0, (self._camera.cy_px - box.y2_px) / self._camera.fy_px + self._camera.pitch_rad)

    def _is_known(self, place: Place, pose: Pose) -> bool:
        """Return True if `place` is the place of the known light."""
        off_m = math.dist(place, self._light) if self._light else math.inf
        return off_m <= _SAME_M + _SAME_SHARE * math.dist(place, pose[:2])

    def _meet(self, place: Place, pose: Pose, is_vague: bool) -> None:
        """Update the place of the light, near measurements with the largest weight, or use a new light.

        A light that is cut off or unreadable has an inaccurate place. It may update the color, but not the place.
        """
        if is_vague and self._light:
            return
        weight = 1.0 / max(math.dist(place, pose[:2]), 0.2) ** 4
        if self._light is None or not self._is_known(place, pose):
            self._light, self._sure, self._stop = place, weight, StopLine(self._config.stop)
        else:
            self._sure += weight
            share = weight / self._sure
            old = self._light
            self._light = old[0] + share * (place[0] - old[0]), old[1] + share * (place[1] - old[1])

    def _left_m(self, line: Line, light: Place, pose: Pose) -> float:
        """Return the distance from the robot's front to the stop line, m."""
        stop = self._config.stop
        return line.along_m(*light) - stop.line_m - line.along_m(pose[0], pose[1]) - stop.front_m

    # --- the lane ------------------------------------------------------------------------------------------------

    def _drive(self, line: Line, view: View) -> Plan:
        header = view.header
        lane_m = self._lane.left_m(header.pose)
        if lane_m <= 0:
            return Plan(STILL, "lane end", f"{self._shown()}; the lane has no more blocks", done=True)
        then = self._motion_predictor.motion(header.t_us, header.pose, header.moving, header.applied)
        cruise = min(self._config.cruise_mps, math.sqrt(2 * self._config.stop.brake_mps2 * lane_m))
        left_m = self._left_m(line, self._light, then.pose) if self._light else None
        linear = cruise if left_m is None else self._stop.speed(left_m, then.linear_mps, cruise)
        note = self._shown() if left_m is None else f"{self._shown()}, line in {left_m:.2f} m"
        twist = self._steered(line, then, linear)
        return Plan(twist, self._phase(left_m, linear, cruise), note, distance_m=left_m)

    def _phase(self, left_m: float | None, linear: float, cruise: float) -> str:
        if left_m is not None and self._stop.clearing:
            return "clearing line"
        if linear >= cruise:
            return "driving"
        return "waiting" if linear < 0.01 else "stopping"

    def _steered(self, line: Line, then: PredictedMotion, linear: float) -> Twist:
        """Drive an arc to the center line ahead. Turn on the spot if that point is far to the side."""
        look_m, limit = self._config.look_ahead_m, self._config.max_angular_rad_s
        x, y = line.at(line.along_m(then.pose[0], then.pose[1]) + look_m)
        bearing_rad = math.remainder(math.atan2(y - then.pose[1], x - then.pose[0]) - then.pose[2], math.tau)
        if abs(bearing_rad) > 1.0:
            turn = math.copysign(min(limit, 0.8), bearing_rad) if linear else 0.0
            return Twist(linear_mps=0.0, angular_rad_s=turn)
        angular = 2.0 * linear * math.sin(bearing_rad) / look_m
        return Twist(linear_mps=linear, angular_rad_s=max(-limit, min(limit, angular)))


class TrafficLightBoxes(TrafficLight):
    """Lights that are one box, which changes its color. The lane's blocks must have another color."""

    reader = BoxLightReader


def _inside(one: Detection, box: Detection) -> bool:
    """Return True if the center of a detection is in the box of a light."""
    x, y = one.center_px
    return (box.x1_px - _OUTER_PX <= x <= box.x2_px + _OUTER_PX
            and box.y1_px - _OUTER_PX <= y <= box.y2_px + _OUTER_PX)
