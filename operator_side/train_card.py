"""The model card: what the file is, how it was made, how good it is. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

from sightline.operator_side.score_detectors_bounds import detector_checks
from sightline.operator_side.score_detectors_text import check_lines, markdown
from sightline.evaluation.score.detector_report import Report
from sightline.training.export import MOST_BOXES, OPSET
from sightline.training.schedule import LEAST_SHARE, WHOLE_FROM, Training
from sightline.sim.scene_textures import JUDGED, TRAINED, TRAINED_HARDER, TRAINED_LATER, VALIDATED
from sightline.sim.scenes.model import HARDER_FROM, HEIGHT_PX, LABELS, LATER_FROM, VALIDATED_FROM, WIDTH_PX


@dataclass(frozen=True, slots=True)
class Card:
    """All that stands on it."""

    training: Training
    scenes: int
    device: str
    thresholds: Sequence[float]
    parameters: int
    size_bytes: int
    sha256: str
    validated: int
    report: Report


def card_text(card: Card) -> str:
    """Markdown."""
    return "\n".join([
        "# A detector of balls, traffic lights and legs", "",
        f"Finds {', '.join(f'`{label}`' for label in LABELS)} in a picture: a heat-map network of {card.parameters} "
        f"numbers, {card.size_bytes} bytes, ONNX opset {OPSET}.", "",
        f"SHA-256 `{card.sha256}`", "", *_input(), "", "## How it was made", "", *_made(card), "",
        "## How good it is", "", *_judged(card), "",
        "## What it is not", "",
        "It has only ever seen drawn scenes: balls, boxes, traffic lights of three lamps, legs as two cylinders. Try "
        "it on your own robot's pictures (`sightline vision --shadow onnx`) before you let it drive.", "",
    ])


def _input() -> list[str]:
    return [
        f"- `image`: uint8 (1, {HEIGHT_PX}, {WIDTH_PX}, 3), BGR.",
        f"- `boxes` ({MOST_BOXES}, 4): x1, y1, x2, y2 in pixels of the input; `scores` ({MOST_BOXES}); `labels` "
        f"({MOST_BOXES}), indices into the metadata's `labels`.",
        "- Overlaps are removed and boxes decoded inside; a box that a better one covers has the score 0.",
        "- A detection counts from a score of 0.5 on (`min_score` of the metadata): each label's own threshold is "
        "worked into the model.",
    ]


def _made(card: Card) -> list[str]:
    training = card.training
    thresholds = ", ".join(f"{label} {one:.2f}" for label, one in zip(LABELS, card.thresholds, strict=True))
    steps = " ".join(f"--steps {one}" for one in training.rounds)
    start = " --start MODEL" if training.start else ""
    return [
        f"`sightline train --scenes {card.scenes} {steps} --batch {training.batch} "
        f"--seed {training.seed} --device {card.device} --jobs {training.jobs} --validated {card.validated}"
        f"{start}`", "",
        f"- Scenes: seeds 0 to {card.scenes - 1}, floors and walls of the families {_families(TRAINED)}; from seed "
        f"{LATER_FROM} up {_families(TRAINED_LATER)}; from {HARDER_FROM} up {_families(TRAINED_HARDER)}, with more "
        "legs and more boxes of the ball's colour. Defects are drawn anew each time a scene is shown; from the third "
        "round on a third of the pictures are clear, and a third are dim, blurred and coarse at once.",
        f"- Steps: {' and '.join(map(str, training.rounds))} of {training.batch} cut-outs (the last "
        f"{100 * (1 - WHOLE_FROM):.0f} % of a round half as many whole pictures), AdamW, learning rate "
        f"{training.rate:g} at first, half of that in each round that follows down to {training.rate * LEAST_SHARE:g}, "
        "weights averaged.",
        *([f"- The last round began from MODEL, of SHA-256 `{training.start}`."] if training.start else []),
        f"- Thresholds: {thresholds}, chosen on {card.validated} scenes a column of the seeds from {VALIDATED_FROM}, "
        f"with floors and walls of other families: {_families(VALIDATED)}.",
    ]


def _families(names: Sequence[str]) -> str:
    return ", ".join(dict.fromkeys(names))


def _judged(card: Card) -> list[str]:
    report = card.report
    last = report.first_seed + report.frames - 1
    return [
        f"{report.frames} scenes a column, seeds {report.first_seed} to {last}: floors and walls of the families "
        f"{_families(JUDGED)}, and light from heights that training never saw. `sightline score detectors onnx:FILE "
        f"--frames {report.frames} --demand` shows it again (`onnx` is the file that comes along). What it all means: "
        "docs/learned-detector.md. `ms p50` is of a machine that may have had other work: `sightline bench pipeline` "
        "measures time.", "", markdown(report), "", *_demanded(report),
    ]


def _demanded(report: Report) -> list[str]:
    checks = detector_checks(report, "onnx")
    broken = [one for one in checks if not one.ok]
    kept = f"{len(checks) - len(broken)} of {len(checks)} demands are kept"
    return [f"{kept}; these are not:", "", "```", *check_lines(broken), "```"] if broken else [f"{kept}."]
