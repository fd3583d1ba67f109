"""`sightline train`: scenes, training, thresholds, ONNX file, judgement, model card. Shell (files)."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sightline.operator_side.train_card import Card, card_text
from sightline.training.export import shifted
from sightline.operator_side.train_loop import start_from, train
from sightline.training.network import Weights
from sightline.training.schedule import Training
from sightline.training.scenes import drawn_scenes
from sightline.operator_side.train_shipping import Progress, chosen_thresholds, final_report, written

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
    start: Weights | None = None
    """What the last round begins from, in place of the rounds before it."""


def run_training(options: TrainOptions, say: Callable[[str], None], progress: Progress) -> Path:
    """Everything, in order; the model's path. What a run that was cut left in the folder is gone on with."""
    with progress(options.scenes, "scenes") as advance:
        scenes = drawn_scenes(options.out, options.scenes, options.jobs, advance)
    if options.start is not None:
        start_from(options.start, scenes, options.training, options.out)
    weights = train(scenes, options.training, options.device, options.out, say)
    say("thresholds are being chosen on scenes of other seeds")
    thresholds = chosen_thresholds(options.out / "unchosen.onnx", weights, options.validated, options.jobs, progress)
    model = options.out / MODEL
    written(model, shifted(weights, thresholds))
    say(f"{model}: {model.stat().st_size} bytes; it is being judged on scenes that nothing was trained on")
    report = final_report(model, options.judged, progress)
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    parameters = sum(int(one.size) for one in weights.values())
    card = Card(options.training, options.scenes, options.device, thresholds, parameters, model.stat().st_size, digest,
                options.validated, report)
    (options.out / CARD).write_text(card_text(card), "utf-8")
    return model
