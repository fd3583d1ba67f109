"""Record some of the scored scenes: their truths, and their coarse images. Stored in `scored_scenes.json`.

Seeds alone pin nothing: another PyBullet, or a texture that was changed, would draw other scenes under them, and the
figures that were published would be of scenes that are no more. If that is intended, write them again, and the figures:

    python -m tests.sim.scenes.scored_scenes
"""

import json
from pathlib import Path

import numpy as np
import simplejpeg

from sightline.sim.scenes.model import COLUMNS, HEIGHT_PX, SCORED_FROM, THINGS, WIDTH_PX
from sightline.sim.scenes.plan import as_seen
from sightline.sim.scenes.render import SceneRenderer

FILE = Path(__file__).parent.parent.parent / "scored_scenes.json"
PINNED = [(COLUMNS["nominal"], 1), (COLUMNS["same-color boxes"], 212), (COLUMNS["all at once"], 333), (THINGS, 1204)]
"""Columns, with the distance above the first scored seed; together they contain every scored family of textures."""
ACROSS, DOWN = 16, 12
MOST_PX, MOST_LEVELS = 1.01, 2
"""A box's edge is a whole pixel, and a pixel may be on either side of it; means and deviations are rounded."""


def drawn():
    """The scenes as they are drawn now."""
    with SceneRenderer() as renderer:
        return [outline(renderer.scene(SCORED_FROM + above, column)) for column, above in PINNED]


def outline(scene):
    """Boxes by tenths of a pixel; of each field of the picture that a detector is shown, the channels' means, and how
    much detail there is."""
    truths = [[one.label, *(round(edge, 1) for edge in (*one.box, *(one.whole or ())))] for one in scene.truths]
    picture = simplejpeg.decode_jpeg(as_seen(scene), "RGB").astype(float)
    fields = picture.reshape(DOWN, HEIGHT_PX // DOWN, ACROSS, WIDTH_PX // ACROSS, 3)
    numbers = np.dstack([fields.mean((1, 3)), fields.mean(-1).std((1, 3))])
    return {"column": scene.plan.column.name, "seed": scene.plan.seed, "truths": truths,
            "fields": np.rint(numbers).astype(np.uint8).tobytes().hex()}


def kept():
    """Read the scenes of the published figures."""
    return json.loads(FILE.read_text())


def differences(now, then):
    """Return the difference of two outlines of one scene beyond the last bit of a compiler, or ""."""
    if [one[0] for one in now["truths"]] != [one[0] for one in then["truths"]]:
        return ["what is in it"]
    edges = [[edge for one in of["truths"] for edge in one[1:]] for of in (now, then)]
    fields = [np.frombuffer(bytes.fromhex(of["fields"]), np.uint8).astype(int) for of in (now, then)]
    apart = {"boxes": (np.subtract(*edges), MOST_PX), "picture": (np.subtract(*fields), MOST_LEVELS)}
    return [what for what, (off, most) in apart.items() if np.abs(off).max() > most]


if __name__ == "__main__":
    FILE.write_text("[\n" + ",\n".join(map(json.dumps, drawn())) + "\n]\n")
