"""More families of textures, beside those of `sim/scene_textures.py`: what lies about, what is in no room. Pure."""

from typing import Final

import cv2
import numpy as np

from sightline.sim.scenes.textures import SIDE, Field, Random, grid, mixed, near, rgb

_TEXT: Final = "abcdefghijkmnoprstuvwxyzABCDEFGHKLMNRSTXY0123456789 "


def palette(draw: Random) -> Field:
    """Two to eight colours (N, 3): of all kinds, or all near one."""
    count, base = int(draw.integers(2, 9)), rgb(draw)
    alike = draw.random() < 0.4
    return np.stack([near(draw, base) if alike else rgb(draw) for _ in range(count)])


def leaves(draw: Random) -> Field:
    """Flat shapes of all sizes, each over those before it (dead leaves: Lee, Mumford and Huang, 2001)."""
    colours, tile = palette(draw), np.ascontiguousarray(np.broadcast_to(rgb(draw), (SIDE, SIDE, 3)))
    kinds, steep, largest = draw.integers(0, 3, 2), draw.uniform(1.0, 3.0), draw.uniform(6, 50)
    for _ in range(int(draw.integers(20, 200))):
        size = 2 + largest * draw.random() ** steep
        middle, colour = draw.integers(0, SIDE, 2), colours[int(draw.integers(len(colours)))].tolist()
        turn = draw.uniform(0, 2 * np.pi)
        points = _outline(draw, int(kinds[int(draw.integers(2))]), size, turn) + middle
        for off in ((0, 0), (-SIDE, 0), (0, -SIDE), (-SIDE, -SIDE)):  # so that the tile's borders meet
            cv2.fillPoly(tile, [np.rint(points + off).astype(np.int32)], colour)
    return tile


def _outline(draw: Random, kind: int, size: float, turn: float) -> Field:
    """Corners (N, 2) of an ellipse, a rectangle or a crooked polygon about the origin."""
    count = (16, 4, int(draw.integers(3, 9)))[kind]
    around = np.linspace(0, 2 * np.pi, count, endpoint=False) + np.pi / 4
    far = size * (draw.uniform(0.4, 1.0, count) if kind == 2 else np.ones(count))
    flat = draw.uniform(0.2, 1.0)
    x, y, cos, sin = far * np.cos(around), flat * far * np.sin(around), np.cos(turn), np.sin(turn)
    return np.asarray(np.stack([x * cos - y * sin, x * sin + y * cos], 1), np.float32)


def spectrum(draw: Random) -> Field:
    """Noise whose strength falls with frequency, along one way faster than along the other, in two or three colours."""
    down, right = np.meshgrid(np.fft.fftfreq(SIDE), np.fft.rfftfreq(SIDE), indexing="ij")
    flat = 2.0 ** draw.uniform(-2, 2)
    far = np.hypot(down * flat, right / flat)
    far[0, 0] = 1.0
    strength = far ** -draw.uniform(0.5, 2.5)
    strength[0, 0] = 0.0
    colours = [rgb(draw) for _ in range(3)]
    tile = mixed(_wave(draw, strength), colours[0], colours[1] if draw.random() < 0.5 else near(draw, colours[0]))
    return mixed(_wave(draw, strength), tile, colours[2]) if draw.random() < 0.5 else tile


def _wave(draw: Random, strength: Field) -> Field:
    """Noise (SIDE, SIDE) of that spectrum, 0..1."""
    field = np.fft.irfft2(strength * np.exp(2j * np.pi * draw.random(strength.shape)), (SIDE, SIDE))
    low, high = np.quantile(field, (0.02, 0.98))
    return np.asarray(np.clip((field - low) / max(float(high - low), 1e-9), 0, 1), np.float32)


def scribbles(draw: Random) -> Field:
    """Lines that wander, thick and thin."""
    tile, colours = np.ascontiguousarray(np.broadcast_to(rgb(draw), (SIDE, SIDE, 3))), palette(draw)
    for _ in range(int(draw.integers(3, 40))):
        turns = np.cumsum(draw.normal(0, 0.4, 40)) + draw.uniform(0, 6.3)
        steps = np.stack([np.cos(turns), np.sin(turns)], 1) * draw.uniform(1, 6)
        path = np.rint(np.cumsum(steps, 0) + draw.integers(0, SIDE, 2)).astype(np.int32)
        colour = colours[int(draw.integers(len(colours)))].tolist()
        cv2.polylines(tile, [path], False, colour, int(draw.integers(1, 7)))
    return tile


def speckle(draw: Random) -> Field:
    """Carpet: each small grain of one of a few colours."""
    colours, count = palette(draw), SIDE // int(draw.integers(1, 4))
    grains = colours[draw.choice(len(colours), (count, count), p=draw.dirichlet(np.ones(len(colours))))]
    return np.asarray(cv2.resize(grains, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), np.float32)


def plaid(draw: Random) -> Field:
    """Validated only: bands across bands, both seen through each other."""
    x, y = grid()
    tile, colours = np.broadcast_to(rgb(draw), (SIDE, SIDE, 3)), palette(draw)
    for _ in range(int(draw.integers(3, 9))):
        begin, wide = draw.random(), draw.uniform(0.02, 0.2)
        band = (((x if draw.random() < 0.5 else y) - begin) % 1.0 < wide).astype(np.float32) * draw.uniform(0.3, 0.8)
        tile = tile + band[..., None] * (colours[int(draw.integers(len(colours)))] - tile)
    return np.asarray(tile, np.float32)


def scales(draw: Random) -> Field:
    """Validated only: rows of discs, each row over the one before it, as on a fish or a roof."""
    rows, colours = int(draw.integers(3, 9)) * 2, palette(draw)
    tile, step = np.ascontiguousarray(np.broadcast_to(colours[0], (SIDE, SIDE, 3))), SIDE / rows
    rim = (0.6 * colours[0]).tolist()
    for row in range(-2, rows + 2):
        for column in range(-1, rows // 2 + 2):
            middle = int((2 * column + row % 2) * step), int((rows - row) * step)
            colour = colours[int(draw.integers(len(colours)))].tolist()
            cv2.circle(tile, middle, int(1.2 * step), colour, -1)
            cv2.circle(tile, middle, int(1.2 * step), rim, 1)
    return tile


def script(draw: Random) -> Field:
    """Validated only: printed lines."""
    tile = np.empty((SIDE, SIDE, 3), np.uint8)  # the only kind that OpenCV writes on
    tile[:], ink = rgb(draw), rgb(draw).tolist()
    scale = draw.uniform(0.3, 2.0)
    thick, high = max(1, int(2 * scale)), int(26 * scale)
    for row in range(SIDE // high + 2):
        line = "".join(_TEXT[int(one)] for one in draw.integers(0, len(_TEXT), 40))
        cv2.putText(tile, line, (-int(draw.integers(20)), row * high), int(draw.integers(4)), scale, ink, thick)
    return tile.astype(np.float32)


def ridges(draw: Random) -> Field:
    """Validated only: slopes that rise and break off, as of a blind or a flight of stairs."""
    x, y = grid()
    along = int(draw.integers(1, 8)) * x + int(draw.integers(0, 8)) * y
    return mixed(np.asarray((along % 1.0) ** draw.uniform(0.5, 2.0), np.float32), rgb(draw), rgb(draw))
