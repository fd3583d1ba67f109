"""The second look: an enlarged part of the image where the target is expected, and what counts of it."""

from dataclasses import replace

import numpy as np
import pytest

from sightline.protocol.messages import FrameHeader
from sightline.vision_side.config import DetectorConfig, VisionConfig
from sightline.vision_side.decode import DecodedImage, Decoder
from sightline.vision_side.detect.onnx.tensors import ImageTile, tile_about, view_again, vivid
from sightline.vision_side.detect.port import NO_DEADLINE, Circle, DetectFrame, Detection
from sightline.vision_side.detect.registry import build_detector
from tests.fixtures.vision.onnx import brightness_model
from tests.fixtures.vision.vision import BALL_RADIUS_M, camera, jpeg_of, scene

pytestmark = pytest.mark.usefixtures("no_gpu")

FAR_M = 6.6
"""A ball that is too small for the first look, at 320x240 and 0.1 m to the left."""
ASIDE_M = 0.1
EXPECTED_PX = (150.0, 122.0)


@pytest.fixture(scope="module")
def shipped():
    return build_detector("onnx", {}, VisionConfig(detector=DetectorConfig(kind="onnx", device="cpu")))


@pytest.fixture(scope="module")
def one_look():
    return build_detector("onnx", {"second_look": False}, VisionConfig(detector=DetectorConfig(device="cpu")))


def found(detector, model, jpeg, expected_px=None, goes_by=None, *, looks_once=False):
    """The detections in one image."""
    size = (model.width_px, model.height_px)
    frame = DetectFrame("r1", FrameHeader(session="0000abcd", seq=1, t_us=1), jpeg, Decoder(*size, size[0] * size[1]))
    frame.expected_px, frame.looks_once = expected_px, looks_once
    if goes_by is not None:
        frame.goes_by = goes_by
    (result,) = detector.detect([frame], NO_DEADLINE)
    return result.detections


@pytest.mark.parametrize(("width_px", "height_px"), [(320, 240), (640, 480)])
@pytest.mark.parametrize("aside_m", [-0.4, 0.1])
def test_more_far_balls_are_found_where_they_are_expected(shipped, one_look, width_px, height_px, aside_m):
    model = camera(width_px, height_px)
    once = twice = 0
    for far_m in np.linspace(4.8, 8.4, 7):
        jpeg = jpeg_of(scene(model, far_m, aside_m, shaded=True))
        once += len(found(one_look, model, jpeg))
        middle = width_px / 2 - model.fx_px * aside_m / far_m
        for one in found(shipped, model, jpeg, (middle, height_px * 0.52)):
            twice += 1
            assert abs((one.x1_px + one.x2_px) / 2 - middle) < 0.03 * width_px
            width = one.x2_px - one.x1_px
            assert 0.75 < width / (2 * BALL_RADIUS_M / far_m * model.fx_px) < 1.4
    assert once + 2 <= twice <= 7


def test_a_second_look_is_without_effect_elsewhere_for_other_labels_and_where_it_is_off(shipped, one_look):
    model = camera(320, 240)
    jpeg = jpeg_of(scene(model, FAR_M, ASIDE_M, shaded=True))
    assert len(found(shipped, model, jpeg, EXPECTED_PX)) == 1
    assert found(shipped, model, jpeg_of(scene(model, FAR_M, 1.5, shaded=True)), (310.0, 120.0)) == ()
    assert found(shipped, model, jpeg, EXPECTED_PX, goes_by=lambda label: label == "legs") == ()
    assert found(one_look, model, jpeg) == ()


def stub(*looks, options=None):
    """A detector whose model gives in turn each of `looks`: ((x, y), score, label number or 0, width or 60), squares
    in px of an image of 320x240."""
    detector = build_detector("onnx", options or {}, VisionConfig(detector=DetectorConfig(device="cpu")))
    waiting = [*looks]

    def run(_pixels):
        boxes = waiting.pop(0)
        halves = [one[3] / 2 if len(one) > 3 else 30.0 for one in boxes]
        corners = [[x - half, y - half, x + half, y + half] for ((x, y), *_), half in zip(boxes, halves, strict=True)]
        scale = detector._form.size[1] / 320
        return {"boxes": scale * np.float32(corners).reshape(-1, 4), "scores": np.float32([one[1] for one in boxes]),
                "labels": np.float32([one[2] if len(one) > 2 else 0 for one in boxes])}

    detector._engine.run = run
    return detector, waiting


GRAY = jpeg_of(np.full((240, 320, 3), 110, np.uint8))
PLACE = (160.0, 120.0)


@pytest.mark.parametrize(("first", "second", "score"), [
    (0.24, None, None), (0.26, 0.83, None), (0.26, 0.85, 0.555), (0.49, 0.62, 0.555), (0.5, 0.59, None),
    (0.69, 0.42, 0.555), (0.69, 0.4, None), (0.69, None, None), (0.71, None, 0.71)])
@pytest.mark.parametrize("width_px", [20.0, 60.0])
def test_without_a_track_the_mean_of_two_looks_decides_about_a_target_in_doubt(first, second, score, width_px):
    where = (130.0, 110.0)  # of a small one: the middle of the enlarged part
    again = (160.0, 120.0) if width_px < 24 else (320 - where[0], where[1])
    more, is_in_doubt = (1 / 0.6 if width_px < 24 else 1.0), 0.25 <= first < 0.7
    looks = [[(where, first, 0, width_px)]]
    looks += [[(again, second, 0, width_px * more)] if second else []] if is_in_doubt else []
    detector, waiting = stub(*looks)
    seen = found(detector, camera(320, 240), GRAY)
    assert [round(one.score, 3) for one in seen] == ([] if score is None else [score]) and waiting == []
    for one in seen:
        assert one.center_px == pytest.approx(where, abs=1.0)
        assert one.x2_px - one.x1_px == pytest.approx(width_px, abs=0.1)


def test_without_a_track_the_second_look_counts_for_each_target_with_its_own_score_there():
    places, mirrored = [(50.0, 60.0), (160.0, 120.0), (270.0, 180.0)], [(270.0, 60.0), (160.0, 120.0), (50.0, 180.0)]
    first, second = (0.6, 0.55, 0.3), (0.52, 0.5, 0.9)
    detector, waiting = stub([*zip(places, first, strict=True), ((40.0, 200.0), 0.8, 4)],
                             [*zip(mirrored, second, strict=True), ((160.0, 40.0), 0.95), ((160.0, 120.0), 0.95, 4)])
    seen = found(detector, camera(320, 240), GRAY, goes_by="ball".__eq__)
    assert waiting == []
    assert [(one.label, one.center_px[0], round(one.score, 2)) for one in seen] == [
        ("legs", 40, 0.8), ("ball", 270, 0.6), ("ball", 50, 0.56)], "nothing of the second look alone"


@pytest.mark.parametrize(("again", "count"), [(1, 1), (3, 0)])
def test_a_light_of_another_state_in_the_second_look_is_another_thing(again, count):
    detector, waiting = stub([(PLACE, 0.6, 1)], [(PLACE, 0.9, again)])
    assert len(found(detector, camera(320, 240), GRAY)) == count and waiting == []


@pytest.mark.parametrize(("where", "width_px"), [((3.0, 90.0), 12.0), ((30.0, 110.0), 60.0), ((160.0, 60.0), 240.0)])
def test_a_target_at_the_border_and_a_large_one_are_mirrored_for_the_second_look(where, width_px):
    detector, waiting = stub([(where, 0.6, 0, width_px)], [((320 - where[0], where[1]), 0.6, 0, width_px)])
    (one,) = found(detector, camera(320, 240), GRAY)
    assert waiting == [] and one.score == pytest.approx(0.6)
    x1, x2 = max(0.0, where[0] - width_px / 2), where[0] + width_px / 2
    assert (one.x1_px, one.x2_px) == pytest.approx((x1, x2), abs=0.1)


def test_without_a_track_only_a_target_in_doubt_gets_a_second_look():
    for goes_by, runs in (("ball".__eq__, 2), ("light-red".__eq__, 1)):
        detector, waiting = stub([((40.0, 40.0), 0.45, 4), (PLACE, 0.4)], [])
        assert found(detector, camera(320, 240), GRAY, goes_by=goes_by) == () and len(waiting) == 2 - runs
    detector, waiting = stub([(PLACE, 0.4)], [(PLACE, 0.9)])
    assert found(detector, camera(320, 240), GRAY, looks_once=True) == () and len(waiting) == 1


@pytest.mark.parametrize("scale", [1, 2])
def test_a_view_again_shows_the_same_pixels_and_finds_the_same_place(scale):
    bgr = np.random.default_rng(2).integers(0, 255, (240 // scale, 320 // scale, 3), np.uint8)
    for left, width in ((100.0, 20.0), (100.0, 24.0), (0.0, 20.0), (200.0, 80.0)):
        one = Detection(left, 90.0, left + width, 90.0 + width, 0.5, "ball", Circle(left + 9.0, 99.0, 8.0))
        view = view_again(DecodedImage(bgr, scale), one)
        assert view.is_mirrored == (left == 0 or width >= 24)
        if view.is_mirrored:
            assert np.array_equal(view.picture.bgr[:, ::-1], bgr)
            there = Detection(320 - left - width, 90.0, 320 - left, 90.0 + width, 0.5, "ball",
                              Circle(320 - left - 9.0, 99.0, 8.0))
            assert view.shows_all(there)
        else:
            there = replace(one, x1_px=left - view.left_px, x2_px=left + width - view.left_px,
                            y1_px=90.0 - view.top_px, y2_px=90.0 + width - view.top_px,
                            circle=Circle(left + 9.0 - view.left_px, 99.0 - view.top_px, 8.0))
        assert view.in_image(there) == one


@pytest.mark.parametrize(("options", "bonus"), [
    ({}, 0.2), ({"expected_bonus": 0.4}, 0.4)])
@pytest.mark.parametrize("away_px", [0.0, 10.0, 20.0, 28.0])
def test_a_weaker_sign_is_enough_near_the_place_where_the_target_is_expected(options, bonus, away_px):
    needed = 0.5 - bonus * (1 - (away_px / 32) ** 2)
    where = (PLACE[0] + 0.6 * away_px, PLACE[1] - 0.8 * away_px)
    detector, waiting = stub([(where, needed + 0.005)], [], [(where, needed - 0.005)], [], options=options)
    (one,) = found(detector, camera(320, 240), GRAY, PLACE)
    assert one.center_px == pytest.approx(where, abs=0.01)
    assert one.score == 0.5 and len(waiting) == 2
    assert found(detector, camera(320, 240), GRAY, PLACE) == ()
    assert waiting == []


def test_the_enlarged_part_decides_where_and_how_large_a_weak_target_is():
    detector, waiting = stub([((155.0, 120.0), 0.45)], [((160.0 + 8 * 320 / 192, 120.0), 0.4)])
    (one,) = found(detector, camera(320, 240), GRAY, PLACE)
    assert one.center_px == pytest.approx((168.0, 120.0), abs=0.1) and waiting == []
    assert one.x2_px - one.x1_px == pytest.approx(36.0, abs=0.1)


def test_without_a_second_look_a_weaker_sign_counts_too():
    detector, waiting = stub([(PLACE, 0.31), ((240.0, 120.0), 0.45)], [(PLACE, 0.31)], options={"second_look": False})
    assert [one.center_px for one in found(detector, camera(320, 240), GRAY, PLACE)] == [pytest.approx(PLACE)]
    assert found(detector, camera(320, 240), GRAY) == () and waiting == []


@pytest.mark.parametrize(("away_px", "score"), [(0.0, 0.31), (30.0, 0.48), (33.0, 0.61)])
def test_the_enlarged_part_shows_a_weaker_sign_too(away_px, score):
    # The middle of the part is its place, and all is 320/192 as large.
    second = (160.0 + away_px * 320 / 192, 120.0)
    for more, count in ((0.0, 1), (-0.02, 0)):
        detector, waiting = stub([], [(second, score + more)])
        seen = found(detector, camera(320, 240), GRAY, PLACE)
        assert [one.center_px for one in seen] == [pytest.approx((160.0 + away_px, 120.0), abs=0.1)] * count
        assert [one.score for one in seen] == [pytest.approx(max(0.5, score))] * count and waiting == []


def test_the_place_gives_no_bonus_to_other_labels_and_without_a_track():
    detector, waiting = stub([(PLACE, 0.45)], [(PLACE, 0.45)], [(PLACE, 0.45)], [])
    assert found(detector, camera(320, 240), GRAY, PLACE, "legs".__eq__) == ()
    assert found(detector, camera(320, 240), GRAY) == () and waiting == []


def test_a_thing_of_another_label_hides_no_target_from_the_second_look():
    detector, waiting = stub([(PLACE, 0.9, 4)], [(PLACE, 0.4)])
    seen = found(detector, camera(320, 240), GRAY, PLACE, "ball".__eq__)
    assert [(one.label, one.score) for one in seen] == [("legs", pytest.approx(0.9)), ("ball", 0.5)] and waiting == []


def test_both_looks_together_show_no_more_boxes_than_a_message_may_have():
    # 40 things elsewhere and 20 weak targets; the enlarged part shows 30 sure ones, none near the place.
    corners = [(20.0 + 7 * (one % 40), 20.0 + 200 * (one // 40)) for one in range(40)]
    first = [(corner, 0.9, 4) for corner in corners] + [((150.0 + one, 110.0), 0.3) for one in range(20)]
    detector, waiting = stub(first, [((40.0 + 8 * one, 40.0), 0.9) for one in range(30)])
    seen = found(detector, camera(320, 240), GRAY, PLACE, "ball".__eq__)
    assert waiting == [] and len(seen) == 64


@pytest.mark.parametrize(("score", "counts"), [(0.55, False), (0.59, False), (0.61, True)])
def test_elsewhere_than_expected_a_target_in_doubt_does_not_count(score, counts):
    elsewhere = (100.0, 120.0)
    for looks in (([(PLACE, 0.8), (elsewhere, score)],), ([(elsewhere, score)], [])):
        detector, waiting = stub(*looks)
        seen = [round(one.center_px[0]) for one in found(detector, camera(320, 240), GRAY, PLACE)]
        assert waiting == [] and (round(elsewhere[0]) in seen) == counts


def test_a_target_elsewhere_stops_no_second_look_and_is_reported_once_after_the_expected_one():
    elsewhere, in_tile = (200.0, 120.0), [(160.0, 120.0), (160.0 + 40 * 320 / 192, 120.0)]
    detector, waiting = stub([(elsewhere, 0.65)], [(in_tile[0], 0.46), (in_tile[1], 0.9)])
    seen = found(detector, camera(320, 240), GRAY, PLACE)
    assert waiting == []
    assert [(round(one.center_px[0]), round(one.score, 2)) for one in seen] == [(160, 0.5), (200, 0.65)]


def test_a_target_that_the_first_look_finds_costs_no_second_look(shipped, monkeypatch):
    model = camera(320, 240)
    jpeg = jpeg_of(scene(model, 1.0, ASIDE_M, shaded=True))
    runs = []
    run = shipped._engine.run
    monkeypatch.setattr(shipped._engine, "run", lambda pixels: runs.append(1) or run(pixels))
    first = found(shipped, model, jpeg)
    assert found(shipped, model, jpeg, EXPECTED_PX) == first and len(first) == 1 and len(runs) == 2
    found(shipped, model, jpeg_of(scene(model, FAR_M, ASIDE_M, shaded=True)), EXPECTED_PX)
    assert len(runs) == 4


@pytest.mark.parametrize("scale", [1, 2])
@pytest.mark.parametrize("place", [(0.0, 0.0), (319.0, 239.0), (160.0, 120.0), (-500.0, 90.0), (1e9, -1e9)])
def test_a_tile_is_inside_the_image(scale, place):
    rows, columns = 240 // scale, 320 // scale
    bgr = np.random.default_rng(1).integers(0, 255, (rows, columns, 3), np.uint8)
    tile = tile_about(DecodedImage(bgr, scale), place)
    left, top = tile.left_px // scale, tile.top_px // scale
    height, width = tile.picture.bgr.shape[:2]
    assert (width * scale, height * scale) == tile.size_px == (192, 144)
    assert np.array_equal(tile.picture.bgr, bgr[top : top + height, left : left + width])


def test_an_image_of_one_pixel_has_a_tile():
    assert tile_about(DecodedImage(np.zeros((1, 1, 3), np.uint8), 1), (5.0, 5.0)).size_px == (1, 1)


def test_a_detection_in_a_tile_has_its_place_in_the_image_and_is_left_out_at_the_border():
    tile = ImageTile(DecodedImage(np.zeros((72, 96, 3), np.uint8), 2), 40, 60)
    inside = Detection(10.0, 20.0, 30.0, 50.0, 0.7, "ball")
    assert tile.in_image(inside) == Detection(50.0, 80.0, 70.0, 110.0, 0.7, "ball")
    round_ = replace(inside, circle=Circle(20.0, 35.0, 10.0))
    assert tile.in_image(round_).circle == Circle(60.0, 95.0, 10.0)
    assert tile.shows_all(inside)
    for box in ((0.5, 20.0, 30.0, 50.0), (10.0, 0.0, 30.0, 50.0), (10.0, 20.0, 191.5, 50.0), (10.0, 20.0, 30.0, 144.0)):
        assert not tile.shows_all(Detection(*box, 0.7, "ball"))


@pytest.mark.parametrize(("size", "runs"), [((240, 320), 2), ((None, None), 1)])
def test_a_model_of_any_size_looks_once(tmp_path, monkeypatch, size, runs):
    path = brightness_model(tmp_path / "m.onnx", [[10.0, 20.0, 60.0, 90.0]], [0], size=size)
    detector = build_detector(f"onnx:{path}", {}, VisionConfig(detector=DetectorConfig(device="cpu")))
    seen, run = [], detector._engine.run
    monkeypatch.setattr(detector._engine, "run", lambda pixels: seen.append(1) or run(pixels))
    found(detector, camera(320, 240), jpeg_of(scene(camera(320, 240), 1.0, 0.0)), (160.0, 120.0), lambda _: False)
    assert len(seen) == runs and detector._expected_bonus == 0.0


@pytest.mark.parametrize(("saturation", "more"), [(1.0, 1.0), (0.3, 3.3), (0.0, 1.0)])
def test_only_a_pale_image_gets_the_usual_saturation_and_its_brightness_stays(saturation, more):
    gray, color = np.full((240, 320, 3), 120.0), np.array([-6.0, 2.0, 4.0])
    given = DecodedImage((gray + saturation * color).round().astype(np.uint8), 2)
    shown = vivid(given)
    assert shown.scale == 2 and (shown is given) == (more == 1.0)
    was, now = (one.bgr[0, 0].astype(float) - 120 for one in (given, shown))
    assert abs(now - more * was).max() <= 1.0
