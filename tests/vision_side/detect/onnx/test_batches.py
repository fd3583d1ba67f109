"""The detector `onnx` with a model that takes several pictures at once: one run, the same answers, each its own."""

from pathlib import Path

import numpy as np
import pytest

from sightline.protocol.log import faults
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.onnx.tensors import model_format
from sightline.vision_side.detect.port import NO_DEADLINE, DetectFrame
from tests.fixtures.vision.onnx import brightness_model, several_model
from tests.vision_side.detect.onnx.test_detector import detector, frame, header_of

BOXES = [[10.0, 20.0, 60.0, 90.0], [200.0, 40.0, 300.0, 200.0]]
LEVELS = (40, 230, 130)


def grey(level: int, seq: int = 1) -> DetectFrame:
    return frame(np.full((240, 320, 3), level, np.uint8), seq)


def counted(eye: object, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Record the number of images of each run."""
    runs: list[int] = []
    run = eye._engine.run
    monkeypatch.setattr(eye._engine, "run", lambda pixels: runs.append(len(pixels)) or run(pixels), raising=False)
    return runs


def test_several_images_are_one_run_with_the_answers_that_each_gets_alone(tmp_path: Path, monkeypatch) -> None:
    eye = detector(several_model(tmp_path / "m.onnx", BOXES), min_score=0.1, refine=())
    alone = [eye.detect([grey(level, seq)], NO_DEADLINE)[0] for seq, level in enumerate(LEVELS)]
    runs = counted(eye, monkeypatch)
    together = eye.detect([grey(level, seq) for seq, level in enumerate(LEVELS)], NO_DEADLINE)
    assert runs == [len(LEVELS)]
    assert [one.detections for one in together] == [one.detections for one in alone]
    assert [round(one.detections[0].score, 1) for one in together] == [0.2, 0.9, 0.5]
    assert [one.seq for one in together] == [0, 1, 2] and all(one.compute_us is not None for one in together)


def test_invalid_image_is_skipped_and_runs_are_bounded(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("sightline.vision_side.detect.onnx.detector._MAX_BATCH", 2)
    eye = detector(several_model(tmp_path / "m.onnx", BOXES), min_score=0.1, refine=())
    runs = counted(eye, monkeypatch)
    good = [grey(level, seq) for seq, level in enumerate(LEVELS)]
    torn = DetectFrame(good[0].robot, good[0].header, good[0].jpeg[:40], Decoder(320, 240, 10**7))
    results = eye.detect([good[0], torn, *good[1:]], NO_DEADLINE)
    assert [one is None for one in results] == [False, True, False, False] and runs == [1, 2]
    assert [one.seq for one in results if one] == [0, 1, 2]
    assert eye.detect(good, 1) == [None] * 3 and len(runs) == 2, "their time is over"


def test_model_that_fails_on_many_images_gets_fewer(tmp_path: Path, monkeypatch) -> None:
    """The outputs hold at most two images, whatever the input declares. Batches beyond GPU memory split alike."""
    eye = detector(several_model(tmp_path / "m.onnx", BOXES), min_score=0.1)
    run = eye._engine.run
    monkeypatch.setattr(eye._engine, "run", lambda pixels: run(pixels[:2]), raising=False)
    runs = counted(eye, monkeypatch)
    frames = [grey(level, seq) for seq, level in enumerate([*LEVELS, 90, 180])]
    results = eye.detect(frames, NO_DEADLINE)
    assert [one.seq for one in results] == [0, 1, 2, 3, 4] and runs == [5, 2, 2, 1]
    *_, told = eye.notices()
    assert "fails on 5 images in one batch, uses at most 2: " in told and "for 5 images" in told
    assert all(eye.detect(frames, NO_DEADLINE)) and runs[4:] == [2, 2, 1] and not eye.notices()


def test_engine_that_fails_on_every_image_is_reported_and_gives_no_answer(tmp_path: Path, monkeypatch) -> None:
    eye = detector(several_model(tmp_path / "m.onnx", BOXES), min_score=0.1)
    eye.notices()
    monkeypatch.setattr(eye._engine, "run", None, raising=False)
    assert eye.detect([grey(level) for level in LEVELS], NO_DEADLINE) == [None] * 3
    (told,) = eye.notices()
    assert "gives no answer" in told and faults()["detector"] >= 1
    assert eye.detect([grey(level) for level in LEVELS], NO_DEADLINE) == [None] * 3 and not eye.notices()
    monkeypatch.undo()
    runs = counted(eye, monkeypatch)
    assert all(eye.detect([grey(level) for level in LEVELS], NO_DEADLINE)) and runs == [3], "all at once again"


def test_only_a_model_that_leaves_the_number_open_takes_several(tmp_path: Path) -> None:
    def is_batched(path: Path) -> bool:
        return model_format(header_of(path), (), "auto").batched

    assert is_batched(several_model(tmp_path / "several.onnx", BOXES))
    assert not is_batched(brightness_model(tmp_path / "one.onnx", BOXES, [0, 1]))
