"""Shows labelled scenes to detectors and counts what they answer. Shell (draws scenes, runs detectors).

Every detector gets the same JPEGs through the port that vision uses; each scene is a session of its own. What it says
is checked as vision checks it: whatever a plug-in does, it is an answer that a robot could get, or none.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import Any, Final

from sightline.evaluation.score.detectors import (
    BALL_LABELS,
    Figures,
    FrameResult,
    LabelMatches,
    figures,
    frame_result,
    precisions,
)
from sightline.protocol.messages import FrameHeader
from sightline.sim.scene_defects import as_seen
from sightline.sim.scene_render import SceneRenderer
from sightline.sim.scenes.model import COLUMNS, HEIGHT_PX, JUDGED_FROM, LABELS, THINGS, WIDTH_PX, Column, Scene
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.around import close_detector, notices_of
from sightline.vision_side.detect.checking import checked_results as checked_answers
from sightline.vision_side.detect.registry import build_detector, check_takes_pictures
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame, Detection, DetectionResult, Detector

_FRAME_US: Final = 33_333
_ROBOT: Final = "judge"
LIGHT_SHARE: Final = 2.5
"""As many scenes of lights and legs as of each column's: the three states share them."""
_MOST_SAID: Final = 2  # lines of a detector's own beside why it gave no answer: the first say what is wrong
LABELLED: Final = LABELS[1:]
"""What is judged by average precision; the ball has columns of its own."""


@dataclass(frozen=True, slots=True)
class Subject:
    """One detector under judgement, by the name it was asked for."""

    name: str
    detector: Detector
    balls: tuple[str, ...] = BALL_LABELS
    """What it may call a ball."""


@dataclass(frozen=True, slots=True)
class ScoredScene:
    """One scene as it was shown, and what each subject said of it."""

    scene: Scene
    jpeg: bytes
    answers: tuple[DetectionResult | None, ...]
    whys: tuple[str, ...]
    """Why there is no answer; empty where there is one."""


@dataclass(frozen=True, slots=True)
class Silence:
    """How many of how many scenes a subject gave no answer to, and why."""

    scenes: int
    of: int
    why: str


@dataclass(frozen=True, slots=True)
class Report:
    """Figures by column and subject; average precision by subject and label; what each ran on."""

    first_seed: int
    frames: int
    columns: dict[str, dict[str, Figures]]
    precision: dict[str, dict[str, tuple[int, float | None]]]
    """Objects, AP50."""
    made_by: dict[str, dict[str, str]]
    silent: dict[str, Silence]
    """Who did not always answer. No answer counts as missed, which the figures do not tell from having seen nothing."""
    uncounted: dict[str, list[str]]
    """Who saw what nobody asks for, and what they called it: the labels of another model, as like as not."""

    def to_dict(self) -> dict[str, Any]:
        """For --json."""
        return asdict(self)


def subjects(
    names: Sequence[str], config: VisionConfig | None = None, options: Mapping[str, Mapping[str, Any]] | None = None
) -> list[Subject]:
    """Each once, with its own of the `options`; to be closed. Raises ConfigError for a name that is none, or what it
    needs is missing, and HardwareError for a device that is not there.
    """
    settings, given, asked = config or VisionConfig(), options or {}, list[Subject]()
    balls = (*BALL_LABELS, settings.target.label) if settings.target.label else BALL_LABELS
    with ExitStack() as ending:
        ending.callback(close_subjects, asked)
        for name in dict.fromkeys(names):
            check_takes_pictures(name)
            asked.append(Subject(name, build_detector(name, given.get(name, {}), settings), balls))
        ending.pop_all()
    return asked


def close_subjects(asked: Sequence[Subject]) -> None:
    """All of them."""
    with ExitStack() as ending:
        for one in asked:
            ending.callback(close_detector, one.detector)


def shown(column: Column, seeds: Iterable[int], asked: Sequence[Subject], looks: int) -> Iterable[ScoredScene]:
    """Each scene of the column in turn, in front of every subject, `looks` times in a row: some have to make sure."""
    decoder = Decoder(WIDTH_PX, HEIGHT_PX, WIDTH_PX * HEIGHT_PX)
    with SceneRenderer() as renderer:
        for seed in seeds:
            scene = renderer.scene(seed, column)
            jpeg = as_seen(scene)
            said = [_answer(one.detector, seed, jpeg, decoder, looks) for one in asked]
            yield ScoredScene(scene, jpeg, tuple(one if isinstance(one, DetectionResult) else None for one in said),
                       tuple(one if isinstance(one, str) else "" for one in said))


def _answer(detector: Detector, seed: int, jpeg: bytes, decoder: Decoder, looks: int) -> DetectionResult | str:
    """The last look's answer, or why there is none."""
    result: DetectionResult | str = ""
    for look in range(looks):
        header = FrameHeader(session=f"{seed:08x}", seq=look, t_us=(1 + look) * _FRAME_US)
        (result,) = checked_answers(detector, [DetectFrame(_ROBOT, header, jpeg, decoder)], NO_DEADLINE)
    return result


def score_scenes(
    asked: Sequence[Subject], frames: int, first_seed: int = JUDGED_FROM, *, looks: int = 1,
    columns: Sequence[str] = tuple(COLUMNS), each: Callable[[ScoredScene], None] = lambda _seen: None,
) -> Report:
    """All columns, `frames` scenes each, and `LIGHT_SHARE` times as many of lights and legs.

    `each` is told of every scene.
    """
    seeds = range(first_seed, first_seed + frames)
    counts = [_Count(one, columns) for one in asked]
    for name in columns:
        for seen in shown(COLUMNS[name], seeds, asked, looks):
            each(seen)
            for count, result, why in zip(counts, seen.answers, seen.whys, strict=True):
                count.verdicts[name].append(scene_result(result, seen.scene, count.balls))
                count.note(result, why)
    for seen in shown(THINGS, range(first_seed, first_seed + int(LIGHT_SHARE * frames)), asked, looks):
        each(seen)
        for count, result, why in zip(counts, seen.answers, seen.whys, strict=True):
            for label, marks in count.found.items():
                marks.add(label, detections(result), seen.scene)
            count.note(result, why)
    return Report(
        first_seed, frames,
        {name: {one.name: figures(one.verdicts[name]) for one in counts} for name in columns},
        {one.name: precisions(one.found) for one in counts},
        {one.name: one.made_by for one in counts if one.made_by},
        {one.name: one.silence() for one in counts if one.unanswered},
        {one.name: sorted(one.uncounted) for one in counts if one.uncounted},
    )


class _Count:
    """All that one subject answered."""

    def __init__(self, subject: Subject, columns: Sequence[str]) -> None:
        self.name = subject.name
        self.verdicts: dict[str, list[FrameResult]] = {name: [] for name in columns}
        self.found = {label: LabelMatches() for label in LABELLED}
        self.made_by: dict[str, str] = {}
        self.scenes = self.unanswered = 0
        self.uncounted: set[str] = set()
        self.balls, self._detector, self._why = subject.balls, subject.detector, ""

    def note(self, result: DetectionResult | None, why: str) -> None:
        self.scenes += 1
        if result is not None:
            self.made_by = {"device": result.device, "model_hash": result.model_hash}
            self.uncounted.update(one.label for one in result.detections if one.label not in {*LABELS, *self.balls})
        else:
            self.unanswered += 1
            self._why = self._why or why

    def silence(self) -> Silence:
        """With what the detector itself says, if it says anything."""
        said = notices_of(self._detector)[:_MOST_SAID]
        return Silence(self.unanswered, self.scenes, "; ".join(dict.fromkeys([self._why, *said])))


def detections(result: DetectionResult | None) -> tuple[Detection, ...]:
    """No answer shows nothing."""
    return () if result is None else result.detections


def scene_result(result: DetectionResult | None, scene: Scene, balls: Sequence[str] = BALL_LABELS) -> FrameResult:
    """Of one answer; `balls` is what a ball may be called."""
    return frame_result(None, scene) if result is None else frame_result(result.detections, scene, result.compute_us, balls)
