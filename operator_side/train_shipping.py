"""Trained weights into the file that ships: thresholds chosen, golden answer kept, judged. Shell (files, processes)."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Final

from operator_side.score_detectors import Found, Judged
from operator_side.score_scenes import LABELLED, Report, Subject, detections, score_scenes, shown, verdict
from operator_side.train_choice import ball_threshold, label_threshold
from operator_side.train_export import Weights, onnx_bytes
from sim.scenes import COLUMNS, LABELS, THINGS, VALIDATED_FROM
from vision_side.config import VisionConfig
from vision_side.decode import Picture
from vision_side.detect.choice import choose_detector
from vision_side.detect.golden import KEY, golden_picture, golden_text
from vision_side.detect.onnx_engine import open_engine
from vision_side.detect.onnx_header import read_onnx_header
from vision_side.detect.onnx_reading import fit_picture, form_of, read_outputs

COUNTS_FROM: Final = 0.5
"""The score from which a detection counts, once each label's threshold has been worked into the model."""
_ALL: Final = 0.02  # scores below are noise, and are not looked at when thresholds are chosen


def written(path: Path, weights: Weights) -> None:
    """The ONNX file, with what it answers to the known picture in its metadata."""
    properties = {"min_score": str(COUNTS_FROM)}
    path.write_bytes(onnx_bytes(weights, properties))
    header = read_onnx_header(path.read_bytes())
    form = form_of(header, (), "auto")
    picture = Picture(golden_picture(), 1)
    pixels, fitting = fit_picture(picture, form)
    found = read_outputs(open_engine(path, header, "cpu", 1).run(pixels), form, fitting, picture, COUNTS_FROM)
    beside = path.with_suffix(".part")
    beside.write_bytes(onnx_bytes(weights, {**properties, KEY: golden_text(found)}))
    beside.replace(path)


def chosen(path: Path, weights: Weights, frames: int, jobs: int) -> tuple[float, ...]:
    """Each label's threshold, by `frames` scenes a column; the model without any goes to `path`."""
    path.write_bytes(onnx_bytes(weights, {"min_score": str(_ALL)}))
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn")) as pool:
        labelled = pool.submit(_labelled, path, frames)
        shown_balls = {name: pool.submit(_balls, path, name, frames) for name in COLUMNS}
        found, balls = labelled.result(), {name: one.result() for name, one in shown_balls.items()}
    return tuple(ball_threshold(balls) if label == "ball" else label_threshold(found[label]) for label in LABELS)


def _balls(path: Path, column: str, frames: int) -> list[Judged]:
    """What is to be said of each scene of one column."""
    seeds = range(VALIDATED_FROM, VALIDATED_FROM + frames)
    return [verdict(seen.answers[0], seen.scene) for seen in shown(COLUMNS[column], seeds, [_subject(path)], 1)]


def _labelled(path: Path, frames: int) -> dict[str, Found]:
    """What was found of the labels other than the ball's."""
    found = {label: Found() for label in LABELLED}
    for seen in shown(THINGS, range(VALIDATED_FROM, VALIDATED_FROM + frames), [_subject(path)], 1):
        for label, marks in found.items():
            marks.add(label, detections(seen.answers[0]), seen.scene)
    return found


def judged(path: Path, frames: int) -> Report:
    """On the seeds that only judges use."""
    return score_scenes([_subject(path)], frames)


def _subject(path: Path) -> Subject:
    return Subject("onnx", choose_detector(f"onnx:{path}", {}, VisionConfig()))
