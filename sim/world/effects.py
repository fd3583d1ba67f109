"""The camera between a drawn scene and its JPEG: lens, shutter, exposure, noise. Pure (NumPy, OpenCV).

Each effect depends on the image, the look, the seed and the time alone, so the same run gives the same bytes.

The shutter knows one motion: the camera turns about the vertical axis at a constant rate during one image. Row r is
exposed around (r / rows - 1/2) x `rolling_shutter_ms` after the image's time, for `motion_blur_ms`. A turn by a small
angle moves a point of the image at (x, y), in focal lengths from the center, by (1 + x^2, x y) focal lengths per
radian. The scene is drawn once, then moved. Driving straight and moving objects add less than 2 px and are left out.
"""

import math

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import CameraModel
from sightline.robot_side.ports import scaled_quality, scaled_size
from sightline.sim.scenario import Look

Picture = npt.NDArray[np.uint8]
Matrix = npt.NDArray[np.float64]
Plane = npt.NDArray[np.float32]

NOISE_MARGIN_PX = 64
FASTEST_RAD_S = 3.0
"""Turn rate up to which the drawn image is wide enough for the shutter; beyond it, the border is repeated."""
MOST_EXPOSURES = 8
"""Moved images that are averaged as motion blur."""
WIDEST = 2.0
"""Largest drawn image, in sides of the delivered one."""
_FIT_PX = 0.01
_ROUNDS = 60  # each at least halves the error of a lens with up to 25 % distortion at the border


class DistortedLens:
    """A pinhole model with the distortion of a look, after Brown and Conrady, as OpenCV has it."""

    def __init__(self, model: CameraModel, look: Look) -> None:
        """Set up the lens. `model` is the pinhole. Raises ConfigError for a distortion that folds the image."""
        self._focal_px = np.array([model.fx_px, model.fy_px])
        self._middle_px = np.array([model.cx_px, model.cy_px])
        self.is_distorted = any(look.distortion)
        k1, k2, p1, p2, k3 = look.distortion + (0.0,) * (5 - len(look.distortion))
        self._radial, self._tangential = (k1, k2, k3), (p1, p2)
        self._check(model, look)

    def _check(self, model: CameraModel, look: Look) -> None:
        """Convert the border there and back. A strong distortion folds it, so that no inverse exists."""
        border = _border(model)
        there = self.straight(border)
        is_back = np.abs(self.distorted(there) - border).max() < _FIT_PX  # False for nan, too
        wide = np.abs(there * self._focal_px).max(axis=0) / self._middle_px
        if not is_back or wide.max() > WIDEST:
            raise ConfigError(
                f"look.distortion {list(look.distortion)}: it folds the {model.width_px}x{model.height_px} image at "
                "its border; write numbers nearer to 0"
            )

    def _bent(self, rays: Matrix) -> Matrix:
        """Distort rays (N, 2)."""
        x, y = rays.T
        square, (p1, p2) = x * x + y * y, self._tangential
        radial = 1 + square * (self._radial[0] + square * (self._radial[1] + square * self._radial[2]))
        return np.column_stack([
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        ])

    def straight(self, points_px: Matrix) -> Matrix:
        """Convert pixels (N, 2) of the delivered image to rays: right and down at 1 m ahead."""
        bent = np.asarray((points_px - self._middle_px) / self._focal_px)
        rays = bent
        if self.is_distorted:
            with np.errstate(over="ignore", invalid="ignore"):  # of values that do not converge, which the check finds
                for _ in range(_ROUNDS):
                    rays = rays + (bent - self._bent(rays))
        return rays

    def distorted(self, rays: Matrix) -> Matrix:
        """Convert rays (N, 2) to pixels of the delivered image."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(self._bent(rays) * self._focal_px + self._middle_px)


def _border(model: CameraModel) -> Matrix:
    """Return points along the four sides of the image, px."""
    across, down = (np.linspace(0, side, 33) for side in (model.width_px, model.height_px))
    return np.concatenate([
        np.column_stack([across, np.full(33, at)]) for at in (0.0, model.height_px)
    ] + [np.column_stack([np.full(33, at), down]) for at in (0.0, model.width_px)])


def published_model(model: CameraModel, look: Look) -> CameraModel:
    """Return the model for the channel `camera`: calibrated if the look has no distortion or it is known."""
    if not any(look.distortion):
        return model
    if look.lens_known:
        return model.model_copy(update={"distortion": look.distortion})
    return model.model_copy(update={"calibrated": False})


class Shutter:
    """Lens distortion, rolling shutter and motion blur, from an image that is drawn without them."""

    def __init__(self, model: CameraModel, look: Look) -> None:
        """Set up the effects. `model`: pinhole of the delivered image. Raises ConfigError if a distortion folds it."""
        self.model = model
        self.lens = DistortedLens(model, look)
        self._readout_s, self._exposure_s = look.rolling_shutter_ms / 1000, look.motion_blur_ms / 1000
        self._is_ideal = not (self.lens.is_distorted or self._readout_s or self._exposure_s)
        self.canvas = model if self._is_ideal else self._canvas(model)
        """Pinhole model of the image to draw: larger, because the effects use pixels beyond the border."""
        if not self._is_ideal:
            self._prepare(model)

    def _canvas(self, model: CameraModel) -> CameraModel:
        rays = np.abs(self.lens.straight(_border(model))).max(axis=0)
        turn_rad = FASTEST_RAD_S * (self._readout_s + self._exposure_s) / 2
        right, down = rays[0] + turn_rad * (1 + rays[0] ** 2), rays[1] + turn_rad * rays[0] * rays[1]
        width_px, height_px = 2 * math.ceil(model.fx_px * right), 2 * math.ceil(model.fy_px * down)
        return model.model_copy(update={
            "width_px": width_px, "height_px": height_px, "cx_px": width_px / 2, "cy_px": height_px / 2,
        })

    def _prepare(self, model: CameraModel) -> None:
        """Compute for each pixel its source in the drawn image, how a turn moves it, and when its row is exposed."""
        rows, columns = np.mgrid[0 : model.height_px, 0 : model.width_px] + 0.5
        rays = self.lens.straight(np.column_stack([columns.ravel(), rows.ravel()]))
        x, y = (part.reshape(rows.shape) for part in rays.T)
        focal = (self.canvas.fx_px, self.canvas.fy_px)
        self._from: tuple[Plane, Plane] = (
            (self.canvas.cx_px - 0.5 + focal[0] * x).astype(np.float32),
            (self.canvas.cy_px - 0.5 + focal[1] * y).astype(np.float32),
        )
        self._per_rad: tuple[Plane, Plane] = (
            (-focal[0] * (1 + x * x)).astype(np.float32), (-focal[1] * x * y).astype(np.float32),
        )
        self._fastest_px = float(np.abs(self._per_rad[0]).max())
        self._rows_s = ((rows[:, :1] / model.height_px - 0.5) * self._readout_s).astype(np.float32)
        self._moved: tuple[Plane, Plane] = (np.empty(x.shape, np.float32), np.empty(x.shape, np.float32))
        self._sum = np.empty((*x.shape, 3), np.float32)
        self._picture = np.empty((*x.shape, 3), np.uint8)

    def pixels(self, ahead: Matrix, turn_rad_s: float) -> Matrix:
        """Return where the delivered image shows points (N, 3): right, down, ahead of the lens, at the image's time."""
        model = self.model
        focal, middle = np.array([model.fx_px, model.fy_px]), np.array([model.cx_px, model.cy_px])
        if self._is_ideal:
            return np.asarray(middle + focal * ahead[:, :2] / ahead[:, 2:])
        widest = WIDEST * middle / focal  # beyond it, the lens formula is invalid
        rays = np.clip(ahead[:, :2] / ahead[:, 2:], -widest, widest)
        rows = self.lens.distorted(rays)[:, 1]
        turned_rad = turn_rad_s * self._readout_s * (np.clip(rows / model.height_px, 0, 1) - 0.5)
        x, y = rays.T
        moved = rays + turned_rad[:, None] * np.column_stack([1 + x * x, x * y])
        return self.lens.distorted(moved)

    def exposed(self, drawn: Picture, turn_rad_s: float) -> Picture:
        """Return the delivered image; valid until the next call.

        Args:
            drawn: image of `canvas`.
            turn_rad_s: rate at which the camera turns, rad/s, left positive.
        """
        if self._is_ideal:
            return drawn
        blur_px = abs(turn_rad_s) * self._exposure_s * self._fastest_px
        count = min(MOST_EXPOSURES, max(1, math.ceil(blur_px)))
        if count == 1:
            return self._moment(drawn, turn_rad_s, 0.0)
        self._sum.fill(0)
        for number in range(count):
            after_s = ((number + 0.5) / count - 0.5) * self._exposure_s
            cv2.accumulate(self._moment(drawn, turn_rad_s, after_s), self._sum)
        return np.asarray(cv2.convertScaleAbs(self._sum, self._picture, 1 / count), np.uint8)

    def _moment(self, drawn: Picture, turn_rad_s: float, after_s: float) -> Picture:
        """Return the image of rows that are exposed for no time, `after_s` after the middle of their exposure."""
        sources = self._from
        if turn_rad_s and (self._readout_s or after_s):
            turned_rad = np.float32(turn_rad_s) * (self._rows_s + np.float32(after_s))
            for source, per_rad, moved in zip(self._from, self._per_rad, self._moved, strict=True):
                np.multiply(per_rad, turned_rad, out=moved)
                np.add(moved, source, out=moved)
            sources = self._moved
        cv2.remap(drawn, *sources, cv2.INTER_LINEAR, self._picture, borderMode=cv2.BORDER_REPLICATE)
        return self._picture


def drift(part: float, period_s: float, phase: float, t_us: int) -> float:
    """Return a factor that swings between 1 / (1 + part) and 1 + part. `phase` is a share of the period."""
    return float((1.0 + part) ** math.sin(math.tau * (t_us / 1e6 / period_s + phase)))


def _fading(saturation: float) -> Matrix:
    """Return the matrix that moves red, green and blue toward their brightness, or away from it."""
    weights = np.array([0.299, 0.587, 0.114])  # of brightness, as JPEG has them
    return np.asarray(saturation * np.eye(3) + (1 - saturation) * weights)


class Defects:
    """Exposure, white balance, blur, noise and JPEG between a drawn scene and the delivered image."""

    def __init__(self, look: Look, width_px: int, height_px: int, seed: int) -> None:
        self._look = look
        self._draw = np.random.default_rng([seed, 5])
        self._phases: list[float] = np.random.default_rng([seed, 10]).random(2).tolist()
        self._size = (height_px, width_px)
        self._is_drifting = bool(look.exposure_drift or look.white_balance_drift)
        self._table = self._gains(0)
        self._fade = _fading(look.saturation) if look.saturation != 1.0 else None
        self._is_neutral = (
            look.exposure == 1.0 and look.white_balance == (1.0, 1.0, 1.0) and not self._is_drifting
        )
        pool = (height_px + NOISE_MARGIN_PX, width_px + NOISE_MARGIN_PX, 3)
        self._pool = np.rint(self._draw.normal(0.0, look.noise, pool)).astype(np.int16) if look.noise else None

    def _gains(self, t_us: int) -> Picture:
        """Return the value of each level of red, green and blue at `t_us`."""
        look = self._look
        bright = drift(look.exposure_drift, look.exposure_period_s, self._phases[0], t_us)
        warm = drift(look.white_balance_drift, look.white_balance_period_s, self._phases[1], t_us)
        steps = np.arange(256)[:, None] * look.exposure * np.array(look.white_balance)
        if self._is_drifting:
            steps = steps * (bright * np.array([warm, 1.0, 1.0 / warm]))
        return np.asarray(np.clip(np.rint(steps), 0, 255), np.uint8).reshape(1, 256, 3)

    def jpeg(self, picture: Picture, quality_percent: int = 100, scale_percent: int = 100, t_us: int = 0) -> bytes:
        """Return `picture` (RGB, changed in place) as the JPEG of the camera at `t_us` of the run."""
        look = self._look
        if self._fade is not None:
            cv2.transform(picture, self._fade, picture)
        if self._is_drifting:
            self._table = self._gains(t_us)
        if not self._is_neutral:
            cv2.LUT(picture, self._table, picture)
        if look.blur_px:
            cv2.GaussianBlur(picture, (0, 0), look.blur_px, picture)
        if self._pool is not None:
            cv2.add(picture, self._noise(self._pool), picture, dtype=cv2.CV_8U)
        quality = scaled_quality(look.jpeg_quality, quality_percent)
        return bytes(simplejpeg.encode_jpeg(self._scaled(picture, scale_percent), quality, "RGB", "420"))

    def _scaled(self, picture: Picture, scale_percent: int) -> Picture:
        if scale_percent == 100:
            return picture
        size = scaled_size(self._size[1], self._size[0], scale_percent)
        return np.asarray(cv2.resize(picture, (size.width_px, size.height_px), interpolation=cv2.INTER_AREA), np.uint8)

    def _noise(self, pool: npt.NDArray[np.int16]) -> npt.NDArray[np.int16]:
        """Return a random part of stored noise. New noise costs 20 times as much."""
        down, right = self._draw.integers(0, NOISE_MARGIN_PX, 2).tolist()
        return pool[down : down + self._size[0], right : right + self._size[1]]
