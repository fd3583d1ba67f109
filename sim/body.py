"""The robot's body as URDF text. Pure.

The root link is the axle's midpoint on the floor, so that its pose is the robot's pose. Wheels whose radii differ are
hung so that both touch the floor and the plate stays level.
"""

from sim.robot_model import RobotModel

LEFT_JOINT, RIGHT_JOINT, CASTER_JOINT = 0, 1, 2


def urdf(robot: RobotModel) -> str:
    """The body; links in the order of the joint numbers above."""
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
    plate = robot.chassis
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
    radius_m = robot.caster.radius_m
    shape = f'<geometry><sphere radius="{radius_m}"/></geometry>'
    inertial = _inertial(0.01, (1e-6, 1e-6, 1e-6), "0 0 0")
    return (
        f'<link name="caster">{inertial}<visual>{shape}</visual><collision>{shape}</collision></link>'
        + _joint("caster", "fixed", f"{robot.caster.x_m} 0 {radius_m}")
    )


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
