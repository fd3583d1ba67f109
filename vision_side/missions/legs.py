"""Mission `legs`: follow two walking legs, by boxes of legs and a lidar. Pure.

The lidar echoes in the angle of a box around both legs give the place of each leg. The robot follows the point between
the legs, which moves steadily while the legs swing. All other steps are those of `follow`.
"""

import math
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from sightline.protocol.messages import CameraModel
from sightline.vision_side.config import TrackConfig
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.missions.follow import PERSON_APART_M, Follow
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.missions.ranges import Points, PoseMemory, about_robot, echoes, in_odometry
from sightline.vision_side.tracking.locate import Sighting, points_ahead
from sightline.vision_side.tracking.track import from_odometry

_SPAN_MARGIN_RAD = math.radians(1.5)  # lidar rays are 1 degree apart, and the target moves between scan and frame
_GAP_M = 0.10  # a larger gap between successive echoes separates two legs


class LegsTrack(TrackConfig):
    """Tracking of legs. They change speed faster than a rolling ball, and their position is less exact."""

    acceleration_mps2: Annotated[float, Field(gt=0, le=20)] = 0.5
    range_noise: Annotated[float, Field(gt=0, le=1)] = 0.03
    gate_m: Annotated[float, Field(gt=0, le=5)] = 0.45
    apart_m: Annotated[float, Field(ge=0, le=5)] = PERSON_APART_M


class Legs(Follow):
    """Follows one human. `phase` as in `follow`; without echoes in the box the robot only turns."""

    class Config(Follow.Config):
        """The options of `follow`, the label of the legs, and their size for the lidar."""

        track: LegsTrack = LegsTrack()
        label: Annotated[str, Field(max_length=64)] = "legs"
        """Label of boxes that contain both legs; empty for any."""
        leg_radius_m: Annotated[float, Field(gt=0, le=0.3)] = 0.055
        """Radius of a leg. The lidar measures its surface; the center is this much further."""
        stride_m: Annotated[float, Field(gt=0, le=2)] = 0.6
        """Largest distance of the second leg behind the first. A further echo is another object."""
        sensor_x_m: Annotated[float, Field(ge=-2, le=2)] = 0.055
        """Position of the lidar, forward of the axle."""
        max_scan_age_s: Annotated[float, Field(gt=0, le=2)] = 0.4

    wants_scan: ClassVar[bool] = True
    has_look: ClassVar[bool] = False

    def __init__(self, config: Config, camera: CameraModel) -> None:
        super().__init__(config, camera)
        self._legs = config
        self._poses = PoseMemory()
        self._scan_us = -1
        self._echoes: Points = np.empty((0, 2))

    def step(self, view: View) -> Plan:
        """Compute the plan for one frame."""
        self._poses.add(view.header)
        self._lay_out(view)
        return super().step(view)

    def _lay_out(self, view: View) -> None:
        """Convert the echoes of the newest scan to the odometry frame. An old scan gives none."""
        scan = view.scan
        if scan is None or view.header.t_us - scan.t_us > self._legs.max_scan_age_s * 1e6:
            self._echoes = np.empty((0, 2))
        elif scan.t_us != self._scan_us or not len(self._echoes):
            self._scan_us = scan.t_us
            self._echoes = in_odometry(echoes(scan, self._legs.sensor_x_m), self._poses.at(scan.t_us))

    def _places(self, view: View) -> list[Sighting | None]:
        """Return the point between the legs of each box."""
        near = about_robot(self._echoes + self._walked(view), view.header.pose) - (self._camera.x_m, self._camera.y_m)
        return [self._place(one, near, view) for one in view.detections if self._legs.label in ("", one.label)]

    def _walked(self, view: View) -> tuple[float, float]:
        """Return the motion of the legs since the scan. Without it the distance is up to 7 cm too short."""
        target = self._track.target
        if target is None or view.scan is None:
            return 0.0, 0.0
        age_s = max(0.0, (view.header.t_us - view.scan.t_us) / 1e6)
        return target.vx_mps * age_s, target.vy_mps * age_s

    def _place(self, one: Detection, about_lens: Points, view: View) -> Sighting | None:
        right_rad, left_rad = _span(one, self._camera)
        if left_rad <= right_rad:
            return None
        # If one leg hides the other, or the scan missed both, the point may be a quarter of a stride off.
        radius_m, exactness = self._legs.leg_radius_m, 0.5
        centers_rad, centers_m = np.array([(right_rad + left_rad) / 2]), np.array([self._remembered_m(view)])
        bearings_rad = np.arctan2(about_lens[:, 1], about_lens[:, 0])
        inside = (bearings_rad >= right_rad - _SPAN_MARGIN_RAD) & (bearings_rad <= left_rad + _SPAN_MARGIN_RAD)
        if inside.any():
            near = about_lens[inside]
            away_m = np.hypot(*near.T)
            expected_m = None if self._track.target is None else float(centers_m[0]) - radius_m
            legs = nearest_legs(near, away_m, self._legs.stride_m, expected_m)[:2]
            centers_m = away_m[legs] + radius_m
            # The nearer leg reaches further to its side of the box, so the center of the box sways with each step. A
            # human between robot and legs is in the box, too.
            if len(legs) > 1 or away_m[legs[0]] > away_m.min():
                centers_rad = np.array([_middle_rad(near, leg, 2 * radius_m) for leg in legs])
            exactness = 1.0 if len(legs) > 1 else exactness
        x_m, y_m = float(np.mean(centers_m * np.cos(centers_rad))), float(np.mean(centers_m * np.sin(centers_rad)))
        return Sighting(self._camera.x_m + x_m, self._camera.y_m + y_m, one, exactness)

    def _remembered_m(self, view: View) -> float:
        """Return the last known distance of the legs, for a box without an echo, in m."""
        target = self._track.target
        if target is None:
            return self._config.target.stand_off_m
        x, y = from_odometry(view.header.pose, target.x_m, target.y_m)
        return math.hypot(x - self._camera.x_m, y - self._camera.y_m)


def nearest_legs(
    points: Points, away_m: NDArray[np.float64], stride_m: float, expected_m: float | None = None
) -> list[int]:
    """Return the index of the nearest echo of each leg, nearest leg first, within a stride of the nearest leg.

    `points` are in scan order; a gap between two points separates two legs. Legs within half a stride of `expected_m`
    come before all others, because a human in between is nearer but is not the target.
    """
    is_first = np.hypot(*(points - np.roll(points, 1, axis=0)).T) > _GAP_M
    # Modulo, because a leg straight ahead is at both ends of a scan that begins there.
    legs = np.cumsum(is_first) % max(1, np.count_nonzero(is_first))
    by_range = np.argsort(away_m, kind="stable")
    every = by_range[np.sort(np.unique(legs[by_range], return_index=True)[1])].tolist()
    expected = [one for one in every if expected_m is not None and abs(away_m[one] - expected_m) <= stride_m / 2]
    nearest = expected or every
    return [one for one in nearest if away_m[one] <= away_m[nearest[0]] + stride_m]


def _middle_rad(points: Points, leg: int, width_m: float) -> float:
    """Return the bearing of the center of the echoes of one leg. `leg` is the index of one of them."""
    x_m, y_m = points[np.hypot(*(points - points[leg]).T) <= width_m].mean(axis=0)
    return math.atan2(y_m, x_m)


def _span(one: Detection, camera: CameraModel) -> tuple[float, float]:
    """Return the bearings of the right and left edge of a box at half height, left positive. Valid for any lens."""
    middle = (one.y1_px + one.y2_px) / 2
    rays = points_ahead(np.array([[one.x2_px, middle], [one.x1_px, middle]]), camera)
    cos, sin = math.cos(camera.pitch_rad), math.sin(camera.pitch_rad)
    ahead = cos + rays[1] * sin
    right, left = np.arctan2(-rays[0], ahead)
    return float(right), float(left)
