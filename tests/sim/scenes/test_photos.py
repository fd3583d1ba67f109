"""Scenes over photographs: what is labeled is what has changed, and every design is a ball."""

import cv2
import numpy as np
import pytest

from sightline.sim.scenes import photos, sprites
from sightline.sim.scenes.model import HEIGHT_PX, MOST_HIDDEN, WIDTH_PX
from sightline.sim.scenes.photos import photo_scene


def photographs(count=3):
    """Smooth random images of several sizes."""
    draw = np.random.default_rng(5)
    sizes = [(300, 500), (240, 320), (700, 400)]
    return [cv2.resize(draw.integers(40, 200, (6, 8, 3), np.uint8), (wide, high), interpolation=cv2.INTER_CUBIC)
            for high, wide in (sizes * count)[:count]]


def test_a_seed_always_gives_the_same_scene():
    first, again, other = (photo_scene(photographs(), seed) for seed in (4, 4, 5))
    assert np.array_equal(first.rgb, again.rgb) and first.truths == again.truths and first.others == again.others
    assert not np.array_equal(first.rgb, other.rgb)
    assert first.rgb.shape == (HEIGHT_PX, WIDTH_PX, 3) and first.rgb.dtype == np.uint8


def test_scenes_show_balls_of_all_sizes_and_some_none():
    scenes = [photo_scene(photographs(), seed) for seed in range(70)]
    truths = [one for scene in scenes for one in scene.truths]
    assert {one.label for one in truths} == {"ball"} and all(one.seen >= 1 - MOST_HIDDEN for one in truths)
    sizes = [max(one.box[2] - one.box[0], one.box[3] - one.box[1]) for one in truths]
    assert min(sizes) < 12 and max(sizes) > 80
    assert 0.15 < sum(not scene.truths for scene in scenes) / len(scenes) < 0.55
    assert any(scene.others for scene in scenes) and any(scene.unclear for scene in scenes)


@pytest.mark.parametrize("seed", range(6))
def test_a_labeled_box_is_around_what_a_ball_has_changed(seed, monkeypatch):
    """Balls alone, without shadows, things and what hides them: the difference is the label."""
    monkeypatch.setattr(photos, "_MOST_THINGS", 0)
    monkeypatch.setattr(photos, "_WITHOUT_BALL", 0.0)
    for name in ("_shade_floor", "_hide"):
        monkeypatch.setattr(photos, name, lambda *_: None)
    scene = photo_scene(photographs(), seed)
    monkeypatch.setattr(photos, "_cover", lambda canvas, *_: np.zeros(canvas.shape[:2], np.float32))
    changed = np.abs(scene.rgb.astype(int) - photo_scene(photographs(), seed).rgb).max(axis=2) > 12
    inside = np.zeros_like(changed)
    for box in [one.box for one in scene.truths] + list(scene.unclear):
        inside[max(0, int(box[1]) - 2) : int(box[3]) + 2, max(0, int(box[0]) - 2) : int(box[2]) + 2] = True
    assert not (changed & ~inside).any()
    for one in scene.truths:
        x1, y1, x2, y2 = (int(edge) for edge in one.box)
        assert changed[y1:y2, x1:x2].mean() > 0.4


@pytest.mark.parametrize("design", sprites._DESIGNS)
@pytest.mark.parametrize("width_px", [8.0, 33.5, 110.0])
def test_every_design_is_a_disk_of_its_width(design, width_px, monkeypatch):
    monkeypatch.setattr(sprites, "_DESIGNS", (design,))
    monkeypatch.setattr(sprites, "_WEIGHTS", (1.0,))
    draw = np.random.default_rng(8)
    light = sprites.any_light(draw, np.ones(3, np.float32))
    one = sprites.ball(draw, width_px, light)
    area = np.pi / 4 * width_px**2
    assert abs(one.cover.sum() / area - 1) < 0.03 and one.rgb.min() >= 0 and one.rgb.max() <= 1
    rows, columns = np.nonzero(one.cover > 0.5)
    assert abs(np.ptp(rows) + 1 - width_px) <= 2 and abs(np.ptp(columns) + 1 - width_px) <= 2


@pytest.mark.parametrize("shape", sprites._SHAPES)
def test_no_thing_fills_a_disk(shape, monkeypatch):
    monkeypatch.setattr(sprites, "_SHAPES", (shape,))
    light = sprites.any_light(np.random.default_rng(1), np.ones(3, np.float32))
    disk = sprites.ball(np.random.default_rng(1), 60.0, light).cover > 0.5
    for seed in range(20):
        cover = sprites.thing(np.random.default_rng(seed), 60.0, light).cover > 0.5
        assert 0 < (cover & disk).sum() / (cover | disk).sum() < 0.9
