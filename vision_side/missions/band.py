"""Band steering, a baseline: one of three fixed twists, by where the target is and how large it looks. Pure.

The law of an older Gazebo robot, its numbers as defaults. `centre_share` is of the picture's whole width, as it was
there, so that the robot turns only when the target is almost out of sight; see docs/missions.md for sane numbers.
"""

from collections import deque
from typing import Annotated

from pydantic import Field

from sightline.protocol.config import Config
from sightline.protocol.messages import STILL, CameraModel, Twist
from sightline.evaluation.baselines.pixels import largest
from sightline.vision_side.missions.port import Plan, View

Share = Annotated[float, Field(ge=0, le=1)]


class BandConfig(Config):
    """The write-up's numbers. Shares are of the picture's width."""

    min_radius_share: Share = 0.05
    max_radius_share: Share = 1 / 3
    """A target that looks smaller or larger than this is not followed."""
    centre_share: Share = 0.30
    """Within this to either side of the middle the robot drives straight on."""
    averaged: Annotated[int, Field(ge=1, le=100)] = 5
    """Positions of the target that are averaged."""
    linear_mps: Annotated[float, Field(ge=0, le=5)] = 0.1
    """Straight on and while turning alike."""
    angular_rad_s: Annotated[float, Field(ge=0, le=10)] = 0.5


class Band:
    """Forward, left or right at fixed speeds, or stop."""

    Config = BandConfig

    def __init__(self, config: BandConfig, camera: CameraModel) -> None:
        self._config, self._width_px = config, camera.width_px
        self._seen_px: deque[float] = deque(maxlen=config.averaged)

    def step(self, view: View) -> Plan:
        """The plan for one frame."""
        blob = largest(view)
        if blob is None:
            return Plan(STILL, "no target")
        self._seen_px.append(blob.x_px)
        middle_px = round(sum(self._seen_px) / len(self._seen_px)) - (self._width_px // 2 - 1)  # whole pixels, as there
        config, share = self._config, blob.radius_px / self._width_px
        if not config.min_radius_share <= share <= config.max_radius_share:
            return Plan(STILL, "too near" if share > config.max_radius_share else "too far", target=blob.detection)
        if abs(middle_px) <= config.centre_share * self._width_px:
            return Plan(Twist(linear_mps=config.linear_mps, angular_rad_s=0.0), "forward", target=blob.detection)
        left = middle_px < 0
        turn = config.angular_rad_s if left else -config.angular_rad_s
        return Plan(Twist(linear_mps=config.linear_mps, angular_rad_s=turn), "left" if left else "right",
                    target=blob.detection)
