"""A custom mission: keep turning to the target, and back away while it is near.

    sightline vision --mission examples.my_mission:Shy --set mission.options.near_px=30
"""

import math

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.vision_side.missions.port import Plan, View


class Shy:
    """Maps a view to a plan, without networks, threads or clocks."""

    class Config(Config):
        near_px: float = Field(default=40.0, gt=0, le=2000)
        back_mps: float = Field(default=0.15, ge=0, le=1)

    def __init__(self, config: Config, camera: CameraModel) -> None:
        self._config, self._camera = config, camera

    def step(self, view: View) -> Plan:
        if not view.detections:
            return Plan(STILL, "alone")
        target, camera = view.detections[0], self._camera
        middle_px, radius_px = (target.x1_px + target.x2_px) / 2, (target.x2_px - target.x1_px) / 2
        bearing_rad = math.atan((camera.cx_px - middle_px) / camera.fx_px)  # left positive
        near = radius_px > self._config.near_px
        twist = Twist(linear_mps=-self._config.back_mps if near else 0.0, angular_rad_s=2.0 * bearing_rad)
        return Plan(twist, "backing" if near else "watching", target=target, bearing_rad=bearing_rad)
