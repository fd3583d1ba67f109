"""Labeled scenes: their ranges, one scene per seed, and scored scenes that were never trained on."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

import simplejpeg

from sightline.sim.scenes import render as scene_backdrop
from sightline.sim.scenes.model import (
    BALL_PX,
    COLUMNS,
    HARDER_FROM,
    HEIGHT_PX,
    LABELS,
    LATER_FROM,
    MOST_DISTRACTORS,
    MOST_HIDDEN,
    SCORED_FROM,
    STATES,
    THINGS,
    VALIDATED_FROM,
    WIDTH_PX,
    Lens,
    trained_column,
)
from sightline.sim.scenes.model import TRAINED as TRAINED_COLUMN
from sightline.sim.scenes.plan import as_seen, plan_scene, streak, with_defects
from sightline.sim.scenes.render import SceneRenderer
from sightline.sim.scenes.textures import (
    FAMILIES,
    SCORED,
    SIDE,
    TRAINED,
    TRAINED_HARDER,
    TRAINED_LATER,
    VALIDATED,
    texture,
)
from tests.fixtures.sim import use_pybullet_without_numpy
from tests.sim.scenes import scored_scenes

pytestmark = pytest.mark.computes

ALL = [*COLUMNS.values(), THINGS, TRAINED_COLUMN]


@pytest.fixture(scope="module")
def renderer():
    with SceneRenderer() as one:
        yield one


def judged_plans(column, count=150):
    return [plan_scene(SCORED_FROM + number, column) for number in range(count)]


def test_a_seed_is_a_scene_in_any_order(renderer):
    first = renderer.scene(SCORED_FROM + 3, COLUMNS["all at once"])
    renderer.scene(17, TRAINED_COLUMN)
    with SceneRenderer() as other:
        again = other.scene(SCORED_FROM + 3, COLUMNS["all at once"])
    assert np.array_equal(first.rgb, again.rgb) and first.truths == again.truths
    assert as_seen(first) == as_seen(again)
    assert not np.array_equal(first.rgb, renderer.scene(SCORED_FROM + 4, COLUMNS["all at once"]).rgb)


def test_scene_with_pybullet_without_numpy_is_the_same(renderer, monkeypatch):
    scene = renderer.scene(SCORED_FROM + 3, COLUMNS["all at once"])
    widths = use_pybullet_without_numpy(monkeypatch)
    again = renderer.scene(SCORED_FROM + 3, COLUMNS["all at once"])
    assert set(widths) == {WIDTH_PX} and scene.truths
    assert np.array_equal(scene.rgb, again.rgb) and (scene.truths, scene.unclear) == (again.truths, again.unclear)


def test_scored_scenes_are_those_of_the_published_figures(monkeypatch):
    then = scored_scenes.kept()
    for now, before in zip(scored_scenes.drawn(), then, strict=True):
        assert (now["column"], now["seed"]) == (before["column"], before["seed"])
        assert not scored_scenes.differences(now, before), f"{scored_scenes.__doc__}\n{now['column']} {now['seed']}"
    monkeypatch.setattr(scene_backdrop, "texture", lambda family, seed: texture(family, seed + 1))
    assert all(map(scored_scenes.differences, scored_scenes.drawn(), then)), "another texture is noticed"


def test_a_ball_is_as_large_as_agreed_and_stands_in_view():
    for column in ALL:
        for seed in range(SCORED_FROM, SCORED_FROM + 40):
            plan = plan_scene(seed, column)
            for one in plan.solids:
                if one.label == "ball":
                    x1, y1, x2, y2 = plan.lens.ball_box(one.at_m, one.size_m[0] / 2)
                    assert BALL_PX[0] * 0.98 <= min(x2 - x1, y2 - y1) <= BALL_PX[1] * 1.02
                    assert 0 < (x1 + x2) / 2 < WIDTH_PX and 0 < (y1 + y2) / 2 < HEIGHT_PX


def test_scored_scenes_were_never_trained_on():
    purposes = {0: TRAINED, LATER_FROM: TRAINED_LATER, HARDER_FROM: TRAINED_HARDER, VALIDATED_FROM: VALIDATED,
                SCORED_FROM: SCORED}
    trained = {*TRAINED, *TRAINED_LATER, *TRAINED_HARDER}
    assert not set(SCORED) & {*trained, *VALIDATED} and not set(VALIDATED) & trained
    assert {name for names in purposes.values() for name in names} == set(FAMILIES)
    heights_deg = {True: [], False: []}
    for first, seed in [(first, first + number) for first in purposes for number in range(300)]:
        plan = plan_scene(seed, COLUMNS["nominal"])
        assert plan.floor.family in purposes[first] and plan.wall.family in purposes[first]
        heights_deg[seed >= SCORED_FROM].append(math.degrees(math.asin(plan.light_from[2])))
    assert all(30 <= one <= 50 for one in heights_deg[True])
    assert not any(30 < one < 50 for one in heights_deg[False])


def test_what_is_trained_last_has_more_boxes_of_the_balls_colour_and_more_legs():
    def share(first, shape):
        plans = [plan_scene(seed, trained_column(seed)) for seed in range(first, first + 200)]
        return sum(any(one.shape == shape for one in plan.solids) for plan in plans) / 200

    assert trained_column(HARDER_FROM - 1) == TRAINED_COLUMN
    assert share(HARDER_FROM, "legs") > share(0, "legs") + 0.2 and share(HARDER_FROM, "box") > share(0, "box")


def test_columns_match_their_names():
    boxes = judged_plans(COLUMNS["same-color boxes"])
    for plan in boxes:
        near = [one for one in plan.solids if one.shape == "box"]
        alike = [one for one in near if max(one.colour[:2]) > 0.6 and one.colour[2] < 0.45]
        assert len(alike) >= 2
    things = judged_plans(THINGS)
    assert all({"legs"} < {one.label for one in plan.solids} for plan in things)
    lights = [one.label for plan in things for one in plan.solids if one.shape == "light"]
    assert {lights.count(f"light-{state}") for state in STATES} == {len(things) // len(STATES)}
    most = max(len(plan.solids) for plan in judged_plans(COLUMNS["nominal"]))
    assert 4 <= most <= MOST_DISTRACTORS + 4  # the ball, a light, legs, one thing in front of it


def test_each_fifth_scored_scene_has_no_ball():
    for start in (SCORED_FROM, VALIDATED_FROM):
        has = [any(one.label == "ball" for one in plan_scene(start + n, COLUMNS["nominal"]).solids) for n in range(20)]
        assert has == [n % 5 != 0 for n in range(20)]


def test_boxes_are_exact_and_no_ball_is_hidden_too_far(renderer):
    whole = hidden = 0
    for seed in range(SCORED_FROM, SCORED_FROM + 60):
        scene = renderer.scene(seed, COLUMNS["same-color boxes"])
        assert sum(one.label == "ball" for one in scene.truths) == (seed % 5 != 0), "an answer is not a false alarm"
        assert sum(one.is_like_ball for one in scene.plan.solids) == 2, "the column is named for them"
        for one in scene.truths:
            assert one.label in LABELS
            assert 0 <= one.box[0] < one.box[2] <= WIDTH_PX and 0 <= one.box[1] < one.box[3] <= HEIGHT_PX
            if one.label != "ball":
                continue
            assert one.seen >= 1 - MOST_HIDDEN
            hidden += one.seen < 0.9
            if one.seen > 0.99:
                whole += 1
                assert one.box == pytest.approx(one.whole, abs=1.0)
    assert whole >= 10 and hidden >= 5


def test_the_whole_balls_box_is_that_of_its_outline():
    lens, at, radius = Lens(260.0, 0.2), (1.1, 0.3, -0.25), 0.12
    around = np.random.default_rng(1).normal(size=(200_000, 3))
    points = np.array(at) + radius * around / np.linalg.norm(around, axis=1, keepdims=True)
    right, down, ahead = (points @ lens.axes()).T
    u, v = WIDTH_PX / 2 + 260 * right / ahead, HEIGHT_PX / 2 + 260 * down / ahead
    assert lens.ball_box(at, radius) == pytest.approx((u.min(), v.min(), u.max(), v.max()), abs=0.02)


def test_a_pixel_and_its_point_agree():
    lens = Lens(240.0, 0.3)
    x, y, z = np.array(lens.point(200.0, 90.0, 2.0)) @ lens.axes()
    assert (WIDTH_PX / 2 + 240 * x / z, HEIGHT_PX / 2 + 240 * y / z, z) == pytest.approx((200, 90, 2))


@pytest.mark.parametrize("family", FAMILIES)
def test_textures_are_tiles_of_their_seed(family):
    one = texture(family, 5)
    assert one.shape == (SIDE, SIDE, 3) and one.dtype == np.uint8
    assert np.array_equal(one, texture(family, 5)) and not np.array_equal(one, texture(family, 6))


def test_light_and_quality_have_their_effects(renderer):
    scene = renderer.scene(SCORED_FROM + 2, COLUMNS["nominal"])
    nominal, light = COLUMNS["nominal"], replace(COLUMNS["changed light"], gain=(0.25, 0.25))
    means = [simplejpeg.decode_jpeg(with_defects(scene.rgb, one, np.random.default_rng(4)), "RGB").mean()
             for one in (nominal, light)]
    assert 0.15 < means[1] / means[0] < 0.4
    sizes = [
        len(with_defects(scene.rgb, COLUMNS[name], np.random.default_rng(4))) for name in ("nominal", "quality 30")
    ]
    assert sizes[1] < 0.7 * sizes[0]


def test_blur_takes_detail_away_and_keeps_the_light(renderer):
    scene = renderer.scene(SCORED_FROM + 2, COLUMNS["nominal"])
    grey = [simplejpeg.decode_jpeg(with_defects(scene.rgb, COLUMNS[name], np.random.default_rng(4)), "GRAY")[..., 0]
            .astype(float) for name in ("nominal", "blur")]
    detail = [np.abs(np.diff(one, axis=0)).mean() for one in grey]
    assert detail[1] < 0.6 * detail[0] and grey[1].mean() == pytest.approx(grey[0].mean(), rel=0.1)


@pytest.mark.parametrize("angle_deg", [0, 30, 90, 135])
def test_streak_has_the_configured_length_and_brightness(angle_deg):
    kernel = streak(15.0, math.radians(angle_deg))
    rows, columns = np.nonzero(kernel)
    assert kernel.sum() == pytest.approx(1.0)
    assert math.hypot(np.ptp(rows), np.ptp(columns)) == pytest.approx(15, abs=1.6)
