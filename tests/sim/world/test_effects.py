"""Lens, shutter and exposure of the simulated camera: each changes the image in the way that its name promises."""

import math

import numpy as np
import pytest
import simplejpeg

from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import CameraModel
from sightline.sim.scenario import Look, look_named
from sightline.sim.world.effects import FASTEST_RAD_S, Defects, DistortedLens, Shutter, drift, published_model
from sightline.vision_side.tracking.locate import points_ahead

FOCAL_PX = 190.0
MODEL = CameraModel(
    width_px=320, height_px=240, fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=160.0, cy_px=120.0, calibrated=True
)
BARREL = (-0.12, 0.012, 0.001, -0.001)


def clean(**options) -> Look:
    return Look(noise=0.0, jpeg_quality=100, **options)


def edge(shutter: Shutter, across: bool) -> np.ndarray:
    """Return an image to expose: black, then white from the middle on, across or down."""
    canvas = shutter.canvas
    image = np.zeros((canvas.height_px, canvas.width_px, 3), np.uint8)
    if across:
        image[:, canvas.width_px // 2 :] = 255
    else:
        image[canvas.height_px // 2 :] = 255
    return image


def edge_px(line: np.ndarray) -> float:
    """Return where a row turns from black to white."""
    return len(line) - float(line.astype(float).sum()) / 255


# --- lens ---------------------------------------------------------------------------------------------------------


def test_lens_distorts_as_the_camera_channel_defines_it():
    lens = DistortedLens(MODEL, clean(distortion=BARREL))
    rays = np.array([[0.0, 0.0], [0.3, -0.2], [-0.7, 0.4], [0.75, 0.5]])
    pixels = lens.distorted(rays)
    ahead = points_ahead(pixels, MODEL.model_copy(update={"distortion": BARREL}))
    assert np.abs(ahead[:2].T - rays).max() < 2e-3  # OpenCV ends its own iteration early
    assert lens.straight(pixels) == pytest.approx(rays, abs=1e-9)
    assert abs(pixels[3, 0] - 160) < FOCAL_PX * 0.75 - 10  # a barrel draws the border inward


def test_lens_without_distortion_is_the_pinhole():
    lens = DistortedLens(MODEL, clean())
    assert lens.distorted(np.array([[0.5, -0.25]])) == pytest.approx(np.array([[255.0, 72.5]]))
    assert lens.straight(np.array([[255.0, 72.5]])) == pytest.approx(np.array([[0.5, -0.25]]))


def test_distorted_image_shows_a_point_where_the_lens_has_it():
    shutter = Shutter(MODEL, clean(distortion=BARREL))
    ray = np.array([[0.6, -0.4]])
    image = np.zeros((shutter.canvas.height_px, shutter.canvas.width_px, 3), np.uint8)
    u, v = (np.array([shutter.canvas.cx_px, shutter.canvas.cy_px]) + FOCAL_PX * ray[0]).tolist()
    image[int(v) - 2 : int(v) + 3, int(u) - 2 : int(u) + 3] = 255
    rows, columns = np.nonzero(shutter.exposed(image, 0.0)[..., 0] > 127)
    wanted = shutter.lens.distorted((np.array([[int(u) + 0.5, int(v) + 0.5]]) - [
        shutter.canvas.cx_px, shutter.canvas.cy_px]) / FOCAL_PX)[0]
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx(wanted, abs=0.6)


def test_distorted_image_has_no_empty_border():
    shutter = Shutter(MODEL, clean(distortion=BARREL, rolling_shutter_ms=25, motion_blur_ms=15))
    white = np.full((shutter.canvas.height_px, shutter.canvas.width_px, 3), 255, np.uint8)
    white[[0, -1]] = white[:, [0, -1]] = 0  # what is repeated beyond the border would be black
    for turn_rad_s in (-FASTEST_RAD_S, 0.0, FASTEST_RAD_S):
        assert shutter.exposed(white.copy(), turn_rad_s).min() > 0


@pytest.mark.parametrize("distortion", [
    (-0.9,), (-0.28, 0.0), (0.0, -0.5), (0.0, 0.0, 0.9, 0.9), (-1.0, -1.0, 0.0, 0.0, -1.0),
])
def test_distortion_that_folds_the_image_is_one_clear_line(distortion):
    with pytest.raises(ConfigError) as caught:
        Shutter(MODEL, clean(distortion=distortion))
    assert "look.distortion" in str(caught.value) and "nearer to 0" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_camera_channel_has_the_distortion_only_of_a_known_lens():
    known = published_model(MODEL, clean(distortion=BARREL, lens_known=True))
    unknown = published_model(MODEL, clean(distortion=BARREL))
    assert (known.distortion, known.calibrated) == (BARREL, True)
    assert (unknown.distortion, unknown.calibrated) == ((), False)
    assert published_model(MODEL, clean()) == MODEL


# --- shutter ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turn_rad_s", [-2.0, 0.5, 2.0])
def test_rolling_shutter_shears_a_vertical_edge_by_rate_times_row_time_times_focal_length(turn_rad_s):
    shutter = Shutter(MODEL, clean(rolling_shutter_ms=30))
    image = shutter.exposed(edge(shutter, across=True), turn_rad_s)[..., 0]
    row_s = 0.030 / 240
    top, middle, bottom = (edge_px(image[row]) for row in (0, 120, 239))
    assert bottom - top == pytest.approx(turn_rad_s * 239 * row_s * FOCAL_PX, abs=0.3)  # a left turn moves it right
    assert middle == pytest.approx(160, abs=0.3)


def test_rolling_shutter_moves_the_border_more_than_the_middle():
    shutter = Shutter(MODEL, clean(rolling_shutter_ms=30))
    image = np.zeros((shutter.canvas.height_px, shutter.canvas.width_px, 3), np.uint8)
    x = 0.7
    image[:, int(shutter.canvas.cx_px + x * FOCAL_PX) :] = 255
    drawn = shutter.exposed(image, 2.0)[..., 0]
    moved_px = edge_px(drawn[230]) - edge_px(drawn[10])
    assert moved_px == pytest.approx(2.0 * 0.030 * 220 / 240 * FOCAL_PX * (1 + x * x), rel=0.05)


@pytest.mark.parametrize("turn_rad_s", [-1.5, 1.5])
def test_motion_blur_widens_an_edge_in_the_direction_of_motion_only(turn_rad_s):
    shutter = Shutter(MODEL, clean(motion_blur_ms=20))
    across = shutter.exposed(edge(shutter, across=True), turn_rad_s)[120, :, 0].astype(int)
    width_px = np.count_nonzero((across > 5) & (across < 250))
    assert width_px == pytest.approx(abs(turn_rad_s) * 0.020 * FOCAL_PX, abs=1.5)
    assert edge_px(across) == pytest.approx(160, abs=0.3)
    down = shutter.exposed(edge(shutter, across=False), turn_rad_s)[:, 160, 0].astype(int)
    assert np.count_nonzero((down > 5) & (down < 250)) <= 2


def test_camera_that_does_not_turn_has_no_blur_and_no_shear():
    shutter = Shutter(MODEL, clean(rolling_shutter_ms=30, motion_blur_ms=20))
    image = shutter.exposed(edge(shutter, across=True), 0.0)
    assert set(np.unique(image)) == {0, 255}
    assert np.array_equal(image, np.broadcast_to(image[:1], image.shape))


def test_label_moves_with_the_rows_of_the_image():
    shutter = Shutter(MODEL, clean(distortion=BARREL, rolling_shutter_ms=30))
    canvas = shutter.canvas
    for u, v in ((60, 20), (250, 215)):
        image = np.zeros((canvas.height_px, canvas.width_px, 3), np.uint8)
        at = np.array([canvas.cx_px - 160 + u, canvas.cy_px - 120 + v])
        image[int(at[1]) - 1 : int(at[1]) + 1, int(at[0]) - 1 : int(at[0]) + 1] = 255
        weights = shutter.exposed(image, 2.0)[..., 0].astype(float)
        rows, columns = np.mgrid[0:240, 0:320] + 0.5
        shown = (np.array([columns, rows]) * weights).sum(axis=(1, 2)) / weights.sum()
        ahead = np.array([[*(np.rint(at) - [canvas.cx_px, canvas.cy_px]) / FOCAL_PX, 1.0]])
        assert shutter.pixels(3 * ahead, 2.0)[0] == pytest.approx(shown, abs=0.3)


def test_shutter_without_options_changes_nothing():
    shutter, image = Shutter(MODEL, look_named("plain")), np.zeros((240, 320, 3), np.uint8)
    assert shutter.canvas == MODEL
    assert shutter.exposed(image, 2.0) is image


# --- exposure and white balance -------------------------------------------------------------------------------------


def seen(look: Look, t_s: float, seed: int = 3) -> np.ndarray:
    """Return the mean red, green and blue of a gray image at a time."""
    jpeg = Defects(look, 320, 240, seed).jpeg(np.full((240, 320, 3), 100, np.uint8), t_us=round(t_s * 1e6))
    return simplejpeg.decode_jpeg(jpeg, "RGB").astype(float).mean(axis=(0, 1))


def test_exposure_drifts_with_its_period_by_its_share():
    look = clean(exposure_drift=0.5, exposure_period_s=6.0)
    means = np.array([seen(look, t_s).mean() for t_s in np.arange(0, 6, 0.25)])
    assert means.max() == pytest.approx(150, abs=2) and means.min() == pytest.approx(100 / 1.5, abs=2)
    assert np.count_nonzero(np.diff(np.sign(means - 100))) == 2  # one swing in one period
    for t_s in (0.7, 2.9):
        assert seen(look, t_s) == pytest.approx(seen(look, t_s + 6.0), abs=0.6)


def test_white_balance_drifts_red_against_blue():
    look = clean(white_balance_drift=0.3, white_balance_period_s=10.0)
    colors = np.array([seen(look, t_s) for t_s in np.arange(0, 10, 0.5)])
    assert colors[:, 0].max() == pytest.approx(130, abs=3) and colors[:, 0].min() == pytest.approx(100 / 1.3, abs=3)
    assert np.corrcoef(colors[:, 0], colors[:, 2])[0, 1] < -0.95
    assert np.ptp(colors[:, 1]) < 2


def test_drift_begins_at_a_phase_of_the_seed():
    look = clean(exposure_drift=0.5)
    assert len({round(float(seen(look, 0.0, seed).mean())) for seed in range(6)}) >= 4
    assert [drift(0.5, 8.0, 0.25, 8_000_000 * share // 4) for share in range(4)] == pytest.approx([1.5, 1, 1 / 1.5, 1])


def test_same_seed_gives_the_same_bytes_and_another_seed_others():
    def images(seed: int) -> list[bytes]:
        look = look_named("real")
        shutter, defects = Shutter(MODEL, look), Defects(look, 320, 240, seed)
        return [
            defects.jpeg(shutter.exposed(edge(shutter, across=True), math.sin(t)), t_us=t * 33_333) for t in range(4)
        ]

    assert images(7) == images(7)
    assert images(7) != images(8)
