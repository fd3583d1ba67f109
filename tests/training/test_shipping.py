"""From trained weights to the file and its card, by weights that mean nothing."""

import hashlib
from contextlib import contextmanager
from functools import partial

import cv2
import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")
demanded.module("onnx", "dev")

from sightline.evaluation.photographs import FEWEST
from sightline.evaluation.score.detector_report import DetectorReport
from sightline.sim.scenes.model import COLUMNS, LABELS
from sightline.training.export import shifted
from sightline.training.scenes import SceneSource
from sightline.training.schedule import Training
from sightline.training.shipping import Card, card_text, chosen_thresholds, final_report, written
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.onnx.engine import open_engine
from sightline.vision_side.detect.registry import build_detector
from tests.training.fixture import weights

pytestmark = pytest.mark.computes


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
    card = card_text(Card(training, SceneSource(9), "cpu", thresholds, 12345, model.stat().st_size, digest, 5, report))
    assert "train --scenes 9 --steps 7 --steps 3 --rate 0.003 --batch 6 --seed 5 --device cpu --jobs 2" in card
    assert "demands are kept; these are not:" in card and "least hits, nominal" in card
    assert digest in card and all(f"| {name} |" in card for name in COLUMNS) and "12345" in card


def test_model_of_an_earlier_run_stays_until_the_next_is_whole(tmp_path, monkeypatch):
    def fail(*_given):
        assert model.read_bytes() == b"an earlier one"
        raise MemoryError

    model = tmp_path / "sightline.onnx"
    model.write_bytes(b"an earlier one")
    monkeypatch.setattr("sightline.training.shipping.read_outputs", fail)
    with pytest.raises(MemoryError):
        written(model, weights())
    assert model.read_bytes() == b"an earlier one"


def test_the_card_names_the_photographs_and_every_option(tmp_path):
    for number in range(FEWEST):
        picture = np.random.default_rng(number).integers(0, 255, (240, 320, 3), np.uint8)
        cv2.imwrite(str(tmp_path / f"{number:02}.png"), picture)
    source = SceneSource(9, 40, tmp_path, every=5, mined_with=tmp_path / "m.onnx")
    report = DetectorReport(0, 0, {}, {"onnx": {}}, {}, {}, {})
    training = Training((1, 3), rate=0.006, start="ab" * 32)
    card = card_text(Card(training, source, "cuda", (0.5,) * 5, 1, 1, "", 5, report))
    assert ("sightline train --scenes 9 --every 5 --photos PHOTOS --over-photos 40 --steps 1 --steps 3 --rate 0.006 "
            "--batch 32 --seed 1 --device cuda --jobs 1 --validated 5 --start MODEL`") in card
    assert "seeds 0 to 40, one in 5" in card and f"40 scenes over the {FEWEST} photographs" in card
    assert "The weights are 0.8 of those trained and 0.2 of MODEL's" in card
    assert "what MODEL takes for a ball" in card and "and drawn balls over photographs" in card
    plain = card_text(Card(Training((1,)), SceneSource(9), "cpu", (0.5,) * 5, 1, 1, "", 5, report))
    assert "photographs" not in plain and "--every" not in plain and "seeds 0 to 8," in plain
