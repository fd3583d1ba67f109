"""A camera's model from pictures of a chessboard or a ball, and where the pictures come from. Shell (files, a link).

OpenCV counts pixels from the middle of the top-left one, `CameraModel` from its corner: half a pixel is added.
"""

import itertools
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
"""Boards that all face the camera fit any focal length, even with a small standard deviation."""
MAX_BALL_SPREAD = 0.05
MAX_PIXELS = 4096 * 4096
_FOCAL_RANGE = (0.2, 8.0)  # focal length in picture widths: 136 degrees to 7 degrees
_NEW_VIEW = 0.03  # corners moved by this part of the picture's width, on average
_FLAGS = cv2.CALIB_FIX_K3  # k3 needs corners in every edge of the picture; without them it bends what it never saw


@dataclass(frozen=True, slots=True)
class Mounting:
    """Where the lens is on the robot, as `CameraModel` says it."""

    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    pitch_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard, counted in inner corners (a board of 10 x 7 squares has 9 x 6)."""

    columns: int
    rows: int
    square_m: float

    def points_m(self) -> NDArray[np.float32]:
        """The corners on the board, row by row."""
        grid = [(column, row, 0.0) for row in range(self.rows) for column in range(self.columns)]
        return np.array(grid, np.float32) * self.square_m


@dataclass(frozen=True, slots=True)
class Calibration:
    """A model and how well it fits: `used` of `given` pictures, `error` in `error_unit`."""

    model: CameraModel
    used: int
    given: int
    error: float
    error_unit: str


Corners = NDArray[np.float32]


def find_board(jpeg: bytes, board: Board) -> Corners | None:
    """The board's inner corners (N, 1, 2) in OpenCV's pixels; None if the whole board is not in the picture."""
    try:
        read_jpeg_size(jpeg, MAX_PIXELS)
    except WireError:
        return None
    grey = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    if grey is None:
        return None
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=cv2.CALIB_CB_ACCURACY)
    return np.asarray(corners, np.float32) if found else None


def is_new_view(corners: Corners, earlier: Sequence[Corners], size: JpegSize) -> bool:
    """Whether a board is so far from where it was seen before that it says something new."""
    apart_px = _NEW_VIEW * size.width_px
    return all(float(np.abs(corners - one).mean()) >= apart_px for one in earlier)


def from_boards(
    found: Sequence[Corners], board: Board, size: JpegSize, given: int, mounting: Mounting
) -> Calibration:
    """Focal length, centre and distortion from `found`, the boards seen in `given` pictures of `size`.

    Raises ConfigError with what to do when there are too few, or the fit is poor.
    """
    if len(found) < MIN_BOARDS:
        raise ConfigError(_too_few(len(found), given, board))
    pixels = (size.width_px, size.height_px)
    rms_px, matrix, distortion, turns, _, sigma, *_ = cv2.calibrateCameraExtended(
        [board.points_m()] * len(found), list(found), pixels, np.eye(3), np.zeros(5), flags=_FLAGS
    )
    _check_fit(rms_px, float(sigma[0, 0]) / float(matrix[0, 0]), sum(_tilt_rad(one) >= TILT_RAD for one in turns))
    model = _model(size, matrix, [float(one) for one in distortion.ravel()[:4]], mounting)
    return Calibration(model, len(found), given, float(rms_px), "px RMS")


def _too_few(found: int, given: int, board: Board) -> str:
    what = f"a chessboard of {board.columns} x {board.rows} inner corners"
    if not found:
        return (
            f"no board found in {given} pictures: {what} must be whole in them, flat and evenly lit; "
            "--board says how many inner corners yours has"
        )
    return f"{what} is in {found} of {given} pictures, at least {MIN_BOARDS} are needed; take more from other angles"


def _tilt_rad(turn: Any) -> float:
    """How far a board of this rotation vector is turned away from facing the camera."""
    return math.acos(min(1.0, abs(float(cv2.Rodrigues(turn)[0][2, 2]))))


def _check_fit(rms_px: float, focal_sigma: float, tilted: int) -> None:
    if not rms_px <= MAX_RMS_PX:
        raise ConfigError(f"the fit is off by {rms_px:.2f} px RMS, at most {MAX_RMS_PX:g}: is the board flat, are the "
                          "pictures sharp and all of one camera at one zoom?")
    if tilted < MIN_TILTED or not focal_sigma <= MAX_FOCAL_SIGMA:
        raise ConfigError(f"{tilted} boards were tilted by more than 15 degrees, the focal length is known to "
                          f"{focal_sigma:.1%}: take pictures with the board tilted by 20 to 40 degrees, both ways, and "
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
    """A ball of the target's colour; `distance_m` is over the floor, from below the lens to below its centre."""

    radius_m: float
    distance_m: float


def ball_finder(size: JpegSize, hsv: HsvConfig) -> Callable[[bytes], Detection | None]:
    """A function that gives the largest ball in a JPEG of `size`, None if there is none."""
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
    """The focal length at which `found` are `ball`; the centre is taken to be the picture's, distortion none.

    Raises ConfigError with what to do when no ball is found or the pictures disagree.
    """
    each_px = [focal for one in found if (focal := _focal_px(one, ball, size, mounting)) is not None]
    if not each_px:
        raise ConfigError(
            f"no ball found in {given} pictures that could be {ball.distance_m:g} m away; check its colour (hsv.ranges "
            "in --config), --ball-radius-m and --distance-m"
        )
    focal_px = statistics.median(each_px)
    spread = max(abs(one - focal_px) for one in each_px) / focal_px
    if spread > MAX_BALL_SPREAD:
        raise ConfigError(f"the focal length differs by {spread:.0%} between pictures; keep ball and camera still")
    matrix = [[focal_px, 0, size.width_px / 2 - 0.5], [0, focal_px, size.height_px / 2 - 0.5]]
    return Calibration(_model(size, matrix, (), mounting), len(each_px), given, 100 * spread, "% spread")


def _focal_px(detection: Detection, ball: Ball, size: JpegSize, mounting: Mounting) -> float | None:
    """By bisection: a longer lens makes the same outline a ball further away."""
    low, high = (size.width_px * factor for factor in _FOCAL_RANGE)
    if not _away_m(detection, ball, size, mounting, low) < ball.distance_m < _away_m(
        detection, ball, size, mounting, high
    ):
        return None
    for _ in range(40):
        middle = (low + high) / 2
        if _away_m(detection, ball, size, mounting, middle) < ball.distance_m:
            low = middle
        else:
            high = middle
    return (low + high) / 2


def _away_m(detection: Detection, ball: Ball, size: JpegSize, mounting: Mounting, focal_px: float) -> float:
    """How far over the floor the ball would be with this lens; nan if it would be none."""
    matrix = [[focal_px, 0, size.width_px / 2 - 0.5], [0, focal_px, size.height_px / 2 - 0.5]]
    sighting = locate_sphere(detection, _model(size, matrix, (), mounting), ball.radius_m)
    return math.hypot(sighting.x_m - mounting.x_m, sighting.y_m - mounting.y_m) if sighting else math.nan


# Where pictures for a calibration come from: a folder, a camera of this machine, a robot. Shell (waits, files).


ROLE = "calibrate"
_WAIT_S = 0.2
_SILENCE_S = 5.0
_MAX_PIXELS = 4096 * 4096
Found = TypeVar("Found")


@dataclass(frozen=True, slots=True)
class Collected(Generic[Found]):
    """What was found in `given` pictures of one size."""

    size: JpegSize
    found: list[Found]
    given: int


def folder_pictures(folder: Path) -> Iterator[bytes]:
    """The JPEGs of `folder` in name order. Raises HardwareError if there is none."""
    for path in jpegs_in(folder):
        yield path.read_bytes()


def camera_pictures(camera: Camera, seconds: float) -> Iterator[bytes]:
    """What a local camera sees for `seconds`. Raises HardwareError as the camera does."""
    ends_s = time.monotonic() + seconds
    while time.monotonic() < ends_s:
        picture = camera.read(_WAIT_S)
        if picture is not None:
            yield picture.jpeg


def robot_pictures(link: Link, seconds: float, role: str = ROLE, secure: str = "") -> Iterator[bytes]:
    """What a robot's camera sees for `seconds`; frames are acknowledged by who may, so that it goes on sending.

    Raises LinkError when no frame comes for five seconds.
    """
    frames, viewer = link.latest(FRAME), FrameViewer(link, role, secure)
    heard_s = time.monotonic()
    ends_s = heard_s + seconds
    while time.monotonic() < ends_s:
        message = frames.take(_WAIT_S)
        if message is not None and viewer.acknowledge(message):
            heard_s = time.monotonic()
            yield message.payload
        if time.monotonic() - heard_s > _SILENCE_S:
            raise LinkError(f"no frames from robot {link.robot!r} within {_SILENCE_S:g} s; is `sightline robot` "
                            "running there, with this id, and its camera working?")


def robot_model(link: Link, timeout_s: float = 3.0) -> CameraModel:
    """The model that a robot publishes now. Raises LinkError when none comes."""
    message = link.latest(CAMERA).take(timeout_s)
    try:
        if message is not None:
            return decode(CameraModel, message.payload, CAMERA.max_payload_bytes)
    except WireError as error:
        raise LinkError(f"robot {link.robot!r} speaks another version: {error.detail}") from None
    raise LinkError(f"robot {link.robot!r} is not heard within {timeout_s:g} s; `sightline robots` lists who is")


def collect(
    pictures: Iterator[bytes],
    finder: Callable[[JpegSize], Callable[[bytes], Found | None]],
    is_new: Callable[[Found, Sequence[Found], JpegSize], bool],
    enough: int,
    say: Callable[[str], None],
) -> Collected[Found]:
    """Look through `pictures` until `enough` were found that are new, or there are no more; `say` each.

    `finder` makes, for a size, the function that looks at one picture.
    Raises ConfigError when there is no picture at all, or their sizes differ.
    """
    first = next(pictures, None)
    if first is None:
        raise ConfigError("no picture came; is the camera working?")
    size = _size_of(first, None)
    find = finder(size)
    found: list[Found] = []
    given = 0
    for jpeg in itertools.chain([first], pictures):
        _size_of(jpeg, size)
        given += 1
        one = find(jpeg)
        if one is not None and is_new(one, found, size):
            found.append(one)
            say(f"{len(found)} of {enough}")
        if len(found) >= enough:
            break
    return Collected(size, found, given)


def _size_of(jpeg: bytes, size: JpegSize | None) -> JpegSize:
    try:
        own = read_jpeg_size(jpeg, _MAX_PIXELS)
    except WireError as error:
        raise ConfigError(f"a picture is no plain JPEG: {error.detail}; remove or convert it") from None
    if size is not None and (own.width_px, own.height_px) != (size.width_px, size.height_px):
        raise ConfigError(f"pictures of {own.width_px}x{own.height_px} and {size.width_px}x{size.height_px} are mixed; "
                          "a camera is calibrated at one size")
    return own
