"""The model `onnx:rooms`: its card, and more balls in photographs than the default model finds."""

import hashlib

import pytest

from sightline.evaluation.photographs import SHIPPED, read_photographs
from sightline.evaluation.score.detector_report import subjects
from sightline.evaluation.score.photo_report import score_photos
from sightline.vision_side.detect.onnx.detector import ROOMS

pytestmark = pytest.mark.usefixtures("no_gpu")
HARD = ("tennis", "white", "football")


def test_the_card_is_of_this_file_and_names_its_photographs():
    card, data = ROOMS.with_suffix(".md").read_text("utf-8"), ROOMS.read_bytes()
    assert hashlib.sha256(data).hexdigest() in card and len(data) < 1_000_000
    listed = card.partition("## Photographs")[2].splitlines()
    rows = [line.split(" | ") for line in listed if "@" in line or "blender-data" in line]
    assert sum(int(row[1]) for row in rows) == 405 + 412 + 320
    assert all(row[2] in ("CC0-1.0", "MIT", "BSD-2-Clause", "CC-BY-4.0") for row in rows)


@pytest.mark.parametrize(("step", "each", "seed"), [(8, 5, 5), pytest.param(3, 20, 3, marks=pytest.mark.slow)])
def test_more_balls_in_photographs_than_the_default_finds_with_few_false_ones(step, each, seed):
    photographs = read_photographs(SHIPPED)[::step]
    report = score_photos(subjects(["onnx", "onnx:rooms"]), photographs, each, seed, kinds=HARD)
    plain, rooms = (sum(report.figures[name].kinds[kind].hit for kind in HARD) for name in ("onnx", "onnx:rooms"))
    assert rooms >= plain + 3 and report.figures["onnx:rooms"].false_alarms <= 0.09 * len(photographs)
