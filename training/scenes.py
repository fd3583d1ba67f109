"""The scenes that a training run learns from, drawn once into a folder by as many processes as asked. Shell (files)."""

import hashlib
import json
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from sightline.operator_side.worker_pool import worker_pool
from sightline.protocol.errors import ConfigError
from sightline.sim.scene_render import SceneRenderer
from sightline.sim.scenes.model import (
    HARDER_FROM,
    HEIGHT_PX,
    LATER_FROM,
    VALIDATED_FROM,
    WIDTH_PX,
    Box,
    LabelledBox,
    trained_column,
)

_SLICE: Final = 100
"""Scenes that one process draws before it says so."""
_TRIED: Final = 4
"""Of each kind, whether kept scenes are still what would be drawn."""


@dataclass(frozen=True, slots=True)
class DrawnScenes:
    """Pictures (N, H, W, 3), RGB, on disk, and what is in each."""

    pictures: npt.NDArray[np.uint8]
    truths: tuple[tuple[LabelledBox, ...], ...]
    unclear: tuple[tuple[Box, ...], ...]
    others: tuple[tuple[Box, ...], ...]
    """What stands about and is not asked for."""

    def digest(self) -> str:
        """Other scenes have another: how many, what is in them, the first picture."""
        told = json.dumps([len(self.truths), [[one.label, one.box] for row in self.truths for one in row]])
        return hashlib.sha256(told.encode() + self.pictures[0].tobytes()).hexdigest()[:16]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pictures on disk are opened again by who gets them, not copied."""
        pictures = self.pictures.filename if isinstance(self.pictures, np.memmap) else self.pictures
        return _reopened, (pictures, self.truths, self.unclear, self.others)


def _reopened(pictures: Any, *rest: Any) -> DrawnScenes:
    return DrawnScenes(pictures if isinstance(pictures, np.ndarray) else np.load(pictures, mmap_mode="r"), *rest)


def drawn_scenes(folder: Path, count: int, jobs: int, advance: Callable[[int], None]) -> DrawnScenes:
    """Scenes of the seeds 0 to `count`, drawn now or taken from `folder`, where they were drawn before."""
    if not 0 < count <= VALIDATED_FROM:
        raise ConfigError(f"--scenes {count}: 1 to {VALIDATED_FROM}; seeds from there on validate and judge")
    pictures, notes = folder / "scenes.npy", folder / "scenes.json"
    if _would_be_the_same(pictures, notes, count):
        advance(count)
    else:
        folder.mkdir(parents=True, exist_ok=True)
        notes.unlink(missing_ok=True)  # what is drawn is no longer what it says
        _draw_all(pictures, notes, count, jobs, advance)
    rows = json.loads(notes.read_text("utf-8"))
    truths = tuple(tuple(_truth(one) for one in row["truths"]) for row in rows)
    unclear, others = (tuple(tuple((*one,) for one in row[kind]) for row in rows) for kind in ("unclear", "others"))
    return DrawnScenes(np.load(pictures, mmap_mode="r"), truths, unclear, others)


def _would_be_the_same(pictures: Path, notes: Path, count: int) -> bool:
    """Whether they were drawn whole, as many, and as they would be now: the first of each kind are, and compared."""
    if not notes.exists() or not pictures.exists() or len(json.loads(notes.read_text("utf-8"))) != count:
        return False
    drawn = np.load(pictures, mmap_mode="r")
    with SceneRenderer() as renderer:
        return all(np.array_equal(drawn[seed], renderer.scene(seed, trained_column(seed)).rgb)
                   for first in (0, LATER_FROM, HARDER_FROM) for seed in range(first, min(count, first + _TRIED)))


def _truth(one: list[Any]) -> LabelledBox:
    label, box, seen = one
    return LabelledBox(label, (box[0], box[1], box[2], box[3]), seen)


def _draw_all(pictures: Path, notes: Path, count: int, jobs: int, advance: Callable[[int], None]) -> None:
    shape = (count, HEIGHT_PX, WIDTH_PX, 3)
    np.lib.format.open_memmap(pictures, "w+", np.uint8, shape).flush()
    rows: list[dict[str, Any]] = [{} for _ in range(count)]
    with worker_pool(jobs) as pool:  # they write straight into the file
        waiting = [pool.submit(_draw, pictures, range(first, min(first + _SLICE, count)))
                   for first in range(0, count, _SLICE)]
        for done in as_completed(waiting):
            first, drawn = done.result()
            rows[first : first + len(drawn)] = drawn
            advance(len(drawn))
    notes.with_suffix(".part").write_text(json.dumps(rows), "utf-8")
    notes.with_suffix(".part").replace(notes)


def _draw(pictures: Path, seeds: Sequence[int]) -> tuple[int, list[dict[str, Any]]]:
    """One slice of seeds into the file; what is in them."""
    store = np.lib.format.open_memmap(pictures, "r+")
    rows = []
    with SceneRenderer() as renderer:
        for seed in seeds:
            scene = renderer.scene(seed, trained_column(seed))
            store[seed] = scene.rgb
            truths = [[one.label, one.box, one.seen] for one in scene.truths]
            rows.append({"truths": truths, "unclear": scene.unclear, "others": scene.others})
    store.flush()
    return seeds[0], rows
