"""Simulated robots: models of `robots/*.toml`, and their URDF. Pure.

Lengths are meters from the axle's midpoint on the floor: x forward, y left, z up. The body is either written in the
TOML (`chassis`, `caster`) or drawn in a URDF that it names, whose wheels and sensors it then only names too.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import CameraModel
from sightline.sim.toml_file import check, find, is_file, names_in, read_table
from sightline.sim.urdf import Front, Outline, Transform, Urdf, urdf_text

ROBOTS = Path(__file__).parent / "robots"

Length = Annotated[float, Field(gt=0, le=2)]
Place = Annotated[float, Field(ge=-2, le=2)]
Mass = Annotated[float, Field(gt=0, le=100)]
Degrees = Annotated[float, Field(ge=-360, le=360)]


class Wheels(Config):
    """Two driven wheels and their motors. Imperfections are zero by default."""

    radius_m: Length
    track_m: Length
    """Distance between the two wheels' points of contact."""
    width_m: Length = 0.005
    mass_kg: Mass = 0.05
    friction: Annotated[float, Field(ge=0, le=5)] = 1.0
    max_rad_s: Annotated[float, Field(gt=0, le=200)]
    max_accel_mps2: Annotated[float, Field(gt=0, le=100)]
    """At the rim."""
    max_torque_nm: Annotated[float, Field(gt=0, le=100)]
    lag_s: Annotated[float, Field(ge=0, le=1)]
    """Time constant of the first-order response of the motor."""
    encoder_steps: Annotated[int, Field(ge=1, le=1_000_000)]
    """Per turn of a wheel."""
    mismatch: Annotated[float, Field(ge=-0.2, le=0.2)] = 0.0
    """Left radius less right radius, as a fraction of `radius_m`."""
    slip: Annotated[float, Field(ge=0, le=0.4)] = 0.0
    """Mean fraction of a wheel's rotation that causes no motion; drawn every 0.1 s between 0 and twice this."""
    left_joint: str = ""
    right_joint: str = ""
    """Joints of the wheels if the body is a URDF. Radius and track are then measured in it."""


class Chassis(Config):
    """The plate: a box that may touch things. Its center of mass is relative to the midpoint of the axle."""

    length_m: Length
    width_m: Length
    height_m: Length
    x_m: Place
    """Center of the box."""
    z_m: Place
    mass_kg: Mass
    mass_x_m: Place
    """Center of mass; behind the axle, so that the robot rests on its caster."""
    mass_z_m: Place


class Caster(Config):
    """A ball that slides without friction."""

    radius_m: Length
    x_m: Place


class CameraMount(Config):
    """The camera: position and optics. It faces straight ahead and has no distortion."""

    link: str = ""
    """URDF link of the lens, in place of `x_m` and `z_m`."""
    x_m: Place
    z_m: Length
    hfov_deg: Annotated[float, Field(ge=20, le=150)]
    width_px: Annotated[int, Field(ge=16, le=1920)]
    height_px: Annotated[int, Field(ge=16, le=1080)]
    fps: Annotated[float, Field(gt=0, le=60)]

    def camera_model(self) -> CameraModel:
        """Return the exact pinhole model. A simulated lens is calibrated by construction."""
        focal_px = self.width_px / 2 / math.tan(math.radians(self.hfov_deg) / 2)
        return CameraModel(
            width_px=self.width_px, height_px=self.height_px, fx_px=focal_px, fy_px=focal_px,
            cx_px=self.width_px / 2, cy_px=self.height_px / 2, x_m=self.x_m, z_m=self.z_m, calibrated=True,
        )


class RangeSensorMount(Config):
    """One of several small range sensors whose echoes are merged into one scan."""

    link: str = ""
    x_m: Place
    y_m: Place
    facing_deg: Degrees
    span_deg: Annotated[float, Field(gt=0, le=360)]
    rays: Annotated[int, Field(ge=1, le=3600)]
    reach_m: Annotated[float, Field(gt=0, le=100)]


class LidarModel(Config):
    """The range sensor: a lidar over an arc, or several small sensors (`sensors`) merged into one scan.

    Rays are evenly spaced from `first_deg` to `last_deg`, counter-clockwise, with both ends. A full turn omits the
    last one, which equals the first. With `sensors`, each echo is placed as seen from (`x_m`, 0), and the nearest one
    per ray counts. A direction that no sensor covers is inf, as free space is.
    """

    link: str = ""
    x_m: Place
    z_m: Length
    first_deg: Degrees = -180.0
    last_deg: Degrees = 180.0
    rays: Annotated[int, Field(ge=2, le=3600)]
    range_min_m: Length
    range_max_m: Annotated[float, Field(gt=0, le=100)]
    rate_hz: Annotated[float, Field(gt=0, le=50)]
    noise_m: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Standard deviation of each range."""
    sensors: Annotated[tuple[RangeSensorMount, ...], Field(max_length=16)] = ()

    @model_validator(mode="after")
    def _sees_something(self) -> Self:
        if self.range_min_m >= self.range_max_m:
            raise ValueError("range_min_m must be below range_max_m")
        if not 0 < self.last_deg - self.first_deg <= 360:
            raise ValueError("first_deg must be below last_deg, by at most 360")
        return self

    @property
    def increment_rad(self) -> float:
        """Return the angle between two rays."""
        span_rad = math.radians(self.last_deg - self.first_deg)
        return span_rad / (self.rays if self.last_deg - self.first_deg == 360 else self.rays - 1)


class RobotModel(Config):
    """One robot. `settings` are the contents of its robot.toml."""

    name: str
    summary: str = ""
    urdf: str = ""
    """A URDF or xacro file in the folder of the TOML, in place of `chassis` and `caster`."""
    front: Front = "+x"
    """Direction in which the root link of the URDF drives."""
    wheels: Wheels
    chassis: Chassis | None = None
    caster: Caster | None = None
    camera: CameraMount
    lidar: LidarModel
    settings: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _has_one_body(self) -> Self:
        if bool(self.urdf) == bool(self.chassis and self.caster) or (self.urdf and (self.chassis or self.caster)):
            raise ValueError("a body is either a urdf, or a chassis and a caster")
        return self


def robot_names() -> list[str]:
    """Return the names of the robots that come with Sightline."""
    return names_in(ROBOTS)


def load_robot(name: str) -> RobotModel:
    """Load a robot by name or by the path of a `.toml` file. Raises ConfigError with the nearest name."""
    path = find("robot", name, ROBOTS)
    table = {"name": path.stem, **read_table(path, ROBOTS)}
    if table.get("urdf"):
        _measure(table, path)
    return check(RobotModel, table, path)


def _measure(table: dict[str, Any], path: Path) -> None:
    """Add the wheels and sensors of the URDF. Raises ConfigError."""
    file = path.parent / str(table["urdf"])
    if not is_file(file) and is_file(ROBOTS / str(table["urdf"])):
        file = ROBOTS / str(table["urdf"])  # the URDF of the robot that this one extends
    table["urdf"] = str(file)
    wheels = _table(table, "wheels", path)
    joints = [wheels.get(name) for name in ("left_joint", "right_joint")]
    if not all(isinstance(joint, str) and joint for joint in joints):
        raise ConfigError(f"{path}: a robot with a urdf names its wheels: [wheels] left_joint and right_joint")
    front: Front = "-x" if table.get("front") == "-x" else "+x"
    body = Urdf(urdf_text(file), str(file))
    left, right = body.wheels(str(joints[0]), str(joints[1]), front)
    wheels |= {"radius_m": left.radius_m, "track_m": left.place[1] - right.place[1]}
    foot = body.foot(str(joints[0]), str(joints[1]), front)
    lidar = _table(table, "lidar", path)
    small = lidar.get("sensors", [])
    if not isinstance(small, list):
        raise ConfigError(f"{path}: `lidar.sensors` is {str(small)[:60]!r}, not a list of tables; write "
                          "`[[lidar.sensors]]`")
    for sensor in (_table(table, "camera", path), lidar, *(one for one in small if isinstance(one, dict))):
        if sensor.get("link"):
            is_small, link = sensor in small, str(sensor["link"])
            _mount(sensor, body.place(link, foot) if is_small else body.mount(link, foot), is_small)


def _table(table: dict[str, Any], name: str, path: Path) -> dict[str, Any]:
    found = table.get(name)
    if not isinstance(found, dict):
        raise ConfigError(f"{path}: has no table [{name}]; see sim/robots/raspberry.toml for what it holds")
    return found


def _mount(sensor: dict[str, Any], where: Transform, is_small: bool) -> None:
    """Place a sensor at its link. A single-ray sensor, which lies in the plane of the scan, faces as its link does."""
    sensor["x_m"] = where.at[0]
    if is_small:
        sensor |= {"y_m": where.at[1], "facing_deg": math.degrees(where.yaw_rad)}
    else:
        sensor["z_m"] = where.at[2]


# The robot's body as URDF text, from its TOML or from its URDF file. Pure.  The root link of a generated URDF is the
# axle's midpoint on the floor, so that its pose is the robot's pose. Wheels whose radii differ are hung so that both
# touch the floor and the plate stays level.


@dataclass(frozen=True, slots=True)
class UrdfBody:
    """The file for PyBullet, with the properties of its body."""

    text: str
    joints: tuple[str, str] = ("left", "right")
    signs: tuple[float, float] = (1.0, 1.0)
    """-1 where the joint's positive turn rolls the wheel backwards."""
    foot: Transform | None = None
    """The axle's midpoint on the floor, seen from the root link; None where it is the root link."""


def urdf_body(robot: RobotModel) -> UrdfBody:
    """Return the body of `robot`. Raises ConfigError for a URDF that is missing or was changed."""
    if not robot.urdf:
        return UrdfBody(urdf_from_model(robot))
    file, wheels = Urdf(urdf_text(Path(robot.urdf)), robot.urdf), robot.wheels
    left, right = file.wheels(wheels.left_joint, wheels.right_joint, robot.front)
    return UrdfBody(
        file.text(left.joint, right.joint, wheels.mismatch), (left.joint, right.joint), (left.sign, right.sign),
        file.foot(left.joint, right.joint, robot.front),
    )


def outline(robot: RobotModel) -> Outline:
    """Return the outline of `robot` over the floor, from the midpoint of its axle."""
    wheels = robot.wheels
    if robot.urdf:
        file = Urdf(urdf_text(Path(robot.urdf)), robot.urdf)
        return file.outline(file.foot(wheels.left_joint, wheels.right_joint, robot.front))
    plate = _plate(robot)
    return Outline(
        max(plate.x_m + plate.length_m / 2, wheels.radius_m), max(plate.length_m / 2 - plate.x_m, wheels.radius_m),
        max(plate.width_m / 2, wheels.track_m / 2 + wheels.width_m / 2),
    )


def urdf_from_model(robot: RobotModel) -> str:
    """Return the URDF generated from the TOML."""
    wheels = robot.wheels
    left_m = wheels.radius_m * (1 + wheels.mismatch / 2)
    right_m = wheels.radius_m * (1 - wheels.mismatch / 2)
    return "\n".join([
        '<robot name="robot">',
        _chassis(robot),
        _wheel("left", left_m, wheels.track_m / 2, robot),
        _wheel("right", right_m, -wheels.track_m / 2, robot),
        _caster(robot),
        "</robot>",
    ])


def _chassis(robot: RobotModel) -> str:
    plate = _plate(robot)
    moments = _box_moments(plate.mass_kg, plate.length_m, plate.width_m, 2 * plate.mass_z_m)
    shape = (
        f'<origin xyz="{plate.x_m} 0 {plate.z_m}"/>'
        f'<geometry><box size="{plate.length_m} {plate.width_m} {plate.height_m}"/></geometry>'
    )
    return (
        f'<link name="chassis">{_inertial(plate.mass_kg, moments, f"{plate.mass_x_m} 0 {plate.mass_z_m}")}'
        f"<visual>{shape}</visual><collision>{shape}</collision></link>"
    )


def _wheel(name: str, radius_m: float, y_m: float, robot: RobotModel) -> str:
    wheels = robot.wheels
    across = wheels.mass_kg * (3 * radius_m**2 + wheels.width_m**2) / 12
    inertial = _inertial(wheels.mass_kg, (across, wheels.mass_kg * radius_m**2 / 2, across), "0 0 0")
    shape = (
        '<origin xyz="0 0 0" rpy="1.5707963267948966 0 0"/>'
        f'<geometry><cylinder radius="{radius_m}" length="{wheels.width_m}"/></geometry>'
    )
    return (
        f'<link name="{name}">{inertial}<visual>{shape}</visual><collision>{shape}</collision></link>'
        + _joint(name, "continuous", f"0 {y_m} {radius_m}")
    )


def _caster(robot: RobotModel) -> str:
    caster = _ball(robot)
    radius_m = caster.radius_m
    shape = f'<geometry><sphere radius="{radius_m}"/></geometry>'
    inertial = _inertial(0.01, (1e-6, 1e-6, 1e-6), "0 0 0")
    return (
        f'<link name="caster">{inertial}<visual>{shape}</visual><collision>{shape}</collision></link>'
        + _joint("caster", "fixed", f"{caster.x_m} 0 {radius_m}")
    )


def _plate(robot: RobotModel) -> Chassis:
    assert robot.chassis is not None, "a robot without a urdf has a chassis: its model sees to that"
    return robot.chassis


def _ball(robot: RobotModel) -> Caster:
    assert robot.caster is not None, "a robot without a urdf has a caster: its model sees to that"
    return robot.caster


def _joint(child: str, kind: str, place: str) -> str:
    return (
        f'<joint name="{child}" type="{kind}"><parent link="chassis"/><child link="{child}"/>'
        f'<origin xyz="{place}"/><axis xyz="0 1 0"/></joint>'
    )


def _box_moments(mass_kg: float, x_m: float, y_m: float, z_m: float) -> tuple[float, float, float]:
    twelfth = mass_kg / 12
    return twelfth * (y_m**2 + z_m**2), twelfth * (x_m**2 + z_m**2), twelfth * (x_m**2 + y_m**2)


def _inertial(mass_kg: float, moments: tuple[float, float, float], centre: str) -> str:
    ixx, iyy, izz = moments
    return (
        f'<inertial><origin xyz="{centre}"/><mass value="{mass_kg}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial>'
    )
