"""Tileable textures of floors and walls. Pure."""

from collections.abc import Callable
from functools import cache
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from sightline.sim.scenes.model import HARDER_FROM, LATER_FROM, SCORED_FROM, VALIDATED_FROM
from sightline.sim.world.camera import floor_tile

SIDE: Final = 128
"""Pixels of a tile, each way."""
Random = np.random.Generator
Texture = npt.NDArray[np.uint8]
Field = npt.NDArray[np.float32]


def any_rgb(draw: Random, saturation: tuple[float, float] = (0.0, 1.0), value: tuple[float, float] = (0.2, 1.0),
            hue_deg: tuple[float, float] = (0.0, 360.0)) -> tuple[float, float, float]:
    """Draw a color, 0..1."""
    hsv = np.array([[[draw.uniform(*hue_deg), draw.uniform(*saturation), draw.uniform(*value)]]], np.float32)
    red, green, blue = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def rgb(draw: Random) -> Field:
    """Draw the color of a floor or a wall. Half of them are dull, as in most rooms."""
    high = 1.0 if draw.random() < 0.5 else 0.3
    return np.array(any_rgb(draw, (0.0, high)), np.float32) * 255


def mixed(share: Field, low: Field, high: Field) -> Field:
    """Blend two colors by `share` (SIDE, SIDE)."""
    return np.asarray(low + share[..., None] * (high - low), np.float32)


def near(draw: Random, colour: Field) -> Field:
    """Return the same color, a little lighter or darker."""
    return np.asarray(np.clip(colour * draw.uniform(0.6, 1.3) + draw.uniform(-15, 15, 3), 0, 255), np.float32)


def soft(draw: Random, sigma: float) -> Field:
    """Draw smooth tileable noise, 0..1."""
    small = max(4, int(SIDE / max(sigma, 1.0)))
    coarse = np.tile(draw.random((small, small), np.float32), (3, 3))
    big = cv2.resize(coarse, (3 * SIDE, 3 * SIDE), interpolation=cv2.INTER_CUBIC)[SIDE : 2 * SIDE, SIDE : 2 * SIDE]
    return np.asarray((big - big.min()) / max(float(np.ptp(big)), 1e-6), np.float32)


def grid() -> tuple[Field, Field]:
    steps = np.arange(SIDE, dtype=np.float32) / SIDE
    return np.broadcast_to(steps, (SIDE, SIDE)), np.broadcast_to(steps[:, None], (SIDE, SIDE))


# Further texture families: scattered objects, and patterns that no room has. Pure.


_TEXT: Final = "abcdefghijkmnoprstuvwxyzABCDEFGHKLMNRSTXY0123456789 "


def palette(draw: Random) -> Field:
    """Draw two to eight colors (N, 3): of all kinds, or all near one."""
    count, base = int(draw.integers(2, 9)), rgb(draw)
    alike = draw.random() < 0.4
    return np.stack([near(draw, base) if alike else rgb(draw) for _ in range(count)])


def leaves(draw: Random) -> Field:
    """Draw flat shapes of all sizes, each over the earlier ones (dead leaves: Lee, Mumford and Huang, 2001)."""
    colours, tile = palette(draw), np.ascontiguousarray(np.broadcast_to(rgb(draw), (SIDE, SIDE, 3)))
    kinds, steep, largest = draw.integers(0, 3, 2), draw.uniform(1.0, 3.0), draw.uniform(6, 50)
    for _ in range(int(draw.integers(20, 200))):
        size = 2 + largest * draw.random() ** steep
        middle, colour = draw.integers(0, SIDE, 2), colours[int(draw.integers(len(colours)))].tolist()
        turn = draw.uniform(0, 2 * np.pi)
        points = _outline(draw, int(kinds[int(draw.integers(2))]), size, turn) + middle
        for off in ((0, 0), (-SIDE, 0), (0, -SIDE), (-SIDE, -SIDE)):  # so that the borders of the tile match
            cv2.fillPoly(tile, [np.rint(points + off).astype(np.int32)], colour)
    return tile


def _outline(draw: Random, kind: int, size: float, turn: float) -> Field:
    """Return corners (N, 2) of an ellipse, a rectangle or an irregular polygon around the origin."""
    count = (16, 4, int(draw.integers(3, 9)))[kind]
    around = np.linspace(0, 2 * np.pi, count, endpoint=False) + np.pi / 4
    far = size * (draw.uniform(0.4, 1.0, count) if kind == 2 else np.ones(count))
    flat = draw.uniform(0.2, 1.0)
    x, y, cos, sin = far * np.cos(around), flat * far * np.sin(around), np.cos(turn), np.sin(turn)
    return np.asarray(np.stack([x * cos - y * sin, x * sin + y * cos], 1), np.float32)


def spectrum(draw: Random) -> Field:
    """Draw anisotropic noise whose strength falls with frequency, in two or three colors."""
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
    """Return noise (SIDE, SIDE) of this spectrum, 0..1."""
    field = np.fft.irfft2(strength * np.exp(2j * np.pi * draw.random(strength.shape)), (SIDE, SIDE))
    low, high = np.quantile(field, (0.02, 0.98))
    return np.asarray(np.clip((field - low) / max(float(high - low), 1e-9), 0, 1), np.float32)


def scribbles(draw: Random) -> Field:
    """Draw wandering lines, thick and thin."""
    tile, colours = np.ascontiguousarray(np.broadcast_to(rgb(draw), (SIDE, SIDE, 3))), palette(draw)
    for _ in range(int(draw.integers(3, 40))):
        turns = np.cumsum(draw.normal(0, 0.4, 40)) + draw.uniform(0, 6.3)
        steps = np.stack([np.cos(turns), np.sin(turns)], 1) * draw.uniform(1, 6)
        path = np.rint(np.cumsum(steps, 0) + draw.integers(0, SIDE, 2)).astype(np.int32)
        colour = colours[int(draw.integers(len(colours)))].tolist()
        cv2.polylines(tile, [path], False, colour, int(draw.integers(1, 7)))
    return tile


def speckle(draw: Random) -> Field:
    """Draw carpet: small grains, each of one of a few colors."""
    colours, count = palette(draw), SIDE // int(draw.integers(1, 4))
    grains = colours[draw.choice(len(colours), (count, count), p=draw.dirichlet(np.ones(len(colours))))]
    return np.asarray(cv2.resize(grains, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST), np.float32)


def plaid(draw: Random) -> Field:
    """Draw bands across bands, both translucent. Only for validation."""
    x, y = grid()
    tile, colours = np.broadcast_to(rgb(draw), (SIDE, SIDE, 3)), palette(draw)
    for _ in range(int(draw.integers(3, 9))):
        begin, wide = draw.random(), draw.uniform(0.02, 0.2)
        band = (((x if draw.random() < 0.5 else y) - begin) % 1.0 < wide).astype(np.float32) * draw.uniform(0.3, 0.8)
        tile = tile + band[..., None] * (colours[int(draw.integers(len(colours)))] - tile)
    return np.asarray(tile, np.float32)


def scales(draw: Random) -> Field:
    """Draw rows of discs that overlap, as on a fish or a roof. Only for validation."""
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
    """Draw printed lines. Only for validation."""
    tile = np.empty((SIDE, SIDE, 3), np.uint8)  # the only type that OpenCV writes on
    tile[:], ink = rgb(draw), rgb(draw).tolist()
    scale = draw.uniform(0.3, 2.0)
    thick, high = max(1, int(2 * scale)), int(26 * scale)
    for row in range(SIDE // high + 2):
        line = "".join(_TEXT[int(one)] for one in draw.integers(0, len(_TEXT), 40))
        cv2.putText(tile, line, (-int(draw.integers(20)), row * high), int(draw.integers(4)), scale, ink, thick)
    return tile.astype(np.float32)


def ridges(draw: Random) -> Field:
    """Draw slopes that rise and break off, as of a blind or a flight of stairs. Only for validation."""
    x, y = grid()
    along = int(draw.integers(1, 8)) * x + int(draw.integers(0, 8)) * y
    return mixed(np.asarray((along % 1.0) ** draw.uniform(0.5, 2.0), np.float32), rgb(draw), rgb(draw))


# Floors and walls of scenes: families of tileable textures of any color. Pure (NumPy, OpenCV).
#
# Three lists: for training, for the choice of thresholds, and for scores only.


_FLOORS = 16  # of the simulated room; each takes as long to make as a scene


def texture(family: str, seed: int) -> Texture:
    """Return a tile (SIDE, SIDE, 3), RGB, of this family."""
    draw = np.random.default_rng([seed, 12])
    tile = FAMILIES[family](draw)
    grain = draw.normal(0.0, draw.uniform(0.0, 5.0), (SIDE, SIDE, 1)).astype(np.float32)
    return np.asarray(np.clip(np.rint(tile + grain), 0, 255), np.uint8)


def _plain(draw: Random) -> Field:
    return np.broadcast_to(rgb(draw), (SIDE, SIDE, 3))


def _clouds(draw: Random) -> Field:
    base = rgb(draw)
    other = near(draw, base) if draw.random() < 0.6 else rgb(draw)
    share = sum(soft(draw, 2.0**k) * 2.0**k for k in range(1, 6)) / 62.0
    return mixed(np.asarray(share, np.float32), base, other)


def _boards(draw: Random) -> Field:
    """Draw the floor of the simulated room, also in other colors."""
    whole = _room_floor(int(draw.integers(_FLOORS)))
    down, right = draw.integers(0, len(whole) - SIDE, 2).tolist()
    tile = whole[down : down + SIDE, right : right + SIDE].astype(np.float32)
    return tile if draw.random() < 0.4 else np.clip(tile * rgb(draw) / 118.0, 0, 255)


@cache
def _room_floor(seed: int) -> Texture:
    return floor_tile(seed)


def _checks(draw: Random) -> Field:
    x, y = grid()
    count = int(draw.integers(1, 7)) * 2
    odd = (np.floor(x * count) + np.floor(y * count)) % 2
    return mixed(odd.astype(np.float32), rgb(draw), rgb(draw))


def _stripes(draw: Random) -> Field:
    x, y = grid()
    count, share = int(draw.integers(2, 16)), draw.uniform(0.2, 0.8)
    along = x if draw.random() < 0.5 else y
    return mixed(((along * count) % 1.0 < share).astype(np.float32), rgb(draw), rgb(draw))


def _blots(draw: Random) -> Field:
    rough = soft(draw, draw.uniform(6, 30))
    return mixed((rough > draw.uniform(0.35, 0.65)).astype(np.float32), rgb(draw), rgb(draw))


def _dots(draw: Random) -> Field:
    """Draw flat discs, which are not balls."""
    x, y = grid()
    count, radius = int(draw.integers(2, 8)), draw.uniform(0.15, 0.4)
    off = np.hypot((x * count) % 1.0 - 0.5, (y * count) % 1.0 - 0.5)
    return mixed((off < radius).astype(np.float32), rgb(draw), rgb(draw))


def _bricks(draw: Random) -> Field:
    x, y = grid()
    rows, columns = int(draw.integers(3, 9)) * 2, int(draw.integers(2, 6))
    row = np.floor(y * rows)
    joint = (((x * columns + 0.5 * (row % 2)) % 1.0 < 0.06) | ((y * rows) % 1.0 < 0.12)).astype(np.float32)
    return mixed(joint, rgb(draw), rgb(draw))


def _quilt(draw: Random) -> Field:
    """Combine two of the families above by a mask, so that no two tiles are alike. Sometimes the contrast is low."""
    one, two = (FAMILIES[_PIECES[int(draw.integers(len(_PIECES)))]](draw) for _ in range(2))
    share = soft(draw, draw.uniform(4, 40)) if draw.random() < 0.5 else _checks(draw)[..., 0] / 255
    sharp = np.asarray(share > draw.uniform(0.3, 0.7), np.float32)
    tile = one + sharp[..., None] * (two - one)
    return np.asarray(tile + draw.uniform(0.0, 0.7) * (tile.mean((0, 1)) - tile), np.float32)


def _patchwork(draw: Random) -> Field:
    """Combine two to four trained families through masks of shapes or clouds, sometimes translucent."""
    tile = FAMILIES[_PATCHES[int(draw.integers(len(_PATCHES)))]](draw)
    for _ in range(int(draw.integers(1, 4))):
        over = FAMILIES[_PATCHES[int(draw.integers(len(_PATCHES)))]](draw)
        mask = leaves(draw)[..., 0] / 255 if draw.random() < 0.5 else soft(draw, draw.uniform(4, 40))
        share = (mask > np.quantile(mask, draw.uniform(0.3, 0.7))) * (1.0 if draw.random() < 0.7 else 0.5)
        tile = mixed(np.asarray(share, np.float32), tile, over)
    return np.asarray(tile + draw.uniform(0.0, 0.7) * (tile.mean((0, 1)) - tile), np.float32)


def _mosaic(draw: Random) -> Field:
    """Draw small squares of colors around two, with joints. Only for scores."""
    count = int(draw.integers(4, 14))
    one, two = rgb(draw), rgb(draw)
    colours = np.stack([near(draw, one if draw.random() < 0.5 else two) for _ in range(count * count)])
    tile = cv2.resize(colours.reshape(count, count, 3), (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    x, y = grid()
    joint = (((x * count) % 1.0 < 0.08) | ((y * count) % 1.0 < 0.08)).astype(np.float32)
    return np.asarray(tile * (1 - 0.5 * joint[..., None]), np.float32)


def _stones(draw: Random) -> Field:
    """Draw cells around random points, which wrap. Only for scores."""
    count = int(draw.integers(8, 40))
    points = draw.random((count, 2)).astype(np.float32)
    x, y = grid()
    away = [np.hypot(np.abs((x - px + 0.5) % 1.0 - 0.5), np.abs((y - py + 0.5) % 1.0 - 0.5)) for px, py in points]
    base = rgb(draw)
    colours = np.stack([near(draw, base) for _ in range(count)])
    return np.asarray(colours[np.argmin(np.stack(away), axis=0)], np.float32)


def _weave(draw: Random) -> Field:
    """Draw two crossed waves. Only for scores."""
    x, y = grid()
    waves = [np.sin(2 * np.pi * int(draw.integers(2, 20)) * side + draw.uniform(0, 6)) for side in (x, y)]
    return mixed(np.asarray(0.5 + 0.25 * (waves[0] + waves[1]), np.float32), rgb(draw), rgb(draw))


def _marble(draw: Random) -> Field:
    """Draw veins. Only for scores."""
    x, y = grid()
    bent = soft(draw, 25) * draw.uniform(1.0, 3.0)
    veins = np.abs(np.sin(np.pi * (int(draw.integers(1, 4)) * x + int(draw.integers(1, 4)) * y + bent)))
    base = rgb(draw)
    return mixed(np.asarray(veins ** draw.uniform(0.3, 2.0), np.float32), base, near(draw, near(draw, base)))


_PIECES: Final = ("plain", "clouds", "boards", "checks", "stripes", "blots", "dots", "bricks")
TRAINED: Final = (*_PIECES, "quilt", "quilt", "quilt")
"""Three times the family that never repeats."""
_MORE: Final = ("leaves", "spectrum", "scribbles", "speckle")
_PATCHES: Final = (*_PIECES, *_MORE)
TRAINED_LATER: Final = (*_MORE, "leaves", "quilt", "patchwork", "patchwork", "patchwork")
"""Families of the scenes that the second round of training adds."""
TRAINED_HARDER: Final = (
    "plain", "clouds", "boards", "checks", "stripes", "blots", "bricks", "spectrum", "scribbles", "speckle", "quilt",
    "quilt", "patchwork", "patchwork",
)
"""Families of the third round. None is of discs alone: among many flat discs, scores of balls fall."""
VALIDATED: Final = ("plaid", "scales", "script", "ridges")
"""A threshold chosen on trained textures is too low for others."""
SCORED: Final = ("mosaic", "stones", "weave", "marble")
FAMILIES: Final[dict[str, Callable[[Random], Field]]] = {
    "plain": _plain, "clouds": _clouds, "boards": _boards, "checks": _checks, "stripes": _stripes, "blots": _blots,
    "dots": _dots, "bricks": _bricks, "quilt": _quilt,
    "leaves": leaves, "spectrum": spectrum, "scribbles": scribbles,
    "speckle": speckle, "patchwork": _patchwork,
    "plaid": plaid, "scales": scales, "script": script,
    "ridges": ridges,
    "mosaic": _mosaic, "stones": _stones, "weave": _weave, "marble": _marble,
}


def families(seed: int) -> tuple[str, ...]:
    """Return the texture families for floor and wall of the scene of this seed."""
    if seed >= SCORED_FROM:
        return SCORED
    if seed >= VALIDATED_FROM:
        return VALIDATED
    if seed >= HARDER_FROM:
        return TRAINED_HARDER
    return TRAINED_LATER if seed >= LATER_FROM else TRAINED
