"""Floors and walls of scenes: families of tileable textures of any colour. Pure (NumPy, OpenCV).

Three lists: what is trained on, what thresholds are chosen on, and what only judges show.
"""

from collections.abc import Callable
from functools import cache
from typing import Final

import cv2
import numpy as np

from sightline.sim import scene_patterns
from sightline.sim.camera import floor_tile
from sightline.sim.scenes.textures import SIDE, Field, Random, Texture, grid, mixed, near, rgb, soft
from sightline.sim.scenes.model import HARDER_FROM, JUDGED_FROM, LATER_FROM, VALIDATED_FROM

_FLOORS = 16  # of the simulated room's own; each takes as long to make as a scene


def texture(family: str, seed: int) -> Texture:
    """A tile (SIDE, SIDE, 3), RGB, of that family."""
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
    """The simulated room's own floor, in other colours too."""
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
    """Round and flat: not balls."""
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
    """Two of the families above, one where the other is not: no two look alike. At times the contrast is low."""
    one, two = (FAMILIES[_PIECES[int(draw.integers(len(_PIECES)))]](draw) for _ in range(2))
    share = soft(draw, draw.uniform(4, 40)) if draw.random() < 0.5 else _checks(draw)[..., 0] / 255
    sharp = np.asarray(share > draw.uniform(0.3, 0.7), np.float32)
    tile = one + sharp[..., None] * (two - one)
    return np.asarray(tile + draw.uniform(0.0, 0.7) * (tile.mean((0, 1)) - tile), np.float32)


def _patchwork(draw: Random) -> Field:
    """Two to four of what is trained on, each where shapes or clouds let it through; at times half seen through."""
    tile = FAMILIES[_PATCHES[int(draw.integers(len(_PATCHES)))]](draw)
    for _ in range(int(draw.integers(1, 4))):
        over = FAMILIES[_PATCHES[int(draw.integers(len(_PATCHES)))]](draw)
        mask = scene_patterns.leaves(draw)[..., 0] / 255 if draw.random() < 0.5 else soft(draw, draw.uniform(4, 40))
        share = (mask > np.quantile(mask, draw.uniform(0.3, 0.7))) * (1.0 if draw.random() < 0.7 else 0.5)
        tile = mixed(np.asarray(share, np.float32), tile, over)
    return np.asarray(tile + draw.uniform(0.0, 0.7) * (tile.mean((0, 1)) - tile), np.float32)


def _mosaic(draw: Random) -> Field:
    """Judged only: small squares of colours around two, with joints."""
    count = int(draw.integers(4, 14))
    one, two = rgb(draw), rgb(draw)
    colours = np.stack([near(draw, one if draw.random() < 0.5 else two) for _ in range(count * count)])
    tile = cv2.resize(colours.reshape(count, count, 3), (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    x, y = grid()
    joint = (((x * count) % 1.0 < 0.08) | ((y * count) % 1.0 < 0.08)).astype(np.float32)
    return np.asarray(tile * (1 - 0.5 * joint[..., None]), np.float32)


def _stones(draw: Random) -> Field:
    """Judged only: cells round random points, which wrap."""
    count = int(draw.integers(8, 40))
    points = draw.random((count, 2)).astype(np.float32)
    x, y = grid()
    away = [np.hypot(np.abs((x - px + 0.5) % 1.0 - 0.5), np.abs((y - py + 0.5) % 1.0 - 0.5)) for px, py in points]
    base = rgb(draw)
    colours = np.stack([near(draw, base) for _ in range(count)])
    return np.asarray(colours[np.argmin(np.stack(away), axis=0)], np.float32)


def _weave(draw: Random) -> Field:
    """Judged only: two waves across each other."""
    x, y = grid()
    waves = [np.sin(2 * np.pi * int(draw.integers(2, 20)) * side + draw.uniform(0, 6)) for side in (x, y)]
    return mixed(np.asarray(0.5 + 0.25 * (waves[0] + waves[1]), np.float32), rgb(draw), rgb(draw))


def _marble(draw: Random) -> Field:
    """Judged only: veins."""
    x, y = grid()
    bent = soft(draw, 25) * draw.uniform(1.0, 3.0)
    veins = np.abs(np.sin(np.pi * (int(draw.integers(1, 4)) * x + int(draw.integers(1, 4)) * y + bent)))
    base = rgb(draw)
    return mixed(np.asarray(veins ** draw.uniform(0.3, 2.0), np.float32), base, near(draw, near(draw, base)))


_PIECES: Final = ("plain", "clouds", "boards", "checks", "stripes", "blots", "dots", "bricks")
TRAINED: Final = (*_PIECES, "quilt", "quilt", "quilt")
"""Thrice the one that is never the same."""
_MORE: Final = ("leaves", "spectrum", "scribbles", "speckle")
_PATCHES: Final = (*_PIECES, *_MORE)
TRAINED_LATER: Final = (*_MORE, "leaves", "quilt", "patchwork", "patchwork", "patchwork")
"""Of the scenes that the second round of training adds."""
TRAINED_HARDER: Final = (
    "plain", "clouds", "boards", "checks", "stripes", "blots", "bricks", "spectrum", "scribbles", "speckle", "quilt",
    "quilt", "patchwork", "patchwork",
)
"""Of the third round's. None is of discs alone: with so many flat ones about, balls look less sure than they are."""
VALIDATED: Final = ("plaid", "scales", "script", "ridges")
"""A threshold that was chosen on textures that training knows is too low for others."""
JUDGED: Final = ("mosaic", "stones", "weave", "marble")
FAMILIES: Final[dict[str, Callable[[Random], Field]]] = {
    "plain": _plain, "clouds": _clouds, "boards": _boards, "checks": _checks, "stripes": _stripes, "blots": _blots,
    "dots": _dots, "bricks": _bricks, "quilt": _quilt,
    "leaves": scene_patterns.leaves, "spectrum": scene_patterns.spectrum, "scribbles": scene_patterns.scribbles,
    "speckle": scene_patterns.speckle, "patchwork": _patchwork,
    "plaid": scene_patterns.plaid, "scales": scene_patterns.scales, "script": scene_patterns.script,
    "ridges": scene_patterns.ridges,
    "mosaic": _mosaic, "stones": _stones, "weave": _weave, "marble": _marble,
}


def families(seed: int) -> tuple[str, ...]:
    """Those that the scene of that seed has its floor and wall from."""
    if seed >= JUDGED_FROM:
        return JUDGED
    if seed >= VALIDATED_FROM:
        return VALIDATED
    if seed >= HARDER_FROM:
        return TRAINED_HARDER
    return TRAINED_LATER if seed >= LATER_FROM else TRAINED
