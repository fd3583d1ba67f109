"""Trained weights into the file that ships: thresholds chosen, golden answer kept, judged. Shell (files, processes)."""

from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final

from sightline.evaluation.score.detectors import FrameResult, LabelMatches
from sightline.evaluation.score.detector_report import (
    LABELLED,
    LIGHT_SHARE,
    Report,
    Subject,
    detections,
    scene_result,
    score_scenes,
    shown,
)
from sightline.training.shipping import ball_threshold, label_threshold
from sightline.training.export import onnx_bytes
from sightline.training.network import Weights
from sightline.operator_side.worker_pool import worker_pool
from sightline.sim.scenes.model import COLUMNS, LABELS, THINGS, VALIDATED_FROM, Column
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.decode import Picture
from sightline.vision_side.detect.registry import build_detector
from sightline.vision_side.detect.onnx.self_test import KEY, golden_picture, golden_text
from sightline.vision_side.detect.onnx_engine import open_engine
from sightline.vision_side.detect.onnx.engine import read_onnx_header
from sightline.vision_side.detect.onnx.tensors import fit_picture, model_format, read_outputs

COUNTS_FROM: Final = 0.5
"""The score from which a detection counts, once each label's threshold has been worked into the model."""
Progress = Callable[[int, str], AbstractContextManager[Callable[[int], None]]]
"""Of how many, and of what; what it gives is told of each few that are done."""

_ALL: Final = 0.02  # scores below are noise, and are not looked at when thresholds are chosen
_LABELS: Final = (*COLUMNS.values(), THINGS)
_SLICE: Final = 100
"""Scenes that one process looks at before it says so."""


def written(path: Path, weights: Weights) -> None:
    """The ONNX file, with what it answers to the known picture in its metadata."""
    properties = {"min_score": str(COUNTS_FROM)}
    path.write_bytes(onnx_bytes(weights, properties))
    header = read_onnx_header(path.read_bytes())
    form = model_format(header, (), "auto")
    picture = Picture(golden_picture(), 1)
    pixels, fitting = fit_picture(picture, form)
    found = read_outputs(open_engine(path, header, "cpu", 1).run(pixels), form, fitting, picture, COUNTS_FROM)
    beside = path.with_suffix(".part")
    beside.write_bytes(onnx_bytes(weights, {**properties, KEY: golden_text(found)}))
    beside.replace(path)


def chosen_thresholds(path: Path, weights: Weights, frames: int, jobs: int, progress: Progress) -> tuple[float, ...]:
    """Each label's threshold, by `frames` scenes a column; the model without any goes to `path`."""
    path.write_bytes(onnx_bytes(weights, {"min_score": str(_ALL)}))
    last = VALIDATED_FROM + frames
    slices = [range(first, min(first + _SLICE, last)) for first in range(VALIDATED_FROM, last, _SLICE)]
    balls: dict[str, list[FrameResult]] = {name: [] for name in COLUMNS}
    found = {label: LabelMatches() for label in LABELLED}
    with progress(frames * len(_LABELS), "scenes that choose") as advance, worker_pool(jobs) as pool:
        for done in as_completed([pool.submit(_seen, path, column, one) for column in _LABELS for one in slices]):
            column, verdicts, marks = done.result()
            if column in balls:
                balls[column] += verdicts
            for label, more in marks.items():
                found[label].take(more)
            advance(len(verdicts))
    return tuple(ball_threshold(balls) if label == "ball" else label_threshold(found[label]) for label in LABELS)


def _seen(path: Path, column: Column, seeds: Sequence[int]) -> tuple[str, list[FrameResult], dict[str, LabelMatches]]:
    """The column's name, what is to be said of each scene's ball, and of lights and legs where those are asked for."""
    verdicts, found = [], {label: LabelMatches() for label in LABELLED if column == THINGS}
    for seen in shown(column, seeds, [_subject(path)], 1):
        verdicts.append(scene_result(seen.answers[0], seen.scene))
        for label, marks in found.items():
            marks.add(label, detections(seen.answers[0]), seen.scene)
    return column.name, verdicts, found


def final_report(path: Path, frames: int, progress: Progress) -> Report:
    """On the seeds that only judges use."""
    with progress(int((len(COLUMNS) + LIGHT_SHARE) * frames), "scenes that judge") as advance:
        return score_scenes([_subject(path)], frames, each=lambda _: advance(1))


def _subject(path: Path) -> Subject:
    return Subject("onnx", build_detector(f"onnx:{path}", {}, VisionConfig()))
