"""`sightline calibrate camera`: it recovers the model of a drawn camera and reports impossible measurements."""

import errno
import json
import math
import struct
import tomllib
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest
import typer

from sightline.operator_side.calibrate.camera import (
    Ball,
    Board,
    Calibration,
    Mounting,
    ball_finder,
    collect,
    find_board,
    from_balls,
    from_boards,
    is_new_view,
)
from sightline.operator_side.cli import calibrate as cli_calibrate
from sightline.protocol.errors import ConfigError
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import CameraModel
from sightline.robot_side.hardware.cameras.files import StillCamera
from sightline.robot_side.hardware.cameras.lens import guessed_model, read_model
from sightline.vision_side.config import HsvConfig
from tests.fixtures.robot_process import RobotProcess
from tests.fixtures.vision.vision import camera, jpeg_of, scene
from tests.operator_side.calibrate.board import BOARD, TRUTH, VIEWS, draw_board, rays, tilted_view, turned

SIZE = JpegSize(TRUTH.width_px, TRUTH.height_px, 3)
EMPTY = jpeg_of(np.full((TRUTH.height_px, TRUTH.width_px, 3), 120, np.uint8))


def views() -> tuple[bytes, ...]:
    return tuple(map(tilted_view, range(VIEWS)))


@cache
def corners_in(number: int) -> np.ndarray:
    return find_board(tilted_view(number), BOARD)


def found(count: int = VIEWS) -> tuple[np.ndarray, ...]:
    return tuple(map(corners_in, range(count)))


def run(*arguments):
    app = typer.Typer()
    cli_calibrate.register(app)
    return app(["calibrate", "camera", *map(str, arguments)], standalone_mode=False)


def folder(tmp_path, pictures):
    for number, jpeg in enumerate(pictures):
        (tmp_path / f"{number:02}.jpg").write_bytes(jpeg)
    return tmp_path


# --- chessboard --------------------------------------------------------------------------------------------------


def test_a_chessboard_gives_the_true_camera():
    assert all(corners is not None for corners in found())
    made = from_boards(found(), BOARD, SIZE, len(views()), Mounting(z_m=0.06, pitch_rad=0.1))
    model = made.model
    assert made.error < 0.3
    assert model.fx_px == pytest.approx(TRUTH.fx_px, rel=0.005)
    assert model.fy_px == pytest.approx(TRUTH.fy_px, rel=0.005)
    # Half a pixel is what mixing up corner and middle of a pixel would cost.
    assert model.cx_px == pytest.approx(TRUTH.cx_px, abs=0.4)
    assert model.cy_px == pytest.approx(TRUTH.cy_px, abs=0.4)
    assert (model.z_m, model.pitch_rad, model.calibrated) == (0.06, 0.1, True)


def test_pixels_are_undistorted_to_within_one_pixel_where_boards_were():
    model = from_boards(found(), BOARD, SIZE, len(views()), Mounting()).model
    grid = np.array([[[x, y]] for x in range(90, 400, 50) for y in range(80, 290, 40)], float)

    def rays_of(one):
        matrix = np.array([[one.fx_px, 0, one.cx_px], [0, one.fy_px, one.cy_px], [0, 0, 1]])
        return cv2.undistortPoints(grid, matrix, np.array(one.distortion))

    assert np.abs(rays_of(model) - rays_of(TRUTH)).max() * TRUTH.fx_px < 0.6


def test_too_few_boards_are_rejected():
    with pytest.raises(ConfigError, match=r"is in 4 of 9 images, at least 5"):
        from_boards(found(4), BOARD, SIZE, 9, Mounting())


@pytest.mark.parametrize("tilt_deg", [0, 4])
def test_boards_that_all_face_the_camera_are_rejected(tilt_deg):
    seen = rays(TRUTH)
    places = [np.array([x, y, 0.5]) for x in (-0.08, 0.08) for y in (-0.04, 0.0, 0.04)]
    flat = [draw_board(seen, turned(tilt_deg, tilt_deg / 2), place) for place in places]
    corners = [one for jpeg in flat if (one := find_board(jpeg, BOARD)) is not None]
    assert len(corners) == 6
    with pytest.raises(ConfigError, match="0 boards have a tilt"):
        from_boards(corners, BOARD, SIZE, 6, Mounting())


def test_boards_that_do_not_fit_one_camera_are_rejected():
    rng = np.random.default_rng(3)
    bent = [corners + rng.normal(0, 4, corners.shape).astype(np.float32) for corners in found(6)]
    with pytest.raises(ConfigError, match=r"fit is .* px RMS"):
        from_boards(bent, BOARD, SIZE, len(bent), Mounting())


@pytest.mark.parametrize("jpeg", [EMPTY, b"", b"\xff\xd8 no picture", EMPTY[:300]], ids=["empty", "none", "bad", "cut"])
def test_image_without_a_board_gives_no_board(jpeg):
    assert find_board(jpeg, BOARD) is None


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_image_with_an_orientation_is_measured_as_the_camera_took_it(orientation):
    """The robot's decoder does not turn images, and the size of the model is that of the header."""
    turning = struct.pack(">2sHIHHHIHHI", b"MM", 42, 8, 1, 0x112, 3, 1, orientation, 0, 0)
    marked = b"\xff\xd8\xff\xe1" + struct.pack(">H", len(turning) + 8) + b"Exif\0\0" + turning + tilted_view(0)[2:]
    upright = cv2.imdecode(np.frombuffer(marked, np.uint8), cv2.IMREAD_GRAYSCALE)
    plain = cv2.imdecode(np.frombuffer(tilted_view(0), np.uint8), cv2.IMREAD_GRAYSCALE)
    assert not np.array_equal(upright, plain), "the mark is read by decoders that turn images"
    assert np.array_equal(find_board(marked, BOARD), corners_in(0))


def test_the_same_view_is_taken_once():
    pictures = [tilted_view(0)] * 5 + [tilted_view(1)]
    got = collect(iter(pictures), lambda _: lambda jpeg: find_board(jpeg, BOARD), is_new_view, 99, lambda _: None)
    assert (len(got.found), got.given, got.repeated) == (2, 6, 4)


def test_boards_that_all_stand_in_one_place_are_reported_as_that(tmp_path):
    pictures = folder(tmp_path, [tilted_view(0)] * 6)
    with pytest.raises(ConfigError, match=r"7 x 5 inner corners is in 6 of 6 images, 5 of them repeat an ear"):
        run("--images", pictures, "--board", "7x5", "--out", tmp_path / "camera.toml")


def test_size_of_the_squares_has_no_effect():
    boards = [replace(BOARD, square_m=square_m) for square_m in (0.01, 0.5)]
    small, large = (from_boards(found(), board, SIZE, VIEWS, Mounting()).model for board in boards)
    assert small.fx_px == pytest.approx(large.fx_px, rel=1e-4) and small.cx_px == pytest.approx(large.cx_px, abs=0.05)


def test_damaged_and_scaled_images_of_a_live_source_are_skipped_and_counted():
    small = jpeg_of(np.full((240, 320, 3), 120, np.uint8))
    pictures = [b"\xff\xd8 no picture", tilted_view(0), small, tilted_view(1), b"", tilted_view(2)]
    arguments = (lambda _: lambda jpeg: find_board(jpeg, BOARD), is_new_view, 99, lambda _: None)
    got = collect(iter(pictures), *arguments, is_live=True)
    assert (len(got.found), got.given, got.skipped) == (3, 3, 3)
    assert (got.size.width_px, got.size.height_px) == (TRUTH.width_px, TRUTH.height_px)
    with pytest.raises(ConfigError, match="are mixed"):
        collect(iter(pictures[1:]), *arguments)
    with pytest.raises(ConfigError, match="no image from the camera"):
        collect(iter(pictures[:1]), *arguments, is_live=True)


@pytest.mark.parametrize("interrupted_at", range(5))
@pytest.mark.parametrize("is_searching", [False, True])
@pytest.mark.parametrize("is_live", [False, True])
def test_interrupted_search_in_live_images_returns_what_it_found(interrupted_at, is_searching, is_live):
    """All boards were lost, though enough of them may be found long before the time ends."""
    number = iter(range(9))

    def press(at):
        if is_searching == at and next(number) == interrupted_at:
            raise KeyboardInterrupt
        return True

    pictures = (EMPTY for _ in range(9) if press(False))
    arguments = (pictures, lambda _: lambda _: press(True) or None, lambda *_: True, 9, lambda _: None)
    if is_live and interrupted_at:
        assert len(collect(*arguments, is_live=True).found) == interrupted_at
    else:
        with pytest.raises(KeyboardInterrupt):
            collect(*arguments, is_live=is_live)


def test_live_source_whose_first_images_are_scaled_begins_again_at_full_size():
    """Flow control may have scaled the images before, and never makes one larger than the camera does."""
    sizes = [JpegSize(160, 120, 3), JpegSize(160, 120, 3), JpegSize(640, 480, 3), JpegSize(320, 240, 3)]
    pictures = [jpeg_of(np.full((size.height_px, size.width_px, 3), 120, np.uint8)) for size in sizes]
    reports = []
    got = collect(iter([*pictures, pictures[2], pictures[0]]), lambda size: lambda _: size.width_px, lambda *_: True, 3,
                  reports.append, is_live=True)
    assert (got.size.width_px, got.found, got.given, got.skipped) == (640, [640, 640], 2, 4)
    assert reports == ["1 of 3", "2 of 3", "1 of 3", "2 of 3"]


# --- ball --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pitch_rad", [0.0, -0.2])
@pytest.mark.parametrize("y_m", [0.0, 0.25])
def test_a_known_ball_gives_the_true_focal_length(pitch_rad, y_m):
    truth = camera(640, 480, pitch_rad)
    away_m = math.hypot(0.9 - truth.x_m, y_m)
    detection = ball_finder(JpegSize(640, 480, 3), HsvConfig())(jpeg_of(scene(truth, 0.9, y_m)))
    mounting = Mounting(truth.x_m, truth.y_m, truth.z_m, truth.pitch_rad)
    made = from_balls([detection] * 3, Ball(0.1, away_m), JpegSize(640, 480, 3), 3, mounting)
    assert made.model.fx_px == pytest.approx(truth.fx_px, rel=0.01)
    assert made.model.fx_px == made.model.fy_px
    assert (made.model.cx_px, made.model.cy_px, made.model.distortion) == (320.0, 240.0, ())


def test_images_of_a_ball_that_moved_are_rejected():
    truth, finder = camera(640, 480), ball_finder(JpegSize(640, 480, 3), HsvConfig())
    detections = [finder(jpeg_of(scene(truth, x_m, 0.0))) for x_m in (0.8, 0.9, 1.0)]
    with pytest.raises(ConfigError, match="keep ball and camera still"):
        from_balls(detections, Ball(0.1, 0.85), JpegSize(640, 480, 3), 3, Mounting(truth.x_m))


def test_ball_that_cannot_be_that_far_is_rejected():
    truth = camera(640, 480)
    detection = ball_finder(JpegSize(640, 480, 3), HsvConfig())(jpeg_of(scene(truth, 0.9, 0.0)))
    with pytest.raises(ConfigError, match="no ball in 1 images"):
        from_balls([detection], Ball(0.1, 19.0), JpegSize(640, 480, 3), 1, Mounting())


# --- a live robot ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_live_robot_is_measured_and_keeps_its_mounting(tmp_path, capsys):
    (tmp_path / "boards").mkdir()
    mounted = guessed_model(SIZE, 60.0).model_dump(mode="json") | {"z_m": 0.11, "pitch_rad": -0.05}
    options = {"path": str(folder(tmp_path / "boards", views())), "model": mounted, "fps": 10}
    with RobotProcess(tmp_path, camera={"kind": "folder", "options": options}) as robot:
        robot.wait_until_on("on tcp")
        run("--robot", "r1", "--connect", robot.endpoint, "--board", "7x5", "--square-m", 0.03, "--views", 8,
            "--out", tmp_path / "camera.toml", "--seconds", 30)
    model = read_model(tmp_path / "camera.toml")
    assert model.fx_px == pytest.approx(TRUTH.fx_px, rel=0.01)
    assert (model.z_m, model.pitch_rad) == (0.11, -0.05)
    assert "board 8 of 8" in capsys.readouterr().out


# --- the command -------------------------------------------------------------------------------------------------


def test_the_command_writes_a_model_that_a_camera_takes(tmp_path, capsys):
    pictures, out = folder(tmp_path, views()), tmp_path / "camera.toml"
    run("--images", pictures, "--board", "7x5", "--square-m", 0.03, "--out", out, "--z-m", 0.12)
    assert f"--set camera.options.model_file={out}" in capsys.readouterr().out
    still = StillCamera(StillCamera.Config(path=pictures / "00.jpg", model_file=out))
    assert still.model == read_model(out)
    assert still.model.calibrated
    assert still.model.z_m == 0.12
    assert still.model.fx_px == pytest.approx(TRUTH.fx_px, rel=0.005)


class Loud(StillCamera):
    """A camera that prints."""

    def close(self):
        print("ends")
        super().close()


@pytest.mark.parametrize("kind", ["still", f"{__name__}:Loud"])
def test_a_ball_through_a_camera_plug_in(tmp_path, capsys, kind):
    (tmp_path / "ball.jpg").write_bytes(jpeg_of(scene(camera(640, 480), 0.855, 0.0)))
    run("--camera", kind, "--camera-set", f"path={tmp_path / 'ball.jpg'}", "--camera-set", "fps=200",
        "--ball-radius-m", 0.1, "--distance-m", 0.8, "--out", tmp_path / "camera.toml", "--json")
    said = json.loads(capsys.readouterr().out)
    assert said["ok"]
    assert said["model"]["fx_px"] == pytest.approx(camera(640, 480).fx_px, rel=0.01)
    assert read_model(tmp_path / "camera.toml").fx_px == said["model"]["fx_px"]


@pytest.mark.parametrize(("given", "subject"), [
    (("--ball-radius-m", 0.1, "--distance-m", 0.8), "the ball"), (("--board", "7x5"), "a board of 7x5 inner corners"),
    (("--board", "7x5", "--json"), ""),
])  # fmt: skip
@pytest.mark.parametrize("seconds", [0, 7])
def test_search_in_live_images_is_announced_with_its_longest_time(
    tmp_path, capsys, monkeypatch, given, subject, seconds
):
    """It may last 90 s without a board or ball."""
    folder(tmp_path, [EMPTY])
    monkeypatch.setattr(cli_calibrate, "_measure", lambda *_, **__: Calibration(TRUTH, 8, 9, 0.1, "px RMS"))
    live = ("--camera", "still", "--camera-set", f"path={tmp_path / '00.jpg'}", "--seconds", seconds)
    run(*live if seconds else ("--images", tmp_path), *given, "--out", tmp_path / "camera.toml")
    line = f"searching the live images for {subject}, for 7 s or until Ctrl-C"
    lines = [one for one in capsys.readouterr().out.splitlines() if one.startswith("search")]
    assert lines == ([line] if seconds and subject else [])


@pytest.mark.parametrize("option", ["--images", "--pictures"])  # the second is its former name
def test_no_board_found_is_one_line(tmp_path, option):
    out = tmp_path / "camera.toml"
    with pytest.raises(ConfigError, match=r"no board in 3 images: .* a chessboard of 9 x 6 inner corners") as error:
        run(option, folder(tmp_path, [EMPTY] * 3), "--out", out)
    assert "\n" not in str(error.value)
    assert not out.exists()


def test_bad_output_file_is_reported_before_the_measurement(tmp_path):
    pictures = folder(tmp_path, [EMPTY])
    for out, words in ((tmp_path, "is a folder"), (tmp_path / "none" / "camera.toml", "no folder")):
        with pytest.raises(ConfigError, match=words):
            run("--images", pictures, "--out", out)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "expected one source of images"),
        (("--images", ".", "--camera", "v4l2"), "expected one source of images"),
        (("--images", ".", "--board", "9"), "invalid --board"),
        (("--images", ".", "--board", "2x9"), "invalid --board"),
        (("--images", ".", "--ball-radius-m", "0.1"), "both --ball-radius-m and --distance-m"),
        (("--camera", "still", "--camera-set", "path"), "invalid --camera-set"),
        (("--camera", "v4l3"), "did you mean 'v4l2'"),
    ],
)
def test_bad_usage_is_one_line(arguments, said):
    with pytest.raises(ConfigError, match=said):
        run(*arguments)


@pytest.mark.parametrize(("option", "value", "words"), [
    ("--x-m", "nan", "invalid --x-m nan: expected meters from -100 to 100"), ("--z-m", "inf", "invalid --z-m inf"),
    ("--pitch-rad", "99", "invalid --pitch-rad 99: expected radians from -1.571 to 1.571"), ("--y-m", "-1e3", "--y-m"),
])  # fmt: skip
def test_impossible_mounting_is_reported_before_the_measurement(tmp_path, monkeypatch, option, value, words):
    monkeypatch.setattr(cli_calibrate, "_source", lambda *_: pytest.fail("measured"))
    with pytest.raises(ConfigError, match=words):
        run("--images", tmp_path, "--out", tmp_path / "camera.toml", option, value)


def test_model_that_cannot_be_written_is_printed_and_the_earlier_one_stays(tmp_path, monkeypatch, capsys):
    pictures, out = folder(tmp_path, [EMPTY]), tmp_path / "camera.toml"
    made = Calibration(TRUTH, 8, 9, 0.1, "px RMS")
    monkeypatch.setattr(cli_calibrate, "_measure", lambda *_, **__: made)
    out.write_text("earlier")
    write_bytes = type(out).write_bytes

    def on_a_full_disk(path, data):
        write_bytes(path, data[:20])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(type(out), "write_bytes", on_a_full_disk)
    with pytest.raises(ConfigError, match=f"cannot write {out}: No space left on device; choose another --out"):
        run("--images", pictures, "--out", out)
    printed = capsys.readouterr().err.partition("the measured model is:\n")[2]
    assert CameraModel.model_validate_json(json.dumps(tomllib.loads(printed))) == TRUTH
    assert out.read_text() == "earlier" and sorted(path.name for path in tmp_path.iterdir()) == ["00.jpg", out.name]


def test_images_of_two_sizes_are_rejected(tmp_path):
    small = jpeg_of(np.full((240, 320, 3), 120, np.uint8))
    pictures = folder(tmp_path, [EMPTY, small])
    with pytest.raises(ConfigError, match=f"{pictures}/01.jpg: images of .* are mixed"):
        run("--images", pictures)


def test_image_that_cannot_be_used_is_named(tmp_path):
    pictures = folder(tmp_path, [EMPTY, b"no JPEG"])
    with pytest.raises(ConfigError, match=f"{pictures}/01.jpg: invalid JPEG: .*; remove or convert it"):
        run("--images", pictures)
    (pictures / "01.jpg").unlink()
    (pictures / "01.jpg").mkdir()
    with pytest.raises(ConfigError, match=f"cannot read {pictures}/01.jpg: Is a directory; remove it or make it"):
        run("--images", pictures)


def test_the_board_is_counted_in_inner_corners():
    assert Board(9, 6, 0.025).points_m().shape == (54, 3)
