"""The room of a scene, painted by rays: a textured floor that ends at a textured wall. Pure (NumPy, OpenCV)."""

import math

import cv2
import numpy as np
import numpy.typing as npt

from sightline.sim.scenes.textures import SIDE
from sightline.sim.scene_textures import texture
from sightline.sim.scenes.model import HEIGHT_PX, WIDTH_PX, Lens, ScenePlan, Surface

Plane = npt.NDArray[np.float32]
_SHADED = (0.7, 1.0)  # the wall's brightness, by its turn
_ABOVE = np.float32(1e6)


def backdrop(plan: ScenePlan) -> npt.NDArray[np.uint8]:
    """RGB picture of the empty room."""
    x, y, z = _rays(plan.lens)
    floor_at = np.where(z < -1e-3, np.float32(plan.floor_m) / np.minimum(z, np.float32(-1e-3)), _ABOVE)
    cos, sin = np.float32(math.cos(plan.wall_turn_rad)), np.float32(math.sin(plan.wall_turn_rad))
    towards = x * cos + y * sin
    wall_at = np.where(towards > 0.05, np.float32(plan.wall_m) / np.maximum(towards, np.float32(0.05)), _ABOVE)
    picture = _painted(plan.floor, x * floor_at, y * floor_at)
    wall = _painted(plan.wall, (y * cos - x * sin) * wall_at, -z * wall_at)
    shaded = cv2.convertScaleAbs(wall, alpha=_SHADED[0] + (_SHADED[1] - _SHADED[0]) * plan.ambient)
    cv2.copyTo(shaded, (wall_at < floor_at).view(np.uint8), picture)
    return picture


def _rays(lens: Lens) -> tuple[Plane, Plane, Plane]:
    """Each pixel's ray in the world."""
    axes = lens.axes().astype(np.float32)
    right = ((np.arange(WIDTH_PX, dtype=np.float32) + 0.5 - WIDTH_PX / 2) / lens.focal_px).astype(np.float32)
    down = ((np.arange(HEIGHT_PX, dtype=np.float32) + 0.5 - HEIGHT_PX / 2) / lens.focal_px).astype(np.float32)[:, None]
    x, y, z = (axes[row, 0] * right + axes[row, 1] * down + axes[row, 2] for row in range(3))
    return x, y, z


def _painted(surface: Surface, along: Plane, across: Plane) -> npt.NDArray[np.uint8]:
    """The surface where each ray meets it. Far away it is smoothed: a tile smaller than a pixel would only flicker."""
    texels = np.float32(SIDE / surface.tile_m)
    tile = texture(surface.family, surface.seed)
    u, v = np.mod(along * texels, SIDE).astype(np.float32), np.mod(across * texels, SIDE).astype(np.float32)
    return np.asarray(cv2.remap(tile, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP), np.uint8)
