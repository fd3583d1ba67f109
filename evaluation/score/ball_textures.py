"""The surfaces of balls: albedo, bumps and highlights over the unit sphere. Pure."""

import colorsys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Texture = Callable[[Floats], Floats]
"""Points on the unit sphere, (n, 3), to linear RGB albedo, (n, 3)."""

KINDS = ("yellow", "tennis", "orange", "blue", "green", "red", "white", "basketball", "football")

_PLAIN = {
    "yellow": ((45, 58), (0.65, 1.0), (0.8, 1.0)),
    "tennis": ((60, 75), (0.4, 0.72), (0.75, 0.95)),
    "orange": ((15, 30), (0.75, 1.0), (0.8, 1.0)),
    "blue": ((205, 235), (0.55, 0.95), (0.4, 0.9)),
    "green": ((100, 145), (0.45, 0.9), (0.35, 0.85)),
    "red": ((-10, 8), (0.7, 0.95), (0.55, 0.92)),
    "white": ((20, 60), (0.0, 0.1), (0.86, 0.97)),
    "basketball": ((14, 26), (0.65, 0.9), (0.55, 0.85)),
}
"""Hue in degrees, saturation and value, as an image shows them: sRGB."""
_GAMMA = 2.2


@dataclass(frozen=True, slots=True)
class BallSurface:
    """The material of a ball."""

    texture: Texture
    turn: Floats
    """(3, 3) rotation from the camera frame to the ball's."""
    gloss: float
    shininess: float
    """Exponent of the highlight."""
    wrap: float = 0.0
    """Reach of light beyond the terminator, because felt scatters it."""
    rim: float = 0.0
    """Brightness of the fibers at the edge."""
    fuzz: float = 0.0
    """Depth of the irregular edge, in radii."""
    bump: float = 0.0
    """Slope of the bumps."""
    bumps_per_radian: float = 1.0

    def at(self, normals: Floats) -> tuple[Floats, Floats]:
        """Return albedo and bumped normals, both (n, 3), at normals of the camera frame."""
        points = normals @ self.turn.T
        if not self.bump:
            return self.texture(points), normals
        waves = points * self.bumps_per_radian
        slope = np.sin(waves[:, [1, 2, 0]]) * np.cos(waves[:, [2, 0, 1]])
        bumpy = normals + self.bump * (slope @ self.turn).astype(np.float32)
        return self.texture(points), bumpy / np.linalg.norm(bumpy, axis=1, keepdims=True)


def surface(kind: str, rng: np.random.Generator) -> BallSurface:
    """Draw a ball of `kind`, one of KINDS."""
    turn = _rotation(rng)
    if kind == "tennis":
        return BallSurface(_tennis(rng), turn, 0.0, 1, wrap=0.35, rim=0.35, fuzz=0.03, bump=0.25, bumps_per_radian=31)
    if kind == "basketball":
        gloss = float(rng.uniform(0.08, 0.3))
        return BallSurface(_basketball(rng), turn, gloss, float(rng.uniform(12, 40)), bump=0.18, bumps_per_radian=47)
    texture = _football(rng) if kind == "football" else _plain(kind, rng)
    if rng.random() < 0.6:
        return BallSurface(texture, turn, float(rng.uniform(0.4, 1.0)), float(rng.uniform(40, 250)))
    return BallSurface(texture, turn, float(rng.uniform(0.05, 0.15)), float(rng.uniform(6, 20)), wrap=0.1)


def _rotation(rng: np.random.Generator) -> Floats:
    """Draw a random rotation, (3, 3), from a random unit quaternion."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ],
        np.float32,
    )


def _linear(hue_deg: float, saturation: float, value: float) -> Floats:
    return np.array(colorsys.hsv_to_rgb(hue_deg / 360 % 1, saturation, value), np.float32) ** np.float32(_GAMMA)


def _draw(kind: str, rng: np.random.Generator) -> Floats:
    """Draw a linear color of a kind, (3,)."""
    hue, saturation, value = (float(rng.uniform(*limits)) for limits in _PLAIN[kind])
    return _linear(hue, saturation, value)


def _mottle(rng: np.random.Generator, strength: float, waves: float) -> Texture:
    """Draw smooth unevenness around 1, (n, 1): dirt, wear, fibers."""
    along, phase = rng.normal(0, waves, (3, 12)).astype(np.float32), rng.uniform(0, 6.28, 12).astype(np.float32)

    def at(points: Floats) -> Floats:
        return np.asarray(1 + strength * np.sin(points @ along + phase).mean(axis=1, keepdims=True), np.float32)

    return at


def _mix(base: Floats, other: Floats, share: Floats) -> Floats:
    """Blend `other` over `base` by `share`, (n,)."""
    return (base + (other - base) * np.clip(share, 0, 1)[:, None]).astype(np.float32)


def _plain(kind: str, rng: np.random.Generator) -> Texture:
    color, mottle = _draw(kind, rng), _mottle(rng, 0.12, 3)
    return lambda points: color * mottle(points)


def _tennis(rng: np.random.Generator) -> Texture:
    """Draw felt with a curved white seam: a (a cos t + b cos 3t, a sin t - b sin 3t, 2 sqrt(ab) sin 2t), a + b = 1."""
    color, fibers, wear = _draw("tennis", rng), _mottle(rng, 0.35, 25), _mottle(rng, 0.2, 3)
    t = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    a, b = 0.73, 0.27
    curve = (a * np.cos(t) + b * np.cos(3 * t), a * np.sin(t) - b * np.sin(3 * t), 2 * (a * b) ** 0.5 * np.sin(2 * t))
    seam = np.stack(curve).astype(np.float32)
    white, half_width = _linear(60, 0.08, float(rng.uniform(0.8, 0.95))), float(rng.uniform(0.05, 0.07))

    def at(points: Floats) -> Floats:
        away = np.arccos(np.clip((points @ seam).max(axis=1), -1, 1))
        return _mix(color * fibers(points) * wear(points), white, (half_width - away) / 0.03 + 0.5)

    return at


def _basketball(rng: np.random.Generator) -> Texture:
    """Draw two great circles and two bent seams around the x axis."""
    color, wear, black = _draw("basketball", rng), _mottle(rng, 0.25, 4), _linear(0, 0, float(rng.uniform(0.08, 0.2)))
    pebbles, half_width = _mottle(rng, 0.3, 45), float(rng.uniform(0.02, 0.035))

    def at(points: Floats) -> Floats:
        x, z = points[:, 0], points[:, 2]
        bent = np.abs(x) - 0.5 - 0.28 * z * z
        steep = np.stack([np.sign(x), np.zeros_like(x), -0.56 * z], axis=1)
        steep -= points * (steep * points).sum(axis=1, keepdims=True)
        lines = [np.abs(x), np.abs(z), np.abs(bent) / np.maximum(np.linalg.norm(steep, axis=1), 0.2)]
        away = np.min(lines, axis=0)
        return _mix(color * wear(points) * pebbles(points), black, (half_width - away) / 0.015 + 0.5)

    return at


def _icosahedron() -> tuple[Floats, Floats]:
    """Return the directions of a football's 12 pentagons and 20 hexagons: vertices and faces of an icosahedron."""
    golden = (1 + 5**0.5) / 2
    signs = [(s, t) for s in (-1, 1) for t in (-1, 1)]
    vertices = np.array([np.roll([0, s, t * golden], k) for k in range(3) for s, t in signs])
    vertices /= np.linalg.norm(vertices[0])
    near = vertices @ vertices.T > 0.4
    faces = [vertices[[i, j, k]].sum(axis=0) for i in range(12) for j in range(i) for k in range(j)
             if near[i, j] and near[j, k] and near[i, k]]  # fmt: skip
    return vertices.astype(np.float32), (np.array(faces) / np.linalg.norm(faces[0])).astype(np.float32)


_PENTAGONS, _HEXAGONS = _icosahedron()
_CUBE = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
_PENTAGON_DISTANCE, _HEXAGON_DISTANCE = 2.3274, 2.2673
"""From the center to the faces of a truncated icosahedron with edges of length 1."""


def _bright(rng: np.random.Generator) -> Floats:
    """Draw a printed color, (3,)."""
    return _linear(float(rng.uniform(0, 360)), float(rng.uniform(0.6, 1)), float(rng.uniform(0.3, 0.95)))


def _football(rng: np.random.Generator) -> Texture:
    """Draw one of five designs: classic, colored hexagons, panels, stripes, spots."""
    design = rng.choice(["classic", "hexagons", "panels", "stripes", "spots"], p=[0.4, 0.15, 0.15, 0.15, 0.15])
    white = _linear(float(rng.uniform(30, 230)), float(rng.uniform(0, 0.06)), float(rng.uniform(0.82, 0.97)))
    black, first, second = _linear(220, 0.2, float(rng.uniform(0.07, 0.2))), _bright(rng), _bright(rng)
    football = np.concatenate([_PENTAGONS / _PENTAGON_DISTANCE, _HEXAGONS / _HEXAGON_DISTANCE])
    if design == "classic":
        dark = black if rng.random() < 0.75 else first
        return _panels(football, np.array([dark] * 12 + [white] * 20))
    if design == "hexagons":
        colors = [white] * 12 + [(first, second, white)[int(i)] for i in rng.integers(0, 3, 20)]
        return _panels(football, np.array(colors))
    if design == "panels":
        normals = _PENTAGONS if rng.random() < 0.5 else _CUBE
        return _panels(normals, np.array([(white, first, white, second)[i % 4] for i in range(len(normals))]))
    seams = _panels(football, np.array([white] * 32))
    return _stripes(seams, first, second, rng) if design == "stripes" else _spots(seams, first, black, rng)


def _panels(normals: Floats, colors: Floats) -> Texture:
    """Return flat panels projected onto the sphere: `normals` over the distances of the faces, and their colors."""

    def at(points: Floats) -> Floats:
        near = points @ normals.T
        panel = near.argmax(axis=1)
        two = np.partition(near, -2, axis=1)[:, -2:]
        gap: Floats = np.asarray((two[:, 1] - two[:, 0]) / np.linalg.norm(normals[0]), np.float32)
        return _mix(colors[panel], colors[panel] * np.float32(0.45), (0.013 - gap) / 0.01)

    return at


def _stripes(base: Texture, first: Floats, second: Floats, rng: np.random.Generator) -> Texture:
    """Return two wavy bands over `base`."""
    waves, height, width = int(rng.integers(2, 5)), float(rng.uniform(0.05, 0.25)), float(rng.uniform(0.1, 0.25))

    def at(points: Floats) -> Floats:
        level = points[:, 2] + height * np.sin(waves * np.arctan2(points[:, 1], points[:, 0]))
        once = _mix(base(points), first, (width - np.abs(level - 0.35)) / 0.02)
        return _mix(once, second, (width - np.abs(level + 0.35)) / 0.02)

    return at


def _spots(base: Texture, first: Floats, black: Floats, rng: np.random.Generator) -> Texture:
    """Return printed figures around the centers of hexagons or pentagons over `base`: a dark one in a colored one."""
    middles, size = (_HEXAGONS, 0.28) if rng.random() < 0.5 else (_PENTAGONS, 0.4)
    lobes, depth = int(rng.integers(3, 6)), float(rng.uniform(0.1, 0.5))

    def at(points: Floats) -> Floats:
        near = points @ middles.T
        which = near.argmax(axis=1)
        away = np.arccos(np.clip(near.max(axis=1), -1, 1))
        axis = np.roll(middles, 1, axis=1)[which]
        side = np.cross(middles[which], axis)
        turn: Floats = np.arctan2((points * side).sum(axis=1), (points * axis).sum(axis=1))
        away = away * (1 + depth * np.cos(lobes * turn))
        return _mix(_mix(base(points), first, (size - away) / 0.02), black, (0.5 * size - away) / 0.02)

    return at
