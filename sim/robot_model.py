"""What a simulated robot is made of: the models behind `robots/*.toml`. Pure.

Lengths are metres from the axle's midpoint on the floor: x forward, y left, z up.
"""

import math
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from protocol.config import Config
from protocol.messages import CameraModel
from sim.toml_file import check, find, names_in, read_table

ROBOTS = Path(__file__).parent / "robots"

Length = Annotated[float, Field(gt=0, le=2)]
Place = Annotated[float, Field(ge=-2, le=2)]
Mass = Annotated[float, Field(gt=0, le=100)]


class Wheels(Config):
    """Two driven wheels and what their motors can do. Imperfections are data, zero when perfect."""

    radius_m: Length
    track_m: Length
    """Distance between the two wheels' points of contact."""
    width_m: Length
    mass_kg: Mass
    friction: Annotated[float, Field(ge=0, le=5)]
    max_rad_s: Annotated[float, Field(gt=0, le=200)]
    max_accel_mps2: Annotated[float, Field(gt=0, le=100)]
    """At the rim."""
    max_torque_nm: Annotated[float, Field(gt=0, le=100)]
    lag_s: Annotated[float, Field(ge=0, le=1)]
    """Time constant of the motor's first-order answer."""
    encoder_steps: Annotated[int, Field(ge=1, le=1_000_000)]
    """Per turn of a wheel."""
    mismatch: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    """Left radius less right radius, as a fraction of `radius_m`."""
    slip: Annotated[float, Field(ge=0, le=0.4)] = 0.0
    """Mean fraction of a wheel's turning that does not become motion; drawn every 0.1 s between 0 and twice this."""


class Chassis(Config):
    """The plate: a box that may touch things. `*_m` of the centre of mass are from the axle's midpoint."""

    length_m: Length
    width_m: Length
    height_m: Length
    x_m: Place
    """Centre of the box."""
    z_m: Place
    mass_kg: Mass
    mass_x_m: Place
    """Centre of mass; behind the axle, so that the robot rests on its caster."""
    mass_z_m: Place


class Caster(Config):
    """A ball that slides without friction."""

    radius_m: Length
    x_m: Place


class Eye(Config):
    """The camera: where the lens is, what it sees. Straight ahead, no distortion."""

    x_m: Place
    z_m: Length
    hfov_deg: Annotated[float, Field(ge=20, le=150)]
    width_px: Annotated[int, Field(ge=16, le=1920)]
    height_px: Annotated[int, Field(ge=16, le=1080)]
    fps: Annotated[float, Field(gt=0, le=60)]

    def camera_model(self) -> CameraModel:
        """The pinhole model, exact: a simulated lens is calibrated by construction."""
        focal_px = self.width_px / 2 / math.tan(math.radians(self.hfov_deg) / 2)
        return CameraModel(
            width_px=self.width_px, height_px=self.height_px, fx_px=focal_px, fy_px=focal_px,
            cx_px=self.width_px / 2, cy_px=self.height_px / 2, x_m=self.x_m, z_m=self.z_m, calibrated=True,
        )


class LidarModel(Config):
    """A lidar that looks all around, first ray straight back, counter-clockwise."""

    x_m: Place
    z_m: Length
    rays: Annotated[int, Field(ge=4, le=3600)]
    range_min_m: Length
    range_max_m: Annotated[float, Field(gt=0, le=100)]
    rate_hz: Annotated[float, Field(gt=0, le=50)]
    noise_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of each range."""

    @model_validator(mode="after")
    def _sees_something(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        return self


class RobotModel(Config):
    """One robot."""

    name: str
    summary: str = ""
    wheels: Wheels
    chassis: Chassis
    caster: Caster
    camera: Eye
    lidar: LidarModel


def robot_names() -> list[str]:
    """Robots that come with Sightline."""
    return names_in(ROBOTS)


def load_robot(name: str) -> RobotModel:
    """A robot by its name, or by the path of a `.toml` file. Raises ConfigError with the nearest name."""
    path = find("robot", name, ROBOTS)
    return check(RobotModel, {"name": path.stem, **read_table(path)}, path)
