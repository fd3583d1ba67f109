"""Shows labelled scenes to detectors and counts what they answer. Shell (draws scenes, runs detectors).

Every detector gets the same JPEGs through the port that vision uses; each scene is a session of its own.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

from operator_side.score_detectors import Figures, Found, Judged, figures, judged, precisions
from protocol.messages import FrameHeader
from sim.scene_defects import as_seen
from sim.scene_render import SceneRenderer
from sim.scenes import COLUMNS, HEIGHT_PX, JUDGED_FROM, LABELS, THINGS, WIDTH_PX, Column, Scene
from vision_side.config import VisionConfig
from vision_side.decode import Decoder
from vision_side.detect.choice import choose_detector
from vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection, DetectionResult, Detector

_FRAME_US: Final = 33_333
_ROBOT: Final = "judge"
LIGHT_SHARE: Final = 2.5
"""As many scenes of lights and legs as of each column's: the three states share them."""
LABELLED: Final = LABELS[1:]
"""What is judged by average precision; the ball has columns of its own."""


@dataclass(frozen=True, slots=True)
class Subject:
    """One detector under judgement, by the name it was asked for."""

    name: str
    detector: Detector


@dataclass(frozen=True, slots=True)
class Seen:
    """One scene as it was shown, and what each subject said of it."""

    scene: Scene
    jpeg: bytes
    answers: tuple[DetectionResult | None, ...]


@dataclass(frozen=True, slots=True)
class Report:
    """Figures by column and subject; average precision by subject and label; what each ran on."""

    first_seed: int
    frames: int
    columns: dict[str, dict[str, Figures]]
    precision: dict[str, dict[str, tuple[int, float | None]]]
    """Objects, AP50."""
    made_by: dict[str, dict[str, str]]

    def to_dict(self) -> dict[str, Any]:
        """For --json."""
        return asdict(self)


def subjects(names: Sequence[str]) -> list[Subject]:
    """Raises ConfigError for a name that is none, or what it needs is missing."""
    return [Subject(name, choose_detector(name, {}, VisionConfig())) for name in names]


def shown(column: Column, seeds: Iterable[int], asked: Sequence[Subject], looks: int) -> Iterable[Seen]:
    """Each scene of the column in turn, in front of every subject, `looks` times in a row: some have to make sure."""
    decoder = Decoder(WIDTH_PX, HEIGHT_PX, WIDTH_PX * HEIGHT_PX)
    with SceneRenderer() as renderer:
        for seed in seeds:
            scene = renderer.scene(seed, column)
            jpeg = as_seen(scene)
            yield Seen(scene, jpeg, tuple(_answer(one.detector, seed, jpeg, decoder, looks) for one in asked))


def _answer(detector: Detector, seed: int, jpeg: bytes, decoder: Decoder, looks: int) -> DetectionResult | None:
    result = None
    for look in range(looks):
        header = FrameHeader(session=f"{seed:08x}", seq=look, t_us=(1 + look) * _FRAME_US)
        result = detector.detect([DetectFrame(_ROBOT, header, jpeg, decoder)], NO_DEADLINE)[0]
    return result


def score_scenes(
    asked: Sequence[Subject], frames: int, first_seed: int = JUDGED_FROM, *, looks: int = 1,
    columns: Sequence[str] = tuple(COLUMNS), each: Callable[[Seen], None] = lambda _seen: None,
) -> Report:
    """All columns, `frames` scenes each, and `LIGHT_SHARE` times as many of lights and legs.

    `each` is told of every scene.
    """
    seeds = range(first_seed, first_seed + frames)
    verdicts: dict[str, dict[str, list[Judged]]] = {name: {one.name: [] for one in asked} for name in columns}
    found = {one.name: {label: Found() for label in LABELLED} for one in asked}
    made_by: dict[str, dict[str, str]] = {}
    for name in columns:
        for seen in shown(COLUMNS[name], seeds, asked, looks):
            each(seen)
            for subject, result in zip(asked, seen.answers, strict=True):
                verdicts[name][subject.name].append(verdict(result, seen.scene))
                if result is not None:
                    made_by[subject.name] = {"device": result.device, "model_hash": result.model_hash}
    for seen in shown(THINGS, range(first_seed, first_seed + int(LIGHT_SHARE * frames)), asked, looks):
        each(seen)
        for subject, result in zip(asked, seen.answers, strict=True):
            for label, marks in found[subject.name].items():
                marks.add(label, detections(result), seen.scene)
    counted = {name: {who: figures(all_of) for who, all_of in own.items()} for name, own in verdicts.items()}
    precision = {who: precisions(own) for who, own in found.items()}
    return Report(first_seed, frames, counted, precision, made_by)


def detections(result: DetectionResult | None) -> tuple[Detection, ...]:
    """No answer shows nothing."""
    return () if result is None else result.detections


def verdict(result: DetectionResult | None, scene: Scene) -> Judged:
    """Of one answer."""
    return judged(None, scene) if result is None else judged(result.detections, scene, result.compute_us)
