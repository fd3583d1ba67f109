"""Draw training scenes to disk, and cut samples with heat maps from them. Shell (files, processes)."""

import hashlib
import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.evaluation.photographs import SHIPPED, read_photographs, shared
from sightline.evaluation.processes import worker_pool
from sightline.protocol.errors import ConfigError
from sightline.sim.scenes.model import (
    DEFECTS,
    HARDER_FROM,
    HEIGHT_PX,
    LABELS,
    LATER_FROM,
    STATES,
    TRAINED,
    VALIDATED_FROM,
    WIDTH_PX,
    Box,
    Column,
    LabelledBox,
    PhotoScene,
    Random,
    Scene,
    trained_column,
)
from sightline.sim.scenes.photos import photo_scene
from sightline.sim.scenes.plan import with_defects
from sightline.sim.scenes.render import SceneRenderer
from sightline.training.network import GEOMETRY, INPUT_PX, SIZE_PX, STRIDE, TAUGHT
from sightline.training.schedule import SceneRange
from sightline.vision_side.decode import DecodedImage
from sightline.vision_side.detect.onnx.detector import digest_of
from sightline.vision_side.detect.onnx.engine import open_engine
from sightline.vision_side.detect.onnx.tensors import TILE_SHARE, fit_picture, model_format, read_outputs
from sightline.vision_side.detect.port import corners, overlap

_SLICE: Final = 100
"""Scenes that one process draws between two reports of progress."""
_MINED_FROM: Final = 0.3
"""Score from which a false ball is used for training."""
_OF_A_BALL: Final = 0.1
"""Intersection over union with a labeled ball from which a detection may be of that ball."""
_TRIED: Final = 4
"""Scenes of each kind that are drawn again, to check the stored ones."""


@dataclass(frozen=True, slots=True)
class DrawnScenes:
    """Images (N, H, W, 3), RGB, on disk, and the objects in each."""

    pictures: npt.NDArray[np.uint8]
    truths: tuple[tuple[LabelledBox, ...], ...]
    unclear: tuple[tuple[Box, ...], ...]
    others: tuple[tuple[Box, ...], ...]
    """Boxes of distractors: things without a label."""
    simulated: int | None = None
    """Index of the first scene over photographs, in which only balls are labeled; None without any."""
    photographs: str = ""
    """Digest of these photographs; empty without them."""

    @property
    def own(self) -> int:
        """Return the number of scenes that the simulator has drawn."""
        return len(self.truths) if self.simulated is None else self.simulated

    def digest(self) -> str:
        """Hash the scenes: their number, all boxes, the first image, all photographs."""
        truths = [[one.label, one.box] for row in self.truths for one in row]
        content = json.dumps([len(self.truths), truths, self.unclear, self.others])
        return hashlib.sha256((content + self.photographs).encode() + self.pictures[0].tobytes()).hexdigest()[:16]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle images on disk by name: the receiver opens them again."""
        pictures = self.pictures.filename if isinstance(self.pictures, np.memmap) else self.pictures
        return _reopened, (pictures, self.truths, self.unclear, self.others, self.simulated, self.photographs)


def _reopened(pictures: Any, *rest: Any) -> DrawnScenes:
    return DrawnScenes(pictures if isinstance(pictures, np.ndarray) else np.load(pictures, mmap_mode="r"), *rest)


@dataclass(frozen=True, slots=True)
class SceneSource:
    """The origin of scenes: `count` from the simulator, with every `every`-th seed from 0, then `over_photos` over
    the photographs of a folder."""

    count: int
    over_photos: int = 0
    photos: Path | None = None
    every: int = 1
    mined_with: Path | None = None
    """Model whose false balls in scenes over photographs are added to the other things."""

    @property
    def total(self) -> int:
        """Return the number of scenes of both kinds."""
        return self.count + self.over_photos

    @property
    def photographs(self) -> int:
        """Return the number of photographs."""
        return len(_photographs(self.photos)) if self.photos else 0

    def drawn(self, renderer: SceneRenderer, number: int) -> Scene | PhotoScene:
        """Draw one scene."""
        if number < self.count:
            seed = number * self.every
            return renderer.scene(seed, trained_column(seed))
        assert self.photos is not None
        scene = photo_scene(_photographs(self.photos), number - self.count)
        return scene if self.mined_with is None else with_false_balls(scene, open_miner(self.mined_with))

    def note(self, scene: Scene | PhotoScene) -> dict[str, Any]:
        """Return the objects of a scene, the digest of all photographs, and the model that found some objects."""
        truths = [[one.label, one.box, one.seen] for one in scene.truths]
        note = {"truths": truths, "unclear": scene.unclear, "others": scene.others}
        if self.photos is not None and isinstance(scene, PhotoScene):
            note["photographs"] = _photographs_digest(self.photos)
        if self.mined_with is not None and isinstance(scene, PhotoScene):
            note["miner"] = _miner_digest(self.mined_with)
        # In the form in which it is read again: JSON has only lists.
        return dict(json.loads(json.dumps(note)))


@cache
def _photographs(folder: Path) -> tuple[npt.NDArray[np.uint8], ...]:
    """Read the photographs, once per process."""
    return tuple(one.rgb for one in read_photographs(folder))


@cache
def _photographs_digest(folder: Path) -> str:
    """Hash all photographs, because the scenes drawn again for a comparison show only a few."""
    digest = hashlib.sha256()
    for one in _photographs(folder):
        digest.update(repr(one.shape).encode() + one.tobytes())
    return digest.hexdigest()[:16]


Miner = Callable[[npt.NDArray[np.uint8]], list[Box]]
"""Takes a BGR image; returns the boxes of supposed balls."""


@cache
def open_miner(model: Path) -> Miner:
    """Open a model once per process."""
    engine = open_engine(model, "cpu", 1)
    form = model_format(engine.header, (), "auto")

    def balls(bgr: npt.NDArray[np.uint8]) -> list[Box]:
        picture = DecodedImage(bgr, 1)
        pixels, fitting = fit_picture(picture, form)
        found = read_outputs(engine.run(pixels), form, fitting, picture, _MINED_FROM)
        return [corners(one) for one in found if one.label == "ball"]

    return balls


@cache
def _miner_digest(model: Path) -> str:
    return digest_of(model)


def with_false_balls(scene: PhotoScene, miner: Miner) -> PhotoScene:
    """Add the false balls that `miner` finds to the other things of the scene."""
    labelled = [*(one.box for one in scene.truths), *scene.unclear]
    found = [box for box in miner(np.ascontiguousarray(scene.rgb[..., ::-1]))
             if not any(overlap(box, one) > _OF_A_BALL for one in labelled)]
    return replace(scene, others=(*scene.others, *found))


def drawn_scenes(folder: Path, source: SceneSource, jobs: int, advance: Callable[[int], None]) -> DrawnScenes:
    """Return the scenes of `source`, from `folder` if they were drawn before."""
    if not 0 < source.count * source.every <= VALIDATED_FROM:
        raise ConfigError(f"--scenes {source.count}: 1 to {VALIDATED_FROM // source.every}; seeds from "
                          f"{VALIDATED_FROM} up validate and score")
    if source.every % len(STATES) == 0:
        raise ConfigError(f"--every {source.every}: all traffic lights of these scenes have one color; choose a number "
                          f"that {len(STATES)} does not divide")
    if source.photos is not None:
        _check_photographs(source.photos)
    pictures, notes = folder / "scenes.npy", folder / "scenes.json"
    if _would_be_the_same(pictures, notes, source):
        advance(source.total)
    else:
        folder.mkdir(parents=True, exist_ok=True)
        notes.unlink(missing_ok=True)  # it no longer describes the drawn scenes
        _draw_all(pictures, notes, source, jobs, advance)
    rows = json.loads(notes.read_text("utf-8"))
    truths = tuple(tuple(_truth(one) for one in row["truths"]) for row in rows)
    unclear, others = (tuple(tuple((*one,) for one in row[kind]) for row in rows) for kind in ("unclear", "others"))
    return DrawnScenes(np.load(pictures, mmap_mode="r"), truths, unclear, others,
                       source.count if source.over_photos else None, rows[-1].get("photographs", ""))


def _check_photographs(folder: Path) -> None:
    """Raise ConfigError for a photograph that scores detectors, also under another name."""
    same = shared(read_photographs(folder), read_photographs(SHIPPED))
    if same:
        (name, other), more = same[0], len(same) - 1
        raise ConfigError(f"{folder / name} shows the same as {other}, which is for scores only; remove it"
                          + (f" and {more} more" if more else ""))


def _would_be_the_same(pictures: Path, notes: Path, source: SceneSource) -> bool:
    """Return True if the stored scenes are complete and current. The first of each kind are drawn again."""
    if not notes.exists() or not pictures.exists():
        return False
    try:
        rows, drawn = json.loads(notes.read_text("utf-8")), np.load(pictures, mmap_mode="r")
    except (ValueError, EOFError):  # damaged, e.g. by a full disk
        return False
    if len(rows) != source.total or len(drawn) != source.total:
        return False

    def is_current(number: int) -> bool:
        scene = source.drawn(renderer, number)
        return np.array_equal(drawn[number], scene.rgb) and rows[number] == source.note(scene)

    with SceneRenderer() as renderer:
        return all(is_current(number)
                   for first in (0, LATER_FROM // source.every, HARDER_FROM // source.every, source.count,
                                 source.total - _TRIED)
                   for number in range(max(0, first), min(source.total, first + _TRIED)))


def _truth(one: list[Any]) -> LabelledBox:
    label, box, seen = one
    return LabelledBox(label, (box[0], box[1], box[2], box[3]), seen)


def _draw_all(pictures: Path, notes: Path, source: SceneSource, jobs: int, advance: Callable[[int], None]) -> None:
    shape = (source.total, HEIGHT_PX, WIDTH_PX, 3)
    np.lib.format.open_memmap(pictures, "w+", np.uint8, shape).flush()
    _reserve(pictures)
    rows: list[dict[str, Any]] = [{} for _ in range(source.total)]
    with worker_pool(jobs) as pool:  # workers write directly to the file
        waiting = [pool.submit(_draw, pictures, source, range(first, min(first + _SLICE, source.total)))
                   for first in range(0, source.total, _SLICE)]
        for done in as_completed(waiting):
            first, drawn = done.result()
            rows[first : first + len(drawn)] = drawn
            advance(len(drawn))
    notes.with_suffix(".part").write_text(json.dumps(rows), "utf-8")
    notes.with_suffix(".part").replace(notes)


def _reserve(file: Path) -> None:
    """Allocate the space of the file now. Raises OSError on a full disk, where a write would kill a worker."""
    if not hasattr(os, "posix_fallocate"):  # macOS
        return
    try:
        with file.open("r+b") as opened:
            os.posix_fallocate(opened.fileno(), 0, file.stat().st_size)
    except OSError:
        file.unlink()
        raise


def _draw(pictures: Path, source: SceneSource, numbers: Sequence[int]) -> tuple[int, list[dict[str, Any]]]:
    """Draw one slice of scenes into the file. Returns the objects in them."""
    store = np.lib.format.open_memmap(pictures, "r+")
    rows = []
    with SceneRenderer() as renderer:
        for number in numbers:
            scene = source.drawn(renderer, number)
            store[number] = scene.rgb
            rows.append(source.note(scene))
    store.flush()
    return numbers[0], rows


# Training samples from scenes: a degraded cut-out, and its target heat maps. Pure.


CUT_PX: Final = (192, 144)
"""Size of the cut-outs in most of the training, relative to the network's input: a quarter of the time of a
whole image.
"""
WHOLE_PX: Final = INPUT_PX
_ENLARGED: Final = WHOLE_PX[0] / WIDTH_PX
_ENLARGED_AGAIN: Final = _ENLARGED / TILE_SHARE
"""In a second look."""
_AS_AGAIN: Final = 0.25
"""Share of the cut-outs over photographs with the scale of a second look."""
_LEAST_LEFT: Final = 0.4  # of an object's box after the cut; below it the object is neither right nor wrong
_NEW: Final = 0.5  # share of the samples of a harder round that are drawn only from its new scenes
_AROUND_OTHERS: Final = 0.3  # share of those samples that are cut around distractors, not objects
_OVER_PHOTOS: Final = 0.5  # share of the samples, if there are such scenes
_SPREAD: Final = 0.09  # standard deviation of the bump on the heat map, as a share of the object's side
_LEAST_SPREAD: Final = 0.6  # cells
_SURE: Final = 0.4  # bump height from which cells learn the edges of the object

Array = npt.NDArray[np.float32]
_ALL_KNOWN: Final = np.ones(len(LABELS) + TAUGHT, np.float32)
_IN_PHOTOS: Final = np.array([label == "ball" for label in LABELS] + [True] * TAUGHT, np.float32)
"""A photograph may show lights and legs without a label."""


@dataclass(frozen=True, slots=True)
class TrainingSample:
    """One image BGR (3, H, W) and its target output."""

    image: npt.NDArray[np.uint8]
    heat: Array
    """(labels and `TAUGHT`, H/4, W/4), 1 in the center cell of each object."""
    geometry: Array
    """(4, H/4, W/4)"""
    sure: Array
    """(H/4, W/4): weight of a cell's geometry."""
    counts: Array
    """(H/4, W/4): 0 if the right output is unknown."""
    known: Array
    """(labels and `TAUGHT`,): 0 for a label that may be elsewhere in the image."""


def sample(
    scenes: DrawnScenes, shown: SceneRange, numbers: tuple[int, int, int], size_px: tuple[int, int]
) -> TrainingSample:
    """Draw a scene, a cut, a side and defects. The result depends only on seed, step and place in the batch."""
    draw = np.random.default_rng(numbers)
    is_photo = scenes.own < len(scenes.truths) and draw.random() < _OVER_PHOTOS
    if is_photo:
        number, around, column = _photo(draw, scenes)
    else:
        number, around, column = (_harder if shown.harder else _plain)(draw, scenes, shown)
    enlarged = _ENLARGED_AGAIN if is_photo and draw.random() < _AS_AGAIN else _ENLARGED
    cut_px = round(size_px[0] / enlarged), round(size_px[1] / enlarged)
    corner = left, top = _cut(draw, around, cut_px)
    rgb = scenes.pictures[number][top : top + cut_px[1], left : left + cut_px[0]]
    mirrored = bool(draw.random() < 0.5)
    picture = np.ascontiguousarray(rgb[:, ::-1] if mirrored else rgb)
    bgr = simplejpeg.decode_jpeg(with_defects(picture, column, draw), "BGR")
    bgr = cv2.resize(bgr, size_px, interpolation=cv2.INTER_LINEAR)  # like `fit_picture`
    moved = [(one, _moved(one.box, corner, cut_px, enlarged, mirrored)) for one in scenes.truths[number]]
    unclear, others = ([_moved(one, corner, cut_px, enlarged, mirrored) for one in boxes]
                       for boxes in (scenes.unclear[number], scenes.others[number]))
    known = (_IN_PHOTOS if is_photo else _ALL_KNOWN).copy()
    return _wanted(np.ascontiguousarray(bgr.transpose(2, 0, 1)), moved, unclear, others, known)


def _photo(draw: Random, scenes: DrawnScenes) -> tuple[int, list[Box], Column]:
    """Draw a scene over a photograph, the boxes to cut around, and its defects."""
    number = int(draw.integers(scenes.own, len(scenes.truths)))
    labelled = [one.box for one in scenes.truths[number]]
    around = list(scenes.others[number]) if draw.random() < _AROUND_OTHERS else labelled
    return number, around, DEFECTS[int(draw.integers(len(DEFECTS)))]


def _plain(draw: Random, scenes: DrawnScenes, shown: SceneRange) -> tuple[int, list[Box], Column]:
    """Draw a scene, the boxes to cut around, and its defects."""
    number = int(draw.integers(shown.known))
    return number, [one.box for one in scenes.truths[number]], TRAINED


def _harder(draw: Random, scenes: DrawnScenes, shown: SceneRange) -> tuple[int, list[Box], Column]:
    """Draw the same, with more of the newest scenes, of distractors, of bad images."""
    number = int(draw.integers(shown.newest if draw.random() < _NEW else 0, shown.known))
    labelled = [one.box for one in scenes.truths[number]]
    around = list(scenes.others[number]) if draw.random() < _AROUND_OTHERS else labelled
    return number, around, DEFECTS[int(draw.integers(len(DEFECTS)))]


def _cut(draw: Random, boxes: list[Box], size_px: tuple[int, int]) -> tuple[int, int]:
    """Draw the corner of the cut. Three times in four it contains the center of a box."""
    most = (WIDTH_PX - size_px[0], HEIGHT_PX - size_px[1])
    corner = [int(draw.integers(0, one + 1)) for one in most]
    if boxes and draw.random() < 0.75:
        box = boxes[int(draw.integers(len(boxes)))]
        for axis in (0, 1):
            middle = (box[axis] + box[axis + 2]) / 2
            corner[axis] = int(np.clip(middle - draw.uniform(0.05, 0.95) * size_px[axis], 0, most[axis]))
    return corner[0], corner[1]


def _moved(box: Box, corner: tuple[int, int], cut_px: tuple[int, int], enlarged: float, mirrored: bool) -> Box:
    x1, y1, x2, y2 = box[0] - corner[0], box[1] - corner[1], box[2] - corner[0], box[3] - corner[1]
    x1, x2 = (cut_px[0] - x2, cut_px[0] - x1) if mirrored else (x1, x2)
    return x1 * enlarged, y1 * enlarged, x2 * enlarged, y2 * enlarged


def _wanted(image: npt.NDArray[np.uint8], objects: list[tuple[LabelledBox, Box]], unclear: list[Box],
            others: list[Box], known: Array) -> TrainingSample:
    rows, columns = image.shape[1] // STRIDE, image.shape[2] // STRIDE
    one = TrainingSample(image, np.zeros((len(LABELS) + TAUGHT, rows, columns), np.float32),
                 np.zeros((GEOMETRY, rows, columns), np.float32), np.zeros((rows, columns), np.float32),
                 np.ones((rows, columns), np.float32), known)
    for box in unclear:
        _blank(one, box)
    for truth, box in sorted(objects, key=lambda pair: -_area(pair[1])):
        _mark(one, truth, box)
    for box in others:
        _mark_other(one, box)
    return one


def _area(box: Box) -> float:
    return max(0.0, box[2] - box[0]) * max(0.0, box[3] - box[1])


def _within(box: Box, one: TrainingSample) -> Box:
    height, width = one.image.shape[1:]
    return max(0.0, box[0]), max(0.0, box[1]), min(float(width), box[2]), min(float(height), box[3])


def _blank(one: TrainingSample, box: Box) -> None:
    x1, y1, x2, y2 = (int(edge // STRIDE) for edge in _within(box, one))
    one.counts[y1 : y2 + 1, x1 : x2 + 1] = 0


def _mark(one: TrainingSample, truth: LabelledBox, whole: Box) -> None:
    """Add a bump to the heat map of the label, and the edges in its center cells."""
    box = _within(whole, one)
    if _area(box) <= 0:
        return
    if _area(box) * truth.seen < _LEAST_LEFT * _area(whole):
        _blank(one, box)
        return
    bump, middle = _bumped(one.heat[LABELS.index(truth.label)], box)
    one.counts[middle] = 1.0
    sure = bump >= _SURE
    sure[middle] = True
    one.sure[sure] = np.maximum(bump[sure], _SURE)
    for part, values in zip(one.geometry, _edges(box, bump.shape), strict=True):
        part[sure] = np.broadcast_to(np.asarray(values), bump.shape)[sure]


def _mark_other(one: TrainingSample, whole: Box) -> None:
    """Add a bump to the last heat map if enough of the object is left."""
    box = _within(whole, one)
    if _area(box) > 0 and _area(box) >= _LEAST_LEFT * _area(whole):
        _bumped(one.heat[-1], box)


def _bumped(heat: Array, box: Box) -> tuple[Array, tuple[int, int]]:
    """Raise the map around the center of the box. Returns the bump, and the center cell, which is 1."""
    off_x, off_y, log_wide, log_high = _edges(box, heat.shape)
    wide, high = (math.exp(one) * SIZE_PX / STRIDE for one in (log_wide, log_high))
    bump = np.asarray(np.exp(-0.5 * (off_y / max(_SPREAD * high, _LEAST_SPREAD)) ** 2)
                      * np.exp(-0.5 * (off_x / max(_SPREAD * wide, _LEAST_SPREAD)) ** 2), np.float32)
    np.maximum(heat, bump, out=heat)
    middle = int(np.abs(off_y).argmin()), int(np.abs(off_x).argmin())
    heat[middle] = 1.0
    return bump, middle


def _edges(box: Box, shape: tuple[int, ...]) -> tuple[Array, Array, float, float]:
    """Return the targets of the cells for a box: center offset in x (a row) and y (a column), log width, log height."""
    x, y = (box[0] + box[2]) / 2 / STRIDE, (box[1] + box[3]) / 2 / STRIDE
    off_x, off_y = x - (np.arange(shape[1]) + 0.5), y - (np.arange(shape[0])[:, None] + 0.5)
    return off_x, off_y, math.log((box[2] - box[0]) / SIZE_PX), math.log((box[3] - box[1]) / SIZE_PX)
