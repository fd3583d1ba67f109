"""Floors and walls of scenes: families of tileable textures of any colour. Pure (NumPy, OpenCV).

Two lists: what is trained on, and what only judges show.
"""

from collections.abc import Callable
from functools import cache
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt

from sim.camera import floor_tile

SIDE = 128
_FLOORS = 16  # of the simulated room's own; each takes as long to make as a scene
Random = np.random.Generator
Texture = npt.NDArray[np.uint8]
Field = npt.NDArray[np.float32]


def texture(family: str, seed: int) -> Texture:
    """A tile (SIDE, SIDE, 3), RGB, of that family."""
    draw = np.random.default_rng([seed, 12])
    tile = FAMILIES[family](draw)
    grain = draw.normal(0.0, draw.uniform(0.0, 5.0), (SIDE, SIDE, 1)).astype(np.float32)
    return np.asarray(np.clip(np.rint(tile + grain), 0, 255), np.uint8)


def any_rgb(draw: Random, saturation: tuple[float, float] = (0.0, 1.0), value: tuple[float, float] = (0.2, 1.0),
            hue_deg: tuple[float, float] = (0.0, 360.0)) -> tuple[float, float, float]:
    """A colour, 0..1."""
    hsv = np.array([[[draw.uniform(*hue_deg), draw.uniform(*saturation), draw.uniform(*value)]]], np.float32)
    red, green, blue = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0].tolist()
    return red, green, blue


def _rgb(draw: Random) -> Field:
    """A floor's or a wall's colour: half of them dull, as most rooms are."""
    high = 1.0 if draw.random() < 0.5 else 0.3
    return np.array(any_rgb(draw, (0.0, high)), np.float32) * 255


def _mixed(share: Field, low: Field, high: Field) -> Field:
    """From one colour to the other by `share` (SIDE, SIDE)."""
    return np.asarray(low + share[..., None] * (high - low), np.float32)


def _near(draw: Random, colour: Field) -> Field:
    """The same colour, a little lighter or darker."""
    return np.asarray(np.clip(colour * draw.uniform(0.6, 1.3) + draw.uniform(-15, 15, 3), 0, 255), np.float32)


def _soft(draw: Random, sigma: float) -> Field:
    """Smooth tileable noise, 0..1."""
    small = max(4, int(SIDE / max(sigma, 1.0)))
    coarse = np.tile(draw.random((small, small), np.float32), (3, 3))
    big = cv2.resize(coarse, (3 * SIDE, 3 * SIDE), interpolation=cv2.INTER_CUBIC)[SIDE : 2 * SIDE, SIDE : 2 * SIDE]
    return np.asarray((big - big.min()) / max(float(np.ptp(big)), 1e-6), np.float32)


def _grid() -> tuple[Field, Field]:
    steps = np.arange(SIDE, dtype=np.float32) / SIDE
    return np.broadcast_to(steps, (SIDE, SIDE)), np.broadcast_to(steps[:, None], (SIDE, SIDE))


def _plain(draw: Random) -> Field:
    return np.broadcast_to(_rgb(draw), (SIDE, SIDE, 3))


def _clouds(draw: Random) -> Field:
    base = _rgb(draw)
    other = _near(draw, base) if draw.random() < 0.6 else _rgb(draw)
    share = sum(_soft(draw, 2.0**k) * 2.0**k for k in range(1, 6)) / 62.0
    return _mixed(np.asarray(share, np.float32), base, other)


def _boards(draw: Random) -> Field:
    """The simulated room's own floor, in other colours too."""
    whole = _room_floor(int(draw.integers(_FLOORS)))
    down, right = draw.integers(0, len(whole) - SIDE, 2).tolist()
    tile = whole[down : down + SIDE, right : right + SIDE].astype(np.float32)
    return tile if draw.random() < 0.4 else np.clip(tile * _rgb(draw) / 118.0, 0, 255)


@cache
def _room_floor(seed: int) -> Texture:
    return floor_tile(seed)


def _checks(draw: Random) -> Field:
    x, y = _grid()
    count = int(draw.integers(1, 7)) * 2
    odd = (np.floor(x * count) + np.floor(y * count)) % 2
    return _mixed(odd.astype(np.float32), _rgb(draw), _rgb(draw))


def _stripes(draw: Random) -> Field:
    x, y = _grid()
    count, share = int(draw.integers(2, 16)), draw.uniform(0.2, 0.8)
    along = x if draw.random() < 0.5 else y
    return _mixed(((along * count) % 1.0 < share).astype(np.float32), _rgb(draw), _rgb(draw))


def _blots(draw: Random) -> Field:
    rough = _soft(draw, draw.uniform(6, 30))
    return _mixed((rough > draw.uniform(0.35, 0.65)).astype(np.float32), _rgb(draw), _rgb(draw))


def _dots(draw: Random) -> Field:
    """Round and flat: not balls."""
    x, y = _grid()
    count, radius = int(draw.integers(2, 8)), draw.uniform(0.15, 0.4)
    off = np.hypot((x * count) % 1.0 - 0.5, (y * count) % 1.0 - 0.5)
    return _mixed((off < radius).astype(np.float32), _rgb(draw), _rgb(draw))


def _bricks(draw: Random) -> Field:
    x, y = _grid()
    rows, columns = int(draw.integers(3, 9)) * 2, int(draw.integers(2, 6))
    row = np.floor(y * rows)
    joint = (((x * columns + 0.5 * (row % 2)) % 1.0 < 0.06) | ((y * rows) % 1.0 < 0.12)).astype(np.float32)
    return _mixed(joint, _rgb(draw), _rgb(draw))


def _quilt(draw: Random) -> Field:
    """Two of the families above, one where the other is not: no two look alike. At times the contrast is low."""
    one, two = (FAMILIES[_PIECES[int(draw.integers(len(_PIECES)))]](draw) for _ in range(2))
    share = _soft(draw, draw.uniform(4, 40)) if draw.random() < 0.5 else _checks(draw)[..., 0] / 255
    sharp = np.asarray(share > draw.uniform(0.3, 0.7), np.float32)
    tile = one + sharp[..., None] * (two - one)
    return np.asarray(tile + draw.uniform(0.0, 0.7) * (tile.mean((0, 1)) - tile), np.float32)


def _mosaic(draw: Random) -> Field:
    """Judged only: small squares of colours around two, with joints."""
    count = int(draw.integers(4, 14))
    one, two = _rgb(draw), _rgb(draw)
    colours = np.stack([_near(draw, one if draw.random() < 0.5 else two) for _ in range(count * count)])
    tile = cv2.resize(colours.reshape(count, count, 3), (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    x, y = _grid()
    joint = (((x * count) % 1.0 < 0.08) | ((y * count) % 1.0 < 0.08)).astype(np.float32)
    return np.asarray(tile * (1 - 0.5 * joint[..., None]), np.float32)


def _stones(draw: Random) -> Field:
    """Judged only: cells round random points, which wrap."""
    count = int(draw.integers(8, 40))
    points = draw.random((count, 2)).astype(np.float32)
    x, y = _grid()
    away = [np.hypot(np.abs((x - px + 0.5) % 1.0 - 0.5), np.abs((y - py + 0.5) % 1.0 - 0.5)) for px, py in points]
    base = _rgb(draw)
    colours = np.stack([_near(draw, base) for _ in range(count)])
    return np.asarray(colours[np.argmin(np.stack(away), axis=0)], np.float32)


def _weave(draw: Random) -> Field:
    """Judged only: two waves across each other."""
    x, y = _grid()
    waves = [np.sin(2 * np.pi * int(draw.integers(2, 20)) * side + draw.uniform(0, 6)) for side in (x, y)]
    return _mixed(np.asarray(0.5 + 0.25 * (waves[0] + waves[1]), np.float32), _rgb(draw), _rgb(draw))


def _marble(draw: Random) -> Field:
    """Judged only: veins."""
    x, y = _grid()
    bent = _soft(draw, 25) * draw.uniform(1.0, 3.0)
    veins = np.abs(np.sin(np.pi * (int(draw.integers(1, 4)) * x + int(draw.integers(1, 4)) * y + bent)))
    base = _rgb(draw)
    return _mixed(np.asarray(veins ** draw.uniform(0.3, 2.0), np.float32), base, _near(draw, _near(draw, base)))


_PIECES: Final = ("plain", "clouds", "boards", "checks", "stripes", "blots", "dots", "bricks")
TRAINED: Final = (*_PIECES, "quilt", "quilt", "quilt")
"""Thrice the one that is never the same."""
JUDGED: Final = ("mosaic", "stones", "weave", "marble")
FAMILIES: Final[dict[str, Callable[[Random], Field]]] = {
    "plain": _plain, "clouds": _clouds, "boards": _boards, "checks": _checks, "stripes": _stripes, "blots": _blots,
    "dots": _dots, "bricks": _bricks, "quilt": _quilt,
    "mosaic": _mosaic, "stones": _stones, "weave": _weave, "marble": _marble,
}
