"""Read and check a URDF or xacro file. Pure (reads files)."""

import difflib
import math
from collections.abc import Iterable, Iterator
from copy import deepcopy
from itertools import product
from pathlib import Path
from typing import Literal, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from sightline.protocol.errors import ConfigError, install_command
from sightline.sim.toml_file import is_file

Vector = tuple[float, float, float]
Rotation = tuple[Vector, Vector, Vector]
"""Rows of the matrix."""


class Transform(NamedTuple):
    """Position and rotation of a frame relative to another."""

    turn: Rotation = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    at: Vector = (0.0, 0.0, 0.0)

    def point(self, inner: Vector) -> Vector:
        """Convert a point of this frame to the outer frame."""
        x, y, z = self.direction(inner)
        return x + self.at[0], y + self.at[1], z + self.at[2]

    def direction(self, inner: Vector) -> Vector:
        """Convert a direction of this frame to the outer frame."""
        x, y, z = (sum(one * other for one, other in zip(row, inner, strict=True)) for row in self.turn)
        return x, y, z

    def of(self, inner: "Transform") -> "Transform":
        """Convert a frame within this frame to the outer frame."""
        columns = [self.direction(_column(inner.turn, index)) for index in range(3)]
        x, y, z = (_column((columns[0], columns[1], columns[2]), index) for index in range(3))
        return Transform((x, y, z), self.point(inner.at))

    def inverse(self) -> "Transform":
        """Return the outer frame, relative to this one."""
        back = Transform((_column(self.turn, 0), _column(self.turn, 1), _column(self.turn, 2)))
        x, y, z = back.direction(self.at)
        return Transform(back.turn, (-x, -y, -z))

    @property
    def yaw_rad(self) -> float:
        """Return the heading of its x axis over the floor."""
        return math.atan2(self.turn[1][0], self.turn[0][0])


def transform(at: Vector, roll_rad: float = 0.0, pitch_rad: float = 0.0, yaw_rad: float = 0.0) -> Transform:
    """Return the frame of a URDF's `xyz` and `rpy`: rotations about the fixed x, then y, then z axis."""
    cr, sr, cp, sp = math.cos(roll_rad), math.sin(roll_rad), math.cos(pitch_rad), math.sin(pitch_rad)
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    return Transform((
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    ), at)


def _column(turn: Rotation, index: int) -> Vector:
    return turn[0][index], turn[1][index], turn[2][index]


# The URDF of a robot: positions of wheels and sensors, and the outline. Pure.
#
# All positions are relative to the midpoint of the axle on the floor, x forward, for any frame in the file. A file that
# is not a two-wheeled robot is rejected with one line that names the link or joint and the fix.


Front = Literal["+x", "-x"]

_NUMBERS = {
    "xyz": 3, "rpy": 3, "size": 3, "value": 1, "radius": 1, "length": 1,
    "ixx": 1, "iyy": 1, "izz": 1, "ixy": 1, "ixz": 1, "iyz": 1,
}
_SHAPES = ("box", "cylinder", "sphere")
_JOINTS = ("fixed", "continuous", "revolute", "prismatic", "floating", "planar", "spherical")
"""Types of joints. Other types, and links below two joints, may crash PyBullet."""
_CHILDREN = {"inertial": ("mass", "inertia"), "collision": ("geometry",)}
_ATTRIBUTES = {"mass": ("value",), "inertia": ("ixx", "iyy", "izz"), "box": ("size",), "cylinder": ("radius", "length"),
               "sphere": ("radius",)}
"""Of a link, required by PyBullet, whose own lines name no link."""
_PLACED_WITHIN_M = 0.001
_ACROSS = 0.999  # cosine: a URDF that writes a quarter turn as 1.57 counts as square
_AHEAD = (Transform().turn, ((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))
_TURNED = 0.01  # of any axis: half a degree
_RIM = 0.03  # of the track width: with so narrow a rim, turns are within 0.1 % of the distance of the joints
_REST = 0.97  # of the radius
_FEATHER = (
    '<inertial><mass value="0.001"/><inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial>'
)


class Wheel(NamedTuple):
    """One driven wheel. `sign` is -1 if the joint's positive turn rolls backwards."""

    joint: str
    place: Vector
    radius_m: float
    sign: float


class Outline(NamedTuple):
    """The extent of the collision shapes over the floor, from the midpoint of the axle."""

    front_m: float
    rear_m: float
    half_width_m: float


class Urdf:
    """The URDF of one robot. Raises ConfigError if it cannot be a robot."""

    def __init__(self, text: str, name: str) -> None:
        self._name = name
        self._root = self._parsed(text)
        self._links, self._joints = self._named("link"), self._named("joint")
        self._check_numbers()
        self._check_complete()
        self._check_bodies()
        self._frames = self._link_frames()

    # --- the queries of a robot --------------------------------------------------------------------------------------

    def foot(self, left_joint: str, right_joint: str, front: Front) -> Transform:
        """Return the axle's midpoint on the floor, x forward, relative to the root link."""
        left, right = self._wheel_place(left_joint), self._wheel_place(right_joint)
        radius_m = self._wheel_radius(left_joint)
        middle = ((left[0] + right[0]) / 2, (left[1] + right[1]) / 2, (left[2] + right[2]) / 2 - radius_m)
        return transform(middle, yaw_rad=math.pi if front == "-x" else 0.0)

    def wheels(self, left_joint: str, right_joint: str, front: Front) -> tuple[Wheel, Wheel]:
        """Return the left and right wheel, relative to the axle's midpoint on the floor."""
        seen_from = self.foot(left_joint, right_joint, front).inverse()
        left, right = self._wheel(left_joint, seen_from), self._wheel(right_joint, seen_from)
        if left.place[1] <= right.place[1]:
            raise self._wrong(f"{left_joint!r} is not left of {right_joint!r}; swap the two, or turn `front`")
        uneven_m = max(abs(left.place[0]), abs(left.place[1] + right.place[1]), abs(left.place[2] - right.place[2]),
                       abs(left.radius_m - right.radius_m))
        if uneven_m > _PLACED_WITHIN_M:
            raise self._wrong(
                f"{left_joint!r} and {right_joint!r} are not a pair; use one radius, one x and opposite y, on one level"
            )
        return left, right

    def place(self, link: str, foot: Transform) -> Transform:
        """Return the position of a link relative to the midpoint of the axle on the floor."""
        if link not in self._links:
            raise self._wrong(f"has no link {link!r}{_nearest(link, self._links)}")
        return foot.inverse().of(self._frames[link])

    def mount(self, link: str, foot: Transform) -> Transform:
        """Return the position of a centered sensor that faces straight ahead. Raises ConfigError for another one.

        A camera may use its optical frame: z forward, x right.
        """
        where = self.place(link, foot)
        turned = min(max(abs(one - other) for row, rows in zip(where.turn, ahead, strict=True)
                         for one, other in zip(row, rows, strict=True)) for ahead in _AHEAD)
        if abs(where.at[1]) > _PLACED_WITHIN_M or turned > _TURNED:
            raise self._wrong(f"link {link!r} of a sensor is {where.at[1]:.3f} m left of the middle, or turned; put it "
                              "in the middle, x forward and z up, or write x_m and z_m instead of `link`")
        return where

    def outline(self, foot: Transform) -> Outline:
        """Return the outline of all collision shapes, including the wheels."""
        back = foot.inverse()
        corners = [
            back.of(self._frames[name]).of(_origin(shape)).point(corner)
            for name, link in self._links.items() for shape in link.iter("collision") for corner in _corners(shape)
        ]
        if not corners:
            raise self._wrong("has no collision shape; give the body a <collision> so that it can touch things")
        return Outline(
            max(x for x, _, _ in corners), -min(x for x, _, _ in corners), max(abs(y) for _, y, _ in corners)
        )

    def text(self, left_joint: str, right_joint: str, mismatch: float) -> str:
        """Return the URDF for PyBullet: a tiny mass for links without one, radii changed by `mismatch`.

        Wheels roll on a narrow rim, because a wide one scrubs and the robot turns 1 % short. Nothing is drawn, since
        the lens may lie within its housing.
        """
        root = ElementTree.fromstring(ElementTree.tostring(self._root))
        for axis in root.iter("axis"):
            x, y, z = _numbers(axis.get("xyz", "1 0 0"))
            # PyBullet multiplies the speed of a joint by the length of its axis.
            if (length := math.hypot(x, y, z)) not in (0.0, 1.0):
                axis.set("xyz", f"{x / length!r} {y / length!r} {z / length!r}")
        for link in root.findall("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
            if link.find("inertial") is None:
                link.append(ElementTree.fromstring(_FEATHER))
        left, right = self._wheel_place(left_joint), self._wheel_place(right_joint)
        for joint, share in ((left_joint, mismatch / 2), (right_joint, -mismatch / 2)):
            _grow(root, joint, share)
            _narrow(_child(root, joint), _RIM * math.dist(left, right))
        return ElementTree.tostring(root, "unicode")

    # --- reading -----------------------------------------------------------------------------------------------------

    def _parsed(self, text: str) -> Element:
        try:
            root = ElementTree.fromstring(text)
        except ElementTree.ParseError as error:
            raise self._wrong(f"invalid XML: {error}") from None
        if root.tag != "robot":
            raise self._wrong(f"not a URDF: its outermost element is <{root.tag}>, not <robot>")
        return root

    def _named(self, tag: str) -> dict[str, Element]:
        """Return all links or joints by name."""
        found: dict[str, Element] = {}
        for one in self._root.findall(tag):
            name = one.get("name", "")
            if not name or name in found:
                raise self._wrong(f"two of its {tag}s are named {name!r}; give each its own name" if name
                                  else f"a <{tag}> has no name; give it one")
            found[name] = one
        return found

    def _check_numbers(self) -> None:
        for owner in (*self._links.values(), *self._joints.values()):
            for element in owner.iter():
                for key, count in _NUMBERS.items():
                    text = element.get(key)
                    if text is not None and len(_numbers(text)) != count:
                        wanted = "a number" if count == 1 else f"{count} numbers"
                        raise self._wrong(f"{owner.tag} {owner.get('name')!r}: <{element.tag} {key}={text!r}> is not "
                                          f"{wanted}; write metres, kilograms and radians")

    def _check_complete(self) -> None:
        for name, link in self._links.items():
            for part in (one for one in link if one.tag in _CHILDREN):
                missing = [f"<{child}>" for child in _CHILDREN[part.tag] if part.find(child) is None]
                missing += [f"{key} in <{one.tag}>" for one in part.iter() for key in _ATTRIBUTES.get(one.tag, ())
                            if one.get(key) is None]
                if missing:
                    raise self._wrong(f"link {name!r}: its <{part.tag}> has no {missing[0]}; add it")
        for name, joint in self._joints.items():
            if joint.get("type") == "prismatic" and joint.find("limit") is None:
                raise self._wrong(f"joint {name!r} is prismatic and has no <limit>; add it")

    def _check_bodies(self) -> None:
        for name, link in self._links.items():
            mass = link.find("inertial/mass")
            if mass is not None and _number(mass, "value", 0.0) <= 0:
                raise self._wrong(f"link {name!r} has a mass of {mass.get('value')} kg; it must be above 0")
            for shape in link.iterfind("collision/geometry/*"):
                if shape.tag not in _SHAPES:
                    raise self._wrong(f"link {name!r} collides as a {shape.tag}; write it as <box>, <cylinder> or "
                                      "<sphere>")

    def _link_frames(self) -> dict[str, Transform]:
        """Return every link relative to the root, joints at zero."""
        above: dict[str, Element] = {}
        for name, joint in self._joints.items():
            for end in ("parent", "child"):
                link = _end(joint, end)
                if link not in self._links:
                    raise self._wrong(f"joint {name!r}: its {end} {link!r} is not a link{_nearest(link, self._links)}")
            if joint.get("type") not in _JOINTS:
                raise self._wrong(f"joint {name!r} has type {joint.get('type')!r}; use {', '.join(_JOINTS)}")
            child = _end(joint, "child")
            if child in above:
                raise self._wrong(f"link {child!r} is the child of two joints, {above[child].get('name')!r} and "
                                  f"{name!r}; remove one")
            above[child] = joint
        roots = [name for name in self._links if name not in above]
        if len(roots) != 1:
            raise self._wrong(f"must have one root link, it has {len(roots)}: {', '.join(roots)[:80]}")
        return {name: self._chain(name, above) for name in self._links}

    def _chain(self, link: str, above: dict[str, Element]) -> Transform:
        seen, joints = {link}, []
        while link in above:
            joints.append(above[link])
            link = _end(above[link], "parent")
            if link in seen:
                raise self._wrong(f"link {link!r} hangs from itself")
            seen.add(link)
        whole = Transform()
        for joint in reversed(joints):
            whole = whole.of(_origin(joint))
        return whole

    # --- wheels ------------------------------------------------------------------------------------------------------

    def _wheel_joint(self, name: str) -> Element:
        joint = self._joints.get(name)
        if joint is None:
            raise self._wrong(f"has no joint {name!r}{_nearest(name, self._joints)}; name the wheels' joints under "
                              "[wheels] as left_joint and right_joint")
        if joint.get("type") != "continuous":
            raise self._wrong(f"joint {name!r} is {joint.get('type')}; a wheel's joint is type=\"continuous\"")
        return joint

    def _wheel_place(self, joint: str) -> Vector:
        return self._frames[_end(self._wheel_joint(joint), "child")].at

    def _wheel_radius(self, joint: str) -> float:
        link = _end(self._wheel_joint(joint), "child")
        radii = [_number(shape, "radius", 0.0) for shape in _round_shapes(self._links[link])]
        if not radii or radii[0] <= 0:
            raise self._wrong(f"link {link!r}, a wheel, has no round <collision>; give it a <cylinder> or a <sphere>")
        return radii[0]

    def _wheel(self, name: str, seen_from: Transform) -> Wheel:
        joint = self._wheel_joint(name)
        here = seen_from.of(self._frames[_end(joint, "child")])
        axis = joint.find("axis")
        x, y, z = _numbers(axis.get("xyz", "1 0 0")) if axis is not None else (1.0, 0.0, 0.0)
        _, across, _ = here.direction((x, y, z))
        if abs(across) < _ACROSS * math.hypot(x, y, z) or not across:
            raise self._wrong(f"joint {name!r} does not turn about an axle across the robot; correct its <axis> or rpy")
        return Wheel(name, here.at, self._wheel_radius(name), math.copysign(1.0, across))

    def _wrong(self, what: str) -> ConfigError:
        return ConfigError(f"{self._name}: {what}")


def _end(joint: Element, name: str) -> str:
    """Return the parent or the child link of a joint."""
    found = joint.find(name)
    return found.get("link", "") if found is not None else ""


def _origin(element: Element) -> Transform:
    origin = element.find("origin")
    if origin is None:
        return Transform()
    x, y, z = _numbers(origin.get("xyz", "0 0 0"))
    return transform((x, y, z), *_numbers(origin.get("rpy", "0 0 0")))


def _numbers(text: str) -> list[float]:
    """Return the finite numbers of `text`, or an empty list if one is invalid."""
    try:
        values = [float(part) for part in text.split()]
    except ValueError:
        return []
    return values if all(map(math.isfinite, values)) else []


def _number(element: Element, key: str, otherwise: float) -> float:
    text = element.get(key)
    return otherwise if text is None else _numbers(text)[0]


def _round_shapes(link: Element) -> Iterator[Element]:
    for shape in link.iter("collision"):
        for kind in ("cylinder", "sphere"):
            found = shape.find(f"geometry/{kind}")
            if found is not None:
                yield found


def _corners(shape: Element) -> Iterable[Vector]:
    """Yield the corners of the box around a collision shape, in the frame of the shape."""
    half = (0.0, 0.0, 0.0)
    for kind in shape.findall("geometry/*"):
        radius = _number(kind, "radius", 0.0)
        if kind.tag == "box":
            x, y, z = _numbers(kind.get("size", "0 0 0"))
            half = (x / 2, y / 2, z / 2)
        else:
            half = (radius, radius, _number(kind, "length", 2 * radius) / 2)
    return [(x * half[0], y * half[1], z * half[2]) for x, y, z in product((-1, 1), repeat=3)]


def _grow(root: Element, joint_name: str, share: float) -> None:
    """Enlarge one wheel by a share, and mount it so that it still touches the floor."""
    if not share:
        return
    joint = next(one for one in root.findall("joint") if one.get("name") == joint_name)
    for shape in _round_shapes(_child(root, joint_name)):
        radius_m = _number(shape, "radius", 0.0)
        shape.set("radius", repr(radius_m * (1 + share)))
        origin = joint.find("origin")
        if origin is not None:
            x, y, z = _numbers(origin.get("xyz", "0 0 0"))
            origin.set("xyz", f"{x!r} {y!r} {z + radius_m * share!r}")


def _child(root: Element, joint_name: str) -> Element:
    """Return the link that a joint moves."""
    joint = next(one for one in root.findall("joint") if one.get("name") == joint_name)
    return next(one for one in root.findall("link") if one.get("name") == _end(joint, "child"))


def _narrow(link: Element, rim_m: float) -> None:
    """Let a wheel roll on a rim at its center. The rest of its width, a little smaller, keeps its collisions."""
    for shape in link.findall("collision"):
        cylinder = shape.find("geometry/cylinder")
        if cylinder is None or _number(cylinder, "length", 0.0) <= rim_m:
            continue
        rest = deepcopy(shape)
        inner = rest.find("geometry/cylinder")
        assert inner is not None, "a copy of what has one"
        inner.set("radius", repr(_REST * _number(cylinder, "radius", 0.0)))
        cylinder.set("length", repr(rim_m))
        link.append(rest)


def _nearest(name: str, names: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(names), n=1, cutoff=0.4)
    return f", did you mean {near[0]!r}?" if near else ""


# The text of a URDF, from its file or expanded from xacro. Pure (reads files, keeps no state).


def urdf_text(path: Path) -> str:
    """Return the text of the URDF in `path`. A `.xacro` is expanded and needs the extra. Raises ConfigError."""
    if not is_file(path):
        raise ConfigError(f"{path}: no such file; `urdf` names a file beside the robot's .toml")
    if path.suffix == ".xacro":
        return _expanded(path)
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None


def _expanded(path: Path) -> str:
    try:
        from xacrodoc import XacroDoc
    except ImportError:
        raise ConfigError(f"{path}: a xacro file needs xacrodoc; install it with: {install_command('xacro')}"
                          ) from None
    try:
        return str(XacroDoc.from_file(str(path)).to_urdf_string())
    except Exception as error:  # the package passes on any error of its parser
        raise ConfigError(f"{path}: xacro cannot expand it: {str(error).splitlines()[0][:160]}") from None
