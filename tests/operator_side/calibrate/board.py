"""Draws a chessboard as a known camera sees it, lens distortion included, to compare a calibration with the truth."""

import math
from functools import cache

import cv2
import numpy as np

from sightline.operator_side.calibrate.camera import Board
from sightline.protocol.messages import CameraModel
from tests.fixtures.vision.vision import jpeg_of

BOARD = Board(7, 5, 0.03)
TRUTH = CameraModel(width_px=480, height_px=360, fx_px=402.0, fy_px=405.0, cx_px=247.0, cy_px=176.0,
                    distortion=(-0.12, 0.03, 0.001, -0.001), calibrated=True)
_FINE = 3  # samples per pixel, each way


@cache
def rays(model: CameraModel) -> np.ndarray:
    """(x, y) at depth 1 of every sample, rows by columns."""
    rows, columns = np.mgrid[0 : model.height_px * _FINE, 0 : model.width_px * _FINE]
    pixels = np.stack([(columns + 0.5) / _FINE, (rows + 0.5) / _FINE], -1).reshape(-1, 1, 2)
    matrix = np.array([[model.fx_px, 0, model.cx_px], [0, model.fy_px, model.cy_px], [0, 0, 1]])
    return cv2.undistortPoints(pixels, matrix, np.array(model.distortion or (0.0,) * 4)).reshape(*rows.shape, 2)


def draw_board(seen: np.ndarray, rotation: np.ndarray, centre_m: np.ndarray, board: Board = BOARD) -> bytes:
    """JPEG of the board, its middle at `centre_m`, turned by `rotation`; `seen` are the camera's `rays`."""
    x, y = (np.ascontiguousarray(seen[..., axis], np.float32) for axis in (0, 1))
    across, down, away = (x * a + y * b + c for a, b, c in rotation.T.astype(np.float32).tolist())
    at_m = (centre_m @ rotation).tolist()
    depth = at_m[2] / away
    column, row = ((each * depth - at) / board.square_m + (count - 1) / 2
                   for each, at, count in ((across, at_m[0], board.columns), (down, at_m[1], board.rows)))
    inside = (column > -1) & (column < board.columns) & (row > -1) & (row < board.rows)
    black = inside & ((np.floor(column) + np.floor(row)).astype(np.int16) % 2 == 0)
    grey = np.full(black.shape, 110, np.uint8)
    grey[inside | _margin(column, row, board)] = 230
    grey[black] = 25
    small = cv2.resize(grey, None, fx=1 / _FINE, fy=1 / _FINE, interpolation=cv2.INTER_AREA)
    return jpeg_of(np.repeat(small[..., None], 3, axis=2), 92)


def _margin(column: np.ndarray, row: np.ndarray, board: Board) -> np.ndarray:
    return (column > -2) & (column < board.columns + 1) & (row > -2) & (row < board.rows + 1)


def turned(about_x_deg: float, about_y_deg: float, about_z_deg: float = 0.0) -> np.ndarray:
    """A rotation matrix."""
    rotation = np.eye(3)
    for axis, angle in enumerate((about_x_deg, about_y_deg, about_z_deg)):
        vector = np.zeros(3)
        vector[axis] = math.radians(angle)
        rotation = cv2.Rodrigues(vector)[0] @ rotation
    return rotation


_POSES = (  # turned about x and y, degrees; middle of the board, meters
    (30, 0, 0.0, 0.0, 0.40), (-30, 0, 0.05, 0.02, 0.42), (0, 30, -0.05, 0.0, 0.40), (0, -30, 0.0, -0.03, 0.45),
    (25, 25, 0.08, 0.05, 0.50), (-25, 25, -0.10, 0.05, 0.50), (25, -25, 0.10, -0.06, 0.50),
    (-25, -25, -0.10, -0.06, 0.52), (35, 10, 0.0, 0.08, 0.48), (10, 35, -0.12, 0.0, 0.55),
    (-35, -10, 0.12, 0.02, 0.55), (5, -35, 0.0, 0.0, 0.36),
)  # fmt: skip
VIEWS = len(_POSES)


@cache
def tilted_view(number: int) -> bytes:
    """One of the twelve views as the tutorial describes them: tilted both ways, near and far, in the corners."""
    about_x, about_y, *middle_m = _POSES[number]
    return draw_board(rays(TRUTH), turned(about_x, about_y, 7.0 * number), np.array(middle_m))
