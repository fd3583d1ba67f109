"""Detectors on photographs: how a picture counts, and the figures of good, blind and wrong detectors."""

import json

import cv2
import numpy as np
import pytest

from sightline.evaluation.photographs import FEWEST, Photograph
from sightline.evaluation.score import photo_report
from sightline.evaluation.score.ball_textures import KINDS
from sightline.evaluation.score.detector_report import Subject
from sightline.evaluation.score.photo_balls import photo_with_ball, photo_without_ball
from sightline.evaluation.score.photo_report import (
    COLORS,
    colored_lines,
    photo_lines,
    photo_pictures,
    score_photos,
    wilson,
)
from sightline.operator_side.cli import app as cli
from sightline.sim.scenes.model import COLUMNS
from sightline.vision_side.detect.port import Detection, DetectionResult

pytestmark = pytest.mark.computes

EACH = 1


def photographs(count=4):
    draw = np.random.default_rng(3)
    return [Photograph(f"{number}.jpg", cv2.resize(draw.integers(60, 200, (4, 5, 3), np.uint8), (360, 300)))
            for number in range(count)]


@pytest.fixture(scope="module")
def pictures():
    return list(photo_pictures(photographs(), EACH, 1))


@pytest.fixture
def boxes(pictures, monkeypatch):
    """Number of a picture -> the ball's box, None without a ball. The pictures are rendered once for all tests."""
    monkeypatch.setattr(photo_report, "photo_pictures", lambda *_: iter(pictures))
    return {one.number: one.ball and one.ball.box for one in pictures}


class KnowingDetector:
    """Answers with the ball of each picture, changed by `change`; None is a picture without a ball."""

    def __init__(self, boxes, change):
        self._boxes, self._change = boxes, change

    def detect(self, frames, deadline_us):
        (frame,) = frames
        found = self._change(self._boxes[int(frame.header.session, 16)])
        marks = () if found is None else (Detection(*found, 0.9, "ball"),)
        header = frame.header
        return [DetectionResult(frame.robot, header.session, header.seq, header.t_us, 320, 240, marks, "x")]


def figures(boxes, change):
    detector = KnowingDetector(boxes, change)
    report = score_photos([Subject("x", detector)], photographs(), EACH, 1)
    return report, report.figures["x"]


def test_a_detector_that_marks_each_ball_hits_all(boxes):
    report, one = figures(boxes, lambda box: box)
    assert all(tally.hit == tally.balls == EACH for tally in one.kinds.values()) and set(one.kinds) == set(KINDS)
    assert one.small.balls + one.large.balls == EACH * len(KINDS) and one.small.balls > 0 < one.large.balls
    assert (one.false_alarms, one.empty) == (0, 4) and one.interval[0] == 0 and one.interval[1] > 0.3
    told = "\n".join(photo_lines(report))
    assert "100.0 %" in told and "x: a ball in 0 of 4 photographs without one" in told
    assert report.to_dict()["photographs"] == 4


def test_a_blind_detector_misses_all(boxes):
    _, one = figures(boxes, lambda box: None)
    assert all(tally.missed == EACH for tally in one.kinds.values()) and one.false_alarms == 0


def test_a_detector_that_marks_something_else_is_wrong_and_a_false_alarm(boxes):
    _, one = figures(boxes, lambda box: (0.0, 0.0, 9.0, 9.0))
    assert all(tally.wrong == EACH and tally.hit == 0 for tally in one.kinds.values())
    assert one.false_alarms == one.empty == 4


def test_missing_answers_are_missed_and_reported(boxes):
    def fails(box):
        raise RuntimeError("out of memory")

    report, one = figures(boxes, fails)
    assert one.unanswered == EACH * len(KINDS) + 4 and all(tally.missed == EACH for tally in one.kinds.values())
    assert any("no answer to 13 pictures" in line and "out of memory" in line for line in photo_lines(report))


def test_a_tracked_ball_is_expected_near_its_place(boxes):
    places = {}

    class NotedDetector(KnowingDetector):
        def detect(self, frames, deadline_us):
            places[int(frames[0].header.session, 16)] = frames[0].expected_px
            return super().detect(frames, deadline_us)

    noted = NotedDetector(boxes, lambda box: box)
    assert score_photos([Subject("x", noted)], photographs(), EACH, 1, tracked=True).tracked
    off = [(x - (box[0] + box[2]) / 2, y - (box[1] + box[3]) / 2)
           for number, (x, y) in places.items() if (box := boxes[number])]
    assert len(off) == EACH * len(KINDS) and 5 < max(map(max, off)) <= 20 and -20 <= min(map(min, off)) < -5
    assert len(set(places.values())) == len(places)
    score_photos([Subject("x", noted)], photographs(), EACH, 1)
    assert set(places.values()) == {None}


@pytest.mark.parametrize(("label", "followed"), [("", ["ball", "cup"]), ("cup", ["cup"])])
def test_a_mission_follows_the_ball(boxes, label, followed):
    seen = set()

    class NotedDetector(KnowingDetector):
        def detect(self, frames, deadline_us):
            seen.add(tuple(name for name in ("ball", "legs", "light-red", "cup") if frames[0].goes_by(name)))
            return super().detect(frames, deadline_us)

    score_photos([Subject("x", NotedDetector(boxes, lambda box: box), label)], photographs(), 1, 1)
    assert seen == {tuple(followed)}


def test_the_interval_is_wilsons():
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(3, 100)
    assert low == pytest.approx(0.0103, abs=2e-4) and high == pytest.approx(0.0845, abs=2e-4)
    for count, total in ((0, 10), (5, 10), (10, 10)):
        low, high = wilson(count, total)
        assert 0 <= low <= count / total <= high <= 1


@pytest.fixture
def folder(tmp_path):
    for number in range(FEWEST):
        picture = photographs(1)[0].rgb + np.uint8(number)
        cv2.imwrite(str(tmp_path / f"{number:02}.png"), picture)
    return tmp_path


def test_the_command_prints_json(folder, capsys):
    assert cli.run(["score", "detectors", "hsv", "--photos", str(folder), "--frames", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["figures"]["hsv"]["empty"] == FEWEST


def test_seeds_choose_the_pictures(folder, capsys):
    command = ["score", "detectors", "hsv", "--photos", str(folder), "--frames", "1"]
    printed = []
    for more in ([], ["--seeds", "1"], ["--seeds", "7"]):
        assert cli.run([*command, *more]) == 0
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] != printed[2] and "seed 7" in printed[2]


@pytest.mark.parametrize("arguments", [["--demand"], ["--column", "blur,nominal"], ["--column", "easy"]])
def test_options_of_the_scenes_are_rejected_with_photographs(folder, arguments, capsys):
    assert cli.run(["score", "detectors", "hsv", "--photos", str(folder), *arguments]) == 2
    assert arguments[0] in capsys.readouterr().err


def test_the_camera_of_a_column_takes_the_pictures(folder, capsys):
    clear, blurred = (list(photo_pictures(photographs(), EACH, 1, ("red",), column))
                      for column in (None, COLUMNS["blur"]))
    for one, other in zip(clear, blurred, strict=True):
        assert (one.number, one.ball, one.radius_px) == (other.number, other.ball, other.radius_px)
        sharp, soft = (cv2.Laplacian(cv2.imdecode(np.frombuffer(jpeg, np.uint8), 0), cv2.CV_32F).std()
                       for jpeg in (one.jpeg, other.jpeg))
        assert soft != sharp and (one.ball is None or soft < sharp)
    command = ["score", "detectors", "hsv", "--photos", str(folder), "--frames", "1", "--column", "quality 30"]
    assert cli.run(command) == 0 and "column quality 30" in capsys.readouterr().out


# --- the balls themselves ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_the_box_is_around_what_the_ball_has_changed(kind):
    photo = photographs(1)[0].rgb
    seed = KINDS.index(kind)
    drawn = photo_with_ball(photo, kind, seed)
    assert 5 <= drawn.radius_px <= 45 and 0.55 <= drawn.seen <= 1
    x1, y1, x2, y2 = (round(edge) for edge in drawn.box)
    changed = np.abs(drawn.rgb.astype(int) - photo_without_ball(photo, seed)).max(axis=2) > 6
    assert changed[y1:y2, x1:x2].mean() > 0.35
    assert max(x2 - x1, y2 - y1) <= 2 * drawn.radius_px * 1.25 + 2


def test_a_seed_always_gives_the_same_picture():
    photo = photographs(1)[0].rgb
    assert np.array_equal(photo_with_ball(photo, "tennis", 3).rgb, photo_with_ball(photo, "tennis", 3).rgb)


@pytest.mark.slow
def test_balls_are_of_all_sizes_and_some_are_partly_covered():
    photo = photographs(1)[0].rgb
    drawn = [photo_with_ball(photo, "red", seed) for seed in range(22)]
    assert min(one.radius_px for one in drawn) < 7 and max(one.radius_px for one in drawn) > 35
    assert 1 <= sum(one.seen < 1 for one in drawn) <= 12


def test_pictures_of_some_kinds_are_those_of_all_kinds(pictures):
    some = list(photo_pictures(photographs(), EACH, 1, ("tennis", "red")))
    assert [one.kind for one in some] == ["tennis", "red", "", "", "", ""]
    assert {one.number: one.jpeg for one in some}.items() <= {one.number: one.jpeg for one in pictures}.items()


def test_each_kind_is_scored_with_its_color_set(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(photo_report, "COLORS", {kind: COLORS[kind] for kind in ("blue", "red")})
    for number, one in enumerate(photographs(FEWEST)):
        cv2.imwrite(str(tmp_path / f"{number:02}.png"), one.rgb)
    command = ["score", "detectors", "hsv", "--photos", str(tmp_path), "--frames", "2"]
    assert cli.run([*command, "--colored", "--json"]) == 0
    colored = json.loads(capsys.readouterr().out)
    assert list(colored) == ["blue", "red"]
    hits = {kind: one["figures"]["hsv"]["kinds"][kind]["hit"] for kind, one in colored.items()}
    assert sum(hits.values()) >= 3


def test_lines_of_balls_with_their_color_set(boxes):
    report, _ = figures(boxes, lambda box: box or (1.0, 1.0, 9.0, 9.0))
    lines = colored_lines({"red": report, "blue": report})
    assert lines[0].split() == ["balls", "detector", "pictures", "hits", "wrong", "missed", "false", "alarms"]
    assert [line.split() for line in lines[1:]] == [
        [kind, "x", "1", "100.0", "%", "0.0", "%", "0.0", "%", "4", "of", "4"] for kind in ("red", "blue")]


def test_colored_belongs_to_photographs(capsys):
    assert cli.run(["score", "detectors", "hsv", "--colored"]) == 2
    assert "--photos" in capsys.readouterr().err
