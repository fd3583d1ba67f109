"""`sightline train`: scenes, training, thresholds, ONNX file, judgement, model card. Shell (files)."""

import hashlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from operator_side.score_detectors import Found
from operator_side.score_scenes import (
    LABELLED,
    Report,
    Subject,
    detections,
    score_scenes,
    shown,
    verdict,
)
from operator_side.train_card import Card, card_text
from operator_side.train_choice import ball_threshold, label_threshold
from operator_side.train_export import onnx_bytes, shifted
from operator_side.train_loop import Training, train
from operator_side.train_module import Weights
from operator_side.train_scenes import drawn_scenes
from sim.scenes import COLUMNS, LABELS, THINGS, VALIDATED_FROM
from vision_side.config import VisionConfig
from vision_side.decode import Picture
from vision_side.detect.choice import choose_detector
from vision_side.detect.golden import KEY, golden_picture, golden_text
from vision_side.detect.onnx_engine import open_engine
from vision_side.detect.onnx_header import read_onnx_header
from vision_side.detect.onnx_reading import fit_picture, form_of, read_outputs

Progress = Callable[[int, str], AbstractContextManager[Callable[[int], None]]]

COUNTS_FROM: Final = 0.5
"""The score from which a detection counts, once each label's threshold has been worked into the model."""
_ALL: Final = 0.02  # scores below are noise, and are not looked at when thresholds are chosen
MODEL, CARD = "sightline.onnx", "sightline.md"


@dataclass(frozen=True, slots=True)
class TrainOptions:
    """What `sightline train` was asked for."""

    out: Path
    scenes: int
    training: Training
    device: str
    jobs: int
    validated: int
    """Scenes of each column that choose the thresholds."""
    judged: int
    """Scenes of each column that the model card's table is of."""


def run_training(options: TrainOptions, say: Callable[[str], None], progress: Progress) -> Path:
    """Everything, in order; the model's path. What a run that was cut left in the folder is gone on with."""
    with progress(options.scenes, "scenes") as advance:
        scenes = drawn_scenes(options.out, options.scenes, options.jobs, advance)
    weights = train(scenes, options.training, options.device, options.out, say)
    say("thresholds are being chosen on scenes of other seeds")
    thresholds = chosen(options.out / "unchosen.onnx", weights, options.validated)
    model = options.out / MODEL
    written(model, shifted(weights, thresholds))
    say(f"{model}: {model.stat().st_size} bytes; it is being judged on scenes that nothing was trained on")
    report = judged(model, options.judged)
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    parameters = sum(int(one.size) for one in weights.values())
    card = Card(options.training, options.scenes, options.device, thresholds, parameters, model.stat().st_size, digest,
                options.validated, report)
    (options.out / CARD).write_text(card_text(card), "utf-8")
    return model


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


def chosen(path: Path, weights: Weights, frames: int) -> tuple[float, ...]:
    """Each label's threshold."""
    path.write_bytes(onnx_bytes(weights, {"min_score": str(_ALL)}))
    asked = [_subject(path)]
    seeds = range(VALIDATED_FROM, VALIDATED_FROM + frames)
    balls = {name: [verdict(seen.answers[0], seen.scene) for seen in shown(column, seeds, asked, 1)]
             for name, column in COLUMNS.items()}
    found = {label: Found() for label in LABELLED}
    for seen in shown(THINGS, seeds, asked, 1):
        for label, marks in found.items():
            marks.add(label, detections(seen.answers[0]), seen.scene)
    return tuple(ball_threshold(balls) if label == "ball" else label_threshold(found[label]) for label in LABELS)


def judged(path: Path, frames: int) -> Report:
    """On the seeds that only judges use."""
    return score_scenes([_subject(path)], frames)


def _subject(path: Path) -> Subject:
    return Subject("onnx", choose_detector(f"onnx:{path}", {}, VisionConfig()))
