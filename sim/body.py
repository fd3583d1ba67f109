"""The robot's body as URDF text: written from its TOML, or its own file's. Pure.

The root link of a written one is the axle's midpoint on the floor, so that its pose is the robot's pose. Wheels whose
radii differ are hung so that both touch the floor and the plate stays level.
"""

from dataclasses import dataclass
from pathlib import Path

from sightline.sim.frames import Transform
from sightline.sim.robot import Caster, Chassis, RobotModel
from sightline.sim.urdf import Outline, Urdf
from sightline.sim.xacro import urdf_text


@dataclass(frozen=True, slots=True)
class UrdfBody:
    """What PyBullet is to load, and what it must know of it."""

    text: str
    joints: tuple[str, str] = ("left", "right")
    signs: tuple[float, float] = (1.0, 1.0)
    """-1 where the joint's positive turn rolls the wheel backwards."""
    foot: Transform | None = None
    """The axle's midpoint on the floor, seen from the root link; None where it is the root link."""


def urdf_body(robot: RobotModel) -> UrdfBody:
    """The body of `robot`. Raises ConfigError for a URDF that has gone or changed since."""
    if not robot.urdf:
        return UrdfBody(urdf_from_model(robot))
    file, wheels = Urdf(urdf_text(Path(robot.urdf)), robot.urdf), robot.wheels
    left, right = file.wheels(wheels.left_joint, wheels.right_joint, robot.front)
    return UrdfBody(
        file.text(left.joint, right.joint, wheels.mismatch), (left.joint, right.joint), (left.sign, right.sign),
        file.foot(left.joint, right.joint, robot.front),
    )


def outline(robot: RobotModel) -> Outline:
    """How far `robot` reaches over the floor, from its axle's midpoint."""
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
    """The body written from its TOML."""
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
