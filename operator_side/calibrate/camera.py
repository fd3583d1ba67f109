"""Fits a camera model to images of a chessboard or a ball from a folder, a camera or a robot. Shell (files, a link).

OpenCV counts pixels from the center of the top-left pixel, `CameraModel` from its corner, so half a pixel is added.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sightline.operator_side.client.pictures import FrameViewer
from sightline.protocol.channels import CAMERA, FRAME
from sightline.protocol.codec import decode
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.jpeg import JpegSize, read_jpeg_size
from sightline.protocol.messages import CameraModel
from sightline.protocol.transports.link import Link
from sightline.robot_side.hardware.cameras.files import jpegs_in
from sightline.robot_side.ports import Camera
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.decode import Decoder
from sightline.vision_side.detect.color.hsv import HsvDetector
from sightline.vision_side.detect.port import Detection
from sightline.vision_side.tracking.locate import locate_sphere

MIN_BOARDS = 5
MAX_RMS_PX = 1.0
MAX_FOCAL_SIGMA = 0.02
TILT_RAD, MIN_TILTED = math.radians(15), 3
"""If all boards face the camera, any focal length fits, even with a small standard deviation."""
MAX_BALL_SPREAD = 0.05
MAX_PIXELS = 4096 * 4096
_FOCAL_RANGE = (0.2, 8.0)  # focal length in image widths: 136 degrees to 7 degrees
_NEW_VIEW = 0.03  # average movement of the corners in image widths
_FLAGS = cv2.CALIB_FIX_K3  # k3 needs corners at every edge of the image; otherwise it distorts other parts


@dataclass(frozen=True, slots=True)
class Mounting:
    """The position of the lens on the robot, as in `CameraModel`."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    pitch_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard, by its number of inner corners (a board of 10 x 7 squares has 9 x 6)."""

    columns: int
    rows: int
    square_m: float

    def points_m(self) -> NDArray[np.float32]:
        """Return the corners on the board, row by row."""
        grid = [(column, row, 0.0) for row in range(self.rows) for column in range(self.columns)]
        return np.array(grid, np.float32) * self.square_m


@dataclass(frozen=True, slots=True)
class Calibration:
    """A model and its fit: `used` of `given` images, `error` in `error_unit`."""

    model: CameraModel
    used: int
    given: int
    error: float
    error_unit: str


Corners = NDArray[np.float32]


def find_board(jpeg: bytes, board: Board) -> Corners | None:
    """Find the board's inner corners (N, 1, 2) in OpenCV pixels. None unless the whole board is in the image."""
    try:
        size = read_jpeg_size(jpeg, MAX_PIXELS)
    except WireError:
        return None
    # The decoder of the vision service does not rotate images by their EXIF data either.
    gray = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if gray is None or gray.shape != (size.height_px, size.width_px):
        return None
    found, corners = cv2.findChessboardCornersSB(gray, (board.columns, board.rows), flags=cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners, np.float32) if found else None


def is_new_view(corners: Corners, earlier: Sequence[Corners], size: JpegSize) -> bool:
    """Return True if a board is far enough from its earlier positions to add information."""
    apart_px = _NEW_VIEW * size.width_px
    return all(float(np.abs(corners - one).mean()) >= apart_px for one in earlier)


def from_boards(
    found: Sequence[Corners], board: Board, size: JpegSize, given: int, mounting: Mounting, *, repeated: int = 0
) -> Calibration:
    """Fit focal length, center and distortion to `found`, the boards in `given` images of `size`.

    `repeated` images show a board in an earlier position. The size of the squares has no effect.

    Raises:
        ConfigError: too few boards or a poor fit; the error names the remedy.
    """
    if len(found) < MIN_BOARDS:
        raise ConfigError(_too_few(len(found), repeated, given, board))
    pixels = (size.width_px, size.height_px)
    rms_px, matrix, distortion, turns, _, sigma, *_ = cv2.calibrateCameraExtended(
        [board.points_m()] * len(found), list(found), pixels, np.eye(3), np.zeros(5), flags=_FLAGS
    )
    _check_fit(rms_px, float(sigma[0, 0]) / float(matrix[0, 0]), sum(_tilt_rad(one) >= TILT_RAD for one in turns))
    model = _model(size, matrix, [float(one) for one in distortion.ravel()[:4]], mounting)
    return Calibration(model, len(found), given, float(rms_px), "px RMS")


def _too_few(found: int, repeated: int, given: int, board: Board) -> str:
    what = f"a chessboard of {board.columns} x {board.rows} inner corners"
    if not found:
        return (
            f"no board in {given} images: they must show {what} completely, flat and evenly lit; "
            "set --board to the number of inner corners"
        )
    if repeated:
        return (f"{what} is in {found + repeated} of {given} images, {repeated} of them repeat an earlier position, at "
                f"least {MIN_BOARDS} different ones are necessary; move and tilt the board between images")
    return f"{what} is in {found} of {given} images, at least {MIN_BOARDS} are necessary; take more from other angles"


def _tilt_rad(turn: Any) -> float:
    """Return the tilt of a board with this rotation vector, relative to one that faces the camera."""
    return math.acos(min(1.0, abs(float(cv2.Rodrigues(turn)[0][2, 2]))))


def _check_fit(rms_px: float, focal_sigma: float, tilted: int) -> None:
    if not rms_px <= MAX_RMS_PX:
        raise ConfigError(f"the error of the fit is {rms_px:.2f} px RMS, at most {MAX_RMS_PX:g}; use a flat board and "
                          "sharp images of one camera at one zoom")
    if tilted < MIN_TILTED or not focal_sigma <= MAX_FOCAL_SIGMA:
        raise ConfigError(f"{tilted} boards have a tilt above 15 degrees, the focal length is known to "
                          f"{focal_sigma:.1%}; take images with the board tilted by 20 to 40 degrees, both ways, and "
                          "in the corners")


def _model(size: JpegSize, matrix: Any, distortion: Sequence[float], mounting: Mounting) -> CameraModel:
    return CameraModel(
        width_px=size.width_px,
        height_px=size.height_px,
        fx_px=round(float(matrix[0][0]), 3),
        fy_px=round(float(matrix[1][1]), 3),
        cx_px=round(float(matrix[0][2]) + 0.5, 3),
        cy_px=round(float(matrix[1][2]) + 0.5, 3),
        distortion=tuple(round(one, 6) for one in distortion),
        x_m=mounting.x_m,
        y_m=mounting.y_m,
        z_m=mounting.z_m,
        pitch_rad=mounting.pitch_rad,
        calibrated=True,
    )


# --- a ball ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Ball:
    """A ball of the target's color; `distance_m` is along the floor, from below the lens to below its center."""

    radius_m: float
    distance_m: float


def ball_finder(size: JpegSize, hsv: HsvConfig) -> Callable[[bytes], Detection | None]:
    """Make a function that returns the largest ball in a JPEG of `size`, or None."""
    decoder, detector = Decoder(size.width_px, size.height_px, MAX_PIXELS), HsvDetector(hsv)

    def find(jpeg: bytes) -> Detection | None:
        try:
            return next(iter(detector.detect(decoder.decode(jpeg))), None)
        except WireError:
            return None

    return find


def from_balls(
    found: Sequence[Detection], ball: Ball, size: JpegSize, given: int, mounting: Mounting
) -> Calibration:
    """Fit the focal length to `found`. The center is that of the image, and there is no distortion.

    Raises:
        ConfigError: no ball, or the images disagree; the error names the remedy.
    """
    each_px = [focal for one in found if (focal := _focal_px(one, ball, size, mounting)) is not None]
    if not each_px:
        raise ConfigError(
            f"no ball in {given} images fits a distance of {ball.distance_m:g} m; check its color (hsv.ranges in "
            "--config), --ball-radius-m and --distance-m"
        )
    focal_px = statistics.median(each_px)
    spread = max(abs(one - focal_px) for one in each_px) / focal_px
    if spread > MAX_BALL_SPREAD:
        raise ConfigError(f"the focal length differs by {spread:.0%} between images; keep ball and camera still")
    matrix = [[focal_px, 0, size.width_px / 2 - 0.5], [0, focal_px, size.height_px / 2 - 0.5]]
    return Calibration(_model(size, matrix, (), mounting), len(each_px), given, 100 * spread, "% spread")


def _focal_px(detection: Detection, ball: Ball, size: JpegSize, mounting: Mounting) -> float | None:
    """Find the focal length by bisection: with a longer lens, the same outline belongs to a ball further away."""
    low, high = (size.width_px * factor for factor in _FOCAL_RANGE)
    if not _away_m(detection, ball, size, mounting, low) < ball.distance_m < _away_m(
        detection, ball, size, mounting, high
    ):
        return None
    for _ in range(40):
        center = (low + high) / 2
        if _away_m(detection, ball, size, mounting, center) < ball.distance_m:
            low = center
        else:
            high = center
    return (low + high) / 2


def _away_m(detection: Detection, ball: Ball, size: JpegSize, mounting: Mounting, focal_px: float) -> float:
    """Return the distance of the ball along the floor for this focal length; nan if impossible."""
    matrix = [[focal_px, 0, size.width_px / 2 - 0.5], [0, focal_px, size.height_px / 2 - 0.5]]
    sighting = locate_sphere(detection, _model(size, matrix, (), mounting), ball.radius_m)
    return math.hypot(sighting.x_m - mounting.x_m, sighting.y_m - mounting.y_m) if sighting else math.nan


# --- images from a folder, a camera of this machine, or a robot --------------------------------------------------


ROLE = "calibrate"
_WAIT_S = 0.2
_SILENCE_S = 5.0
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Collected(Generic[Found]):
    """The results in `given` images of one size. `repeated` images gave no new result, `skipped` ones were unusable."""

    size: JpegSize
    found: list[Found]
    given: int
    skipped: int
    repeated: int = 0


def folder_pictures(folder: Path) -> Iterator[bytes]:
    """Yield the JPEGs of `folder` in name order.

    Raises HardwareError without a JPEG, and ConfigError for a JPEG that is unreadable, damaged or of another size.
    """
    first: JpegSize | None = None
    for path in jpegs_in(folder):
        try:
            jpeg = path.read_bytes()
            first = _size_of(jpeg, first, may_grow=False)
        except OSError as error:
            raise ConfigError(f"cannot read {path}: {error.strerror}; remove it or make it readable") from None
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
        yield jpeg


def camera_pictures(camera: Camera, seconds: float) -> Iterator[bytes]:
    """Yield the images of a local camera for `seconds`. Raises HardwareError as the camera does."""
    ends_s = time.monotonic() + seconds
    while time.monotonic() < ends_s:
        picture = camera.read(_WAIT_S)
        if picture is not None:
            yield picture.jpeg


def robot_pictures(link: Link, seconds: float, role: str = ROLE, secure: str = "") -> Iterator[bytes]:
    """Yield a robot's images for `seconds`. If the keys permit it, acknowledge them, so that the robot sends more.

    Raises:
        LinkError: no frame for five seconds.
    """
    frames, viewer = link.latest(FRAME), FrameViewer(link, role, secure)
    received_s = time.monotonic()
    ends_s = received_s + seconds
    while time.monotonic() < ends_s:
        message = frames.take(_WAIT_S)
        if message is not None and viewer.acknowledge(message):
            received_s = time.monotonic()
            yield message.payload
        if time.monotonic() - received_s > _SILENCE_S:
            raise LinkError(f"no frames from robot '{link.robot}' after {_SILENCE_S:g} s; check its id and camera with "
                            "`sightline status`")


def robot_model(link: Link, timeout_s: float = 3.0) -> CameraModel:
    """Return the model that a robot publishes. Raises LinkError without a model."""
    message = link.latest(CAMERA).take(timeout_s)
    try:
        if message is not None:
            return decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
    except WireError as error:
        raise LinkError(f"robot '{link.robot}' uses another protocol version: {error.detail}") from None
    raise LinkError(f"no camera model from robot '{link.robot}' after {timeout_s:g} s; run `sightline robots`")


def collect(
    pictures: Iterator[bytes],
    finder: Callable[[JpegSize], Callable[[bytes], Found | None]],
    is_new: Callable[[Found, Sequence[Found], JpegSize], bool],
    enough: int,
    report: Callable[[str], None],
    *,
    is_live: bool = False,
) -> Collected[Found]:
    """Search `pictures` until `enough` new results, or to their end. Report each result. Ctrl-C ends live images.

    Args:
        finder: returns, for an image size, the function that searches one image.
        is_live: skip damaged images, and images that flow control has scaled; start again with the first larger image.

    Raises:
        ConfigError: there is no image, or an image is damaged or of another size and `is_live` is False.
    """
    found: list[Found] = []
    size, given, skipped, repeated = None, 0, 0, 0
    try:
        for jpeg in pictures:
            own = _live_size(jpeg, size) if is_live else _size_of(jpeg, size, may_grow=False)
            if own is None:
                skipped += 1
                continue
            if size is None or own.width_px > size.width_px:
                found.clear()  # first, because an interrupted search must not keep views of another size
                size, find, given, skipped, repeated = own, finder(own), 0, skipped + given, 0
            given += 1
            one = find(jpeg)
            if one is not None and not is_new(one, found, size):
                repeated += 1
            elif one is not None:
                found.append(one)
                report(f"{len(found)} of {enough}")
            if len(found) >= enough:
                break
    except KeyboardInterrupt:
        if not found or not is_live:
            raise
    if size is None:
        raise ConfigError("no image from the camera; run `sightline doctor --camera v4l2`")
    return Collected(size, found, given, skipped, repeated)


def _live_size(jpeg: bytes, size: JpegSize | None) -> JpegSize | None:
    """Return the size of a live image, or None for one that is not usable."""
    try:
        return _size_of(jpeg, size, may_grow=True)
    except ConfigError:
        return None


def _size_of(jpeg: bytes, size: JpegSize | None, *, may_grow: bool) -> JpegSize:
    try:
        own = read_jpeg_size(jpeg, MAX_PIXELS)
    except WireError as error:
        raise ConfigError(f"invalid JPEG: {error.detail}; remove or convert it") from None
    if size is None or (may_grow and own.width_px > size.width_px):
        return own
    if (own.width_px, own.height_px) != (size.width_px, size.height_px):
        raise ConfigError(f"images of {own.width_px}x{own.height_px} and {size.width_px}x{size.height_px} are mixed; "
                          "use images of one size")
    return own
