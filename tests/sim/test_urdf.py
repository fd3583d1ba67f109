"""URDF files as robots: their measures, and the errors of rejected ones."""

import math
from pathlib import Path
from xml.etree import ElementTree

import pytest

from sightline.protocol.errors import ConfigError
from sightline.sim.robot import ROBOTS, load_robot, outline, urdf_body, urdf_from_model
from sightline.sim.urdf import Urdf
from tests.fixtures import demanded
from tests.fixtures.sim import robot_names

WHEELS = ("left_wheel_joint", "right_wheel_joint")


def test_the_four_robots_are_as_they_were_drawn():
    measured = {name: load_robot(name).wheels for name in robot_names()}
    assert {name: (round(one.radius_m, 6), round(one.track_m, 6)) for name, one in measured.items()} == {
        "raspberry": (0.035, 0.174), "gazebo-raspi": (0.035, 0.174), "thymio": (0.022, 0.112),
        "chaser": (0.15, 0.5), "chaser-small": (0.15, 0.5),
    }


def test_a_robot_whose_front_is_at_minus_x_has_its_sensors_in_front():
    chaser = load_robot("chaser")
    assert (chaser.camera.x_m, chaser.camera.z_m) == pytest.approx((0.6, 0.16))
    assert chaser.lidar.x_m == pytest.approx(0.485)
    reach = outline(chaser)
    assert (reach.front_m, reach.rear_m, reach.half_width_m) == pytest.approx((0.58, 0.175, 0.3))


def test_range_sensors_face_as_their_links_do():
    sensors = load_robot("thymio").lidar.sensors
    assert [(round(one.x_m, 4), round(one.y_m, 4), round(one.facing_deg, 3)) for one in sensors] == [
        (0.077, 0.0, 0.0), (0.065, 0.053, 90.0), (0.065, -0.053, -90.0),
    ]


def test_raspberry_urdf_matches_its_toml():
    drawn = ElementTree.fromstring((ROBOTS / "raspberry.urdf").read_text())
    said = ElementTree.fromstring(urdf_from_model(load_robot("raspberry")))
    said.set("name", "raspberry")
    ElementTree.indent(said)
    assert ElementTree.tostring(drawn) == ElementTree.tostring(said)


def test_a_users_own_urdf_is_a_robot(tmp_path):
    (tmp_path / "mine.urdf").write_text((ROBOTS / "raspberry.urdf").read_text())
    toml = (ROBOTS / "raspberry.toml").read_text()
    wheels = '[wheels]\nleft_joint = "left"\nright_joint = "right"\nmax_rad_s = 25.0\nmax_accel_mps2 = 2.0\n' \
        "max_torque_nm = 0.25\nlag_s = 0.05\nencoder_steps = 1440\n\n[camera]"
    (tmp_path / "mine.toml").write_text(
        'urdf = "mine.urdf"\n' + wheels + toml[toml.index("[camera]") + len("[camera]"):]
    )
    mine, own = load_robot(str(tmp_path / "mine.toml")), load_robot("raspberry")
    assert (mine.wheels.radius_m, mine.wheels.track_m) == pytest.approx((own.wheels.radius_m, own.wheels.track_m))
    assert outline(mine) == pytest.approx(outline(own))


@pytest.mark.parametrize("axis", ["0 1 0", "0 -1 0"])
def test_a_wheel_that_turns_the_other_way_round_is_driven_the_other_way(axis):
    text = (ROBOTS / "thymio.urdf").read_text().replace('<axis xyz="0 1 0"/>', f'<axis xyz="{axis}"/>')
    wheels = Urdf(text, "mine").wheels(*WHEELS, "+x")
    assert {wheel.sign for wheel in wheels} == {float(axis.split()[1])}


def test_unequal_wheels_both_touch_the_floor():
    thymio = load_robot("thymio")
    uneven = thymio.model_copy(update={"wheels": thymio.wheels.model_copy(update={"mismatch": 0.02})})
    text = Urdf(urdf_body(uneven).text, "uneven")
    heights = [text.place(link, text.foot(*WHEELS, "+x")).at[2] for link in ("left_wheel", "right_wheel")]
    assert heights[0] - heights[1] == pytest.approx(0.022 * 0.02)


def thymio_with(tmp_path: Path, drawing: tuple[str, str] = ("", ""), words: tuple[str, str] = ("", "")) -> str:
    """The path of the Thymio with something replaced in its URDF, or in its TOML."""
    for suffix, (old, new) in ((".urdf", drawing), (".toml", words)):
        text = (ROBOTS / f"thymio{suffix}").read_text()
        assert old in text
        (tmp_path / f"thymio{suffix}").write_text(text.replace(old, new, 1))
    return str(tmp_path / "thymio.toml")


@pytest.mark.parametrize(("old", "new", "expected"), [
    ('mass value="0.216"', 'mass value="-0.216"', "'main_body' has a mass of -0.216 kg; it must be above 0"),
    ('mass value="0.216"', 'mass value="0"', "must be above 0"),
    ('mass value="0.216"', 'mass value="nan"', "is not a number; write metres, kilograms and radians"),
    ('radius="0.022"', 'radius="inf"', "link 'left_wheel': <cylinder radius='inf'> is not a number"),
    ('xyz="-0.025 0.056 0.022"', 'xyz="-0.025 0.056"', "is not 3 numbers"),
    ('type="continuous"', 'type="fixed"', "joint 'left_wheel_joint' is fixed; a wheel's joint is type=\"continuous\""),
    ('xyz="-0.025 0.056 0.022"', 'xyz="0.025 0.056 0.022"',
     "are not a pair; use one radius, one x and opposite y"),
    ('<axis xyz="0 1 0"/>', '<axis xyz="1 0 0"/>', "does not turn about an axle across the robot"),
    ('<cylinder radius="0.022" length="0.015"/>', '<box size="0.1 0.1 0.1"/>', "has no round <collision>"),
    ('<box size="0.11 0.112 0.045"/>', '<mesh filename="body.stl"/>', "collides as a mesh"),
    ('<parent link="main_body"/>', '<parent link="main_bdy"/>', "is not a link, did you mean 'main_body'?"),
    ('<box size="0.11 0.112 0.045"/>', '<capsule radius="0.02" length="0.1"/>', "collides as a capsule; write it as"),
    ('<box size="0.11 0.112 0.045"/>', '<plane normal="0 0 1"/>', "collides as a plane; write it as <box>"),
    ('<link name="sensor_front"/>', '<link name="sensor_front"/><joint name="second" type="fixed"><parent '
     'link="sensor_left"/><child link="sensor_front"/></joint>',
     "link 'sensor_front' is the child of two joints, 'second' and 'front_joint'; remove one"),
    ('name="front_joint" type="fixed"', 'name="front_joint"', "joint 'front_joint' has type None; use fixed, "),
    ('name="front_joint" type="fixed"', 'name="front_joint" type="welded"', "has type 'welded'"),
    ('name="front_joint"', 'name="left_joint"', "two of its joints are named 'left_joint'; give each its own name"),
    ('<link name="sensor_front"/>', '<link name="sensor_left"/>', "two of its links are named 'sensor_left'"),
    ('<link name="sensor_front"/>', '<link name="sensor_front"/><link/>', "a <link> has no name; give it one"),
    ('<mass value="0.216"/>', "", "link 'main_body': its <inertial> has no <mass>; add it"),
    ('<mass value="0.216"/>', "<mass/>", "link 'main_body': its <inertial> has no value in <mass>; add it"),
    ('<box size="0.11 0.112 0.045"/>', "<box/>", "link 'main_body': its <collision> has no size in <box>; add it"),
    ('<cylinder radius="0.022" length="0.015"/>', '<cylinder radius="0.022"/>', "has no length in <cylinder>; add it"),
    ('name="front_joint" type="fixed"', 'name="front_joint" type="prismatic"', "is prismatic and has no <limit>"),
    ('xyz="-0.025 0.056 0.022"', 'xyz="-0.025 0.056 0.042"', "are not a pair; use one radius"),
    ('<robot name="thymio">', '<robot name="thymio"', "invalid XML"),
    ('<link name="sensor_front"/>', '<link name="sensor_front"/><link name="loose"/>', "must have one root link"),
])
def test_a_urdf_that_is_not_a_robot_is_one_line_with_the_fix(tmp_path, old, new, expected):
    with pytest.raises(ConfigError) as caught:
        load_robot(thymio_with(tmp_path, drawing=(old, new)))
    assert expected in str(caught.value)
    assert str(caught.value).startswith(str(tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("old", "new", "expected"), [
    ('left_joint = "left_wheel_joint"', 'left_joint = "left_weel_joint"', "did you mean 'left_wheel_joint'?"),
    ('left_joint = "left_wheel_joint"\n', "", "names its wheels: [wheels] left_joint and right_joint"),
    ('left_joint = "left_wheel_joint"', 'left_joint = "right_wheel_joint"', "is not left of"),
    ('link = "sensor_left"', 'link = "sensor_lft"', "has no link 'sensor_lft', did you mean 'sensor_left'?"),
    ('urdf = "thymio.urdf"', 'urdf = "thymo.urdf"', "no such file; `urdf` names a file beside the robot's .toml"),
    ('urdf = "thymio.urdf"', 'front = "-x"\nurdf = "thymio.urdf"', "is not left of 'right_wheel_joint'; swap the two"),
    ('urdf = "thymio.urdf"', 'urdf = "thymio.urdf"\nchassis = {}', "chassis"),
    ("max_torque_nm = 0.05", "max_torque_nm = nan", "wheels.max_torque_nm"),
    ('link = "camera"', 'link = "sensor_left"', "'sensor_left' of a sensor is 0.053 m left of the middle, or"),
    ('urdf = "thymio.urdf"', f'urdf = "{"x" * 300}"', "no such file; `urdf` names a file beside the robot's .toml"),
])
def test_a_toml_that_does_not_fit_its_urdf_is_one_line_too(tmp_path, old, new, expected):
    with pytest.raises(ConfigError) as caught:
        load_robot(thymio_with(tmp_path, words=(old, new)))
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("sensors", ["5", '"x"', "{ link = 'sensor_left' }"])
def test_range_sensors_that_are_not_a_list_are_one_line(tmp_path, sensors):
    toml = (ROBOTS / "thymio.toml").read_text()
    toml = toml[: toml.index("[[lidar.sensors]]")]
    path = tmp_path / "mine.toml"
    path.write_text(toml.replace("[lidar]", "[lidar]\n" + "=".join(("sensors", sensors))))
    with pytest.raises(ConfigError, match=r"mine\.toml: .* is .*, not a list of tables; write"):
        load_robot(str(path))


@pytest.mark.parametrize(("turn", "fits"), [
    ("0 0 0", True), ("-1.5708 0 -1.5708", True), ("0 0.004 0", True), ("0 0 3.1416", False), ("3.1416 0 0", False),
    ("0 0.1 0", False), ("0 0 -0.1", False),
])
def test_sensor_must_face_straight_ahead(tmp_path, turn, fits):
    path = thymio_with(tmp_path)
    text = (tmp_path / "thymio.urdf").read_text()
    joint = text[text.index('<joint name="camera_joint"'):]
    joint = joint[: joint.index("</joint>")]
    turned = joint.replace("<origin ", f'<origin rpy="{turn}" ')
    assert turned != joint
    (tmp_path / "thymio.urdf").write_text(text.replace(joint, turned))
    if fits:
        assert load_robot(path).camera.x_m == load_robot("thymio").camera.x_m
    else:
        with pytest.raises(ConfigError, match=r"link 'camera' of a sensor is 0\.000 m left of the middle, or turned"):
            load_robot(path)


@pytest.mark.parametrize("factor", [2.0, 0.1])
def test_length_of_an_axis_changes_nothing(factor):
    text = (ROBOTS / "thymio.urdf").read_text()
    long = text.replace('<axis xyz="0 1 0"/>', f'<axis xyz="0 {factor} 0"/>')
    assert long != text
    short = Urdf(long, "mine").text(*WHEELS, 0.0).replace("0.0 1.0 0.0", "0 1 0")
    assert short == Urdf(text, "mine").text(*WHEELS, 0.0)


def test_xacro_file_without_the_extra_prints_the_install_command(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "xacrodoc", None)
    (tmp_path / "mine.urdf.xacro").write_text("<robot/>")
    path = thymio_with(tmp_path, words=('urdf = "thymio.urdf"', 'urdf = "mine.urdf.xacro"'))
    with pytest.raises(ConfigError, match=r"pip install --editable '\.\[xacro\]'"):
        load_robot(path)


def test_a_joint_that_lies_by_a_quarter_turn_is_measured_where_it_is():
    chaser = Urdf((ROBOTS / "chaser.urdf").read_text(), "chaser")
    left, right = chaser.wheels("wheel_left_joint", "wheel_right_joint", "-x")
    assert left.place == pytest.approx((0.0, 0.25, 0.15), abs=1e-9)
    assert right.place == pytest.approx((0.0, -0.25, 0.15), abs=1e-9)
    lens = chaser.place("camera", chaser.foot("wheel_left_joint", "wheel_right_joint", "-x"))
    assert math.degrees(lens.yaw_rad) == pytest.approx(0.0, abs=1e-6)


def test_a_xacro_file_is_expanded(tmp_path):
    demanded.module("xacrodoc", "xacro")
    text = (ROBOTS / "thymio.urdf").read_text().replace('radius="0.022"', 'radius="${wheel}"')
    head = '<robot name="mine" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:property name="wheel" value="0.03"/>'
    path = thymio_with(tmp_path, words=('urdf = "thymio.urdf"', 'urdf = "mine.urdf.xacro"'))
    (tmp_path / "mine.urdf.xacro").write_text(text.replace('<robot name="thymio">', head))
    assert load_robot(path).wheels.radius_m == 0.03
    (tmp_path / "mine.urdf.xacro").write_text(text.replace('<robot name="thymio">', head.replace("wheel", "weel")))
    with pytest.raises(ConfigError, match="xacro cannot expand it"):
        load_robot(path)
