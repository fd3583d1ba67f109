"""From trained weights to the file and its card, by weights that mean nothing."""

import hashlib
from contextlib import contextmanager
from functools import partial

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")
demanded.module("onnx", "dev")

from sightline.sim.scenes.model import COLUMNS, LABELS
from sightline.training.export import shifted
from sightline.training.schedule import Training
from sightline.training.shipping import Card, card_text, chosen_thresholds, final_report, written
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.onnx.engine import open_engine
from sightline.vision_side.detect.registry import build_detector
from tests.training.fixture import weights


@contextmanager
def told(counts, total, what):
    """The progress lines by name."""
    counts[what] = [total]
    yield counts[what].append


@pytest.mark.slow
def test_weights_become_a_file_with_thresholds_and_a_card_that_is_true_of_it(tmp_path):
    counts = {}
    thresholds = chosen_thresholds(tmp_path / "unchosen.onnx", weights(), 5, 2, partial(told, counts))
    assert len(thresholds) == len(LABELS) and all(0.05 < one < 0.96 for one in thresholds)
    model = tmp_path / "model.onnx"
    written(model, shifted(weights(), thresholds))
    header = open_engine(model, "cpu", 1).header
    assert header.metadata["min_score"] == "0.5" and "golden" in header.metadata
    build_detector(f"onnx:{model}", {}, VisionConfig())  # its own answer to the known picture is checked on the way
    report = final_report(model, 5, partial(told, counts))
    assert len(counts) == 2 and all(total == sum(steps) > 0 for total, *steps in counts.values())
    assert set(report.columns) == set(COLUMNS) and report.columns["blur"]["onnx"].frames == 5
    digest = hashlib.sha256(model.read_bytes()).hexdigest()
    training = Training((7, 3), batch=6, seed=5, jobs=2)
    card = card_text(Card(training, 9, "cpu", thresholds, 12345, model.stat().st_size, digest, 5, report))
    assert "sightline train --scenes 9 --steps 7 --steps 3 --batch 6 --seed 5 --device cpu --jobs 2" in card
    assert "demands are kept; these are not:" in card and "least hits, nominal" in card
    assert digest in card and all(f"| {name} |" in card for name in COLUMNS) and "12345" in card
