"""Cameras that play files, and the lens model that every camera takes."""

import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.operator_side.config.toml_text import toml_text
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.jpeg import JpegSize
from sightline.protocol.messages import CameraModel
from sightline.robot_side.hardware.cameras.files import FolderCamera, StillCamera, VideoCamera
from sightline.robot_side.hardware.cameras.lens import LensConfig, camera_model
from tests.contracts.cameras import next_picture
from tests.fixtures.cameras import jpeg, video

MODEL = {"width_px": 320, "height_px": 240, "fx_px": 200.5, "fy_px": 201.0, "cx_px": 160.0, "cy_px": 120.0,
         "distortion": [0.1, -0.2, 0.0, 0.0], "calibrated": True}
SIZE = JpegSize(320, 240, 3)


def shade_of(picture) -> int:
    return round(float(cv2.imdecode(np.frombuffer(picture.jpeg, np.uint8), cv2.IMREAD_COLOR).mean()))


# --- video -------------------------------------------------------------------------------------------------------


def test_a_video_is_shown_in_order_at_its_own_speed(tmp_path):
    camera = VideoCamera(VideoCamera.Config(path=video(tmp_path / "film.avi", pictures=20, fps=25)))
    started_s = time.monotonic()
    shades = [shade_of(next_picture(camera)) for _ in range(10)]
    assert shades == sorted(shades)
    assert 0.3 <= time.monotonic() - started_s < 2.0
    assert shades[-1] >= 90  # in step with the clock, whatever was left out


def test_a_slow_reader_sees_fewer_images_not_a_slower_video(tmp_path):
    camera = VideoCamera(VideoCamera.Config(path=video(tmp_path / "film.avi", pictures=24, fps=25)))
    first = shade_of(next_picture(camera))
    time.sleep(0.4)
    assert shade_of(next_picture(camera)) - first >= 80


def test_a_looped_video_begins_again(tmp_path):
    camera = VideoCamera(VideoCamera.Config(path=video(tmp_path / "film.avi", pictures=3), fps=120))
    shades = [shade_of(next_picture(camera)) for _ in range(12)]
    assert any(later < earlier for earlier, later in pairwise(shades))


def test_the_end_of_a_video_that_is_not_looped_is_reported(tmp_path):
    camera = VideoCamera(VideoCamera.Config(path=video(tmp_path / "film.avi", pictures=4), loop=False, fps=120))
    with pytest.raises(HardwareError, match=r"ended after 4 images; set camera.options.loop = true"):
        for _ in range(10):
            next_picture(camera)


def test_a_video_that_breaks_off_is_reported(tmp_path):
    path = video(tmp_path / "film.avi", pictures=20, size=(320, 240))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    camera = VideoCamera(VideoCamera.Config(path=path, fps=120))
    with pytest.raises(HardwareError, match=r"breaks off at image \d+ of \d+"):
        for _ in range(60):
            next_picture(camera)


@pytest.mark.parametrize(("name", "content"), [
    ("film.mp4", b""), ("film.mp4", b"no film at all" * 100), ("film.jpg", b"hello"),
])  # fmt: skip
def test_invalid_video_is_reported(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(HardwareError, match="cannot be played"):
        VideoCamera(VideoCamera.Config(path=tmp_path / name))


@pytest.mark.parametrize("size", [(8, 64), (64, 8), (8194, 64)])
def test_video_with_images_of_a_size_that_is_not_sent_is_one_line(tmp_path, size):
    path = video(tmp_path / "film.avi", pictures=2, size=size)
    with pytest.raises(HardwareError, match=rf"film.avi has {size[0]}x{size[1]} pixels; expected 16 to 8192 a side"):
        VideoCamera(VideoCamera.Config(path=path))


def test_libraries_print_nothing_about_an_invalid_video(tmp_path):
    (tmp_path / "film.mp4").write_bytes(b"no film at all" * 100)
    code = ("import sys; from sightline.robot_side.hardware.cameras.files import HardwareError, VideoCamera\n"
            "try: VideoCamera(VideoCamera.Config(path=sys.argv[1]))\nexcept HardwareError as error: print(error)")
    done = subprocess.run([sys.executable, "-P", "-c", code, tmp_path / "film.mp4"], capture_output=True, text=True,
                          check=True)
    assert "cannot be played" in done.stdout and done.stderr == ""


def test_a_video_that_is_not_there_is_reported(tmp_path):
    with pytest.raises(HardwareError, match="is not there"):
        VideoCamera(VideoCamera.Config(path=tmp_path / "film.mp4"))


# --- pictures ----------------------------------------------------------------------------------------------------


def test_a_folder_is_played_in_name_order_and_looped(tmp_path):
    for name, shade in (("b", 60), ("a", 30), ("c", 90)):
        (tmp_path / f"{name}.jpg").write_bytes(jpeg(64, 48, shade))
    camera = FolderCamera(FolderCamera.Config(path=tmp_path, fps=240))
    assert [shade_of(next_picture(camera)) for _ in range(5)] == [30, 60, 90, 30, 60]


def test_images_of_several_sizes_are_rejected(tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg(64, 48))
    (tmp_path / "b.jpg").write_bytes(jpeg(48, 64))
    with pytest.raises(HardwareError, match="differ in size"):
        FolderCamera(FolderCamera.Config(path=tmp_path))


def test_folder_with_an_image_that_cannot_be_read_is_reported(tmp_path):
    for name, make in (("folder", Path.mkdir), ("link", lambda path: path.symlink_to("nowhere"))):
        (tmp_path / name).mkdir()
        make(tmp_path / name / "a.jpg")
        with pytest.raises(HardwareError, match=r"/a\.jpg cannot be read: .*; remove it from the folder"):
            FolderCamera(FolderCamera.Config(path=tmp_path / name))


@pytest.mark.parametrize(("content", "said"), [
    (None, "cannot be read"), (b"GIF89a", "not a JPEG"), (jpeg(15, 48), "has 15x48 pixels; expected 16 to 8192 a side"),
    (jpeg(48, 8), "has 48x8 pixels; expected"),
])
def test_a_still_that_is_invalid_is_reported(tmp_path, content, said):
    if content is not None:
        (tmp_path / "a.jpg").write_bytes(content)
    with pytest.raises(HardwareError, match=said):
        StillCamera(StillCamera.Config(path=tmp_path / "a.jpg"))


# --- the lens ----------------------------------------------------------------------------------------------------


def test_a_model_comes_from_options_or_from_a_file(tmp_path):
    (tmp_path / "camera.toml").write_text("# a comment\n" + toml_text(MODEL))
    from_file = camera_model(LensConfig(model_file=tmp_path / "camera.toml"), SIZE)
    assert from_file == camera_model(LensConfig(model=MODEL), SIZE)
    assert from_file.calibrated
    assert from_file.distortion == (0.1, -0.2, 0.0, 0.0)


def test_every_file_camera_publishes_the_model_it_is_given(tmp_path):
    (tmp_path / "a.jpg").write_bytes(jpeg(320, 240))
    video(tmp_path / "film.avi", size=(320, 240))
    for camera in (
        FolderCamera(FolderCamera.Config(path=tmp_path, model=MODEL)),
        StillCamera(StillCamera.Config(path=tmp_path / "a.jpg", model=MODEL)),
        VideoCamera(VideoCamera.Config(path=tmp_path / "film.avi", model=MODEL)),
    ):
        assert camera.model == camera_model(LensConfig(model=MODEL), SIZE)


@given(st.integers(16, 4000), st.integers(16, 4000), st.floats(5.1, 174.0))
def test_guessed_lens_has_the_configured_width_and_is_not_calibrated(width_px, height_px, hfov_deg):
    model = camera_model(LensConfig(hfov_deg=hfov_deg), JpegSize(width_px, height_px, 3))
    seen_deg = 2 * np.degrees(np.arctan(width_px / 2 / model.fx_px))
    assert seen_deg == pytest.approx(hfov_deg)
    assert not model.calibrated


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fx": 3.0}, "unknown field 'fx'"),
        ({"fx_px": "wide"}, "fx_px"),
        ({"fx_px": -1.0}, "fx_px"),
        ({"width_px": 640}, "for 640x240, the camera delivers 320x240; calibrate at this size"),
        ({"distortion": [0.0] * 9}, "distortion"),
    ],
)
def test_a_wrong_model_is_rejected_by_name(changes, said):
    with pytest.raises(ConfigError, match=said):
        camera_model(LensConfig(model=MODEL | changes), SIZE)


WRONG_FILES = [(None, "cannot be read"), ("= 3", "invalid TOML"), ("fx_px = 3.0", "width_px"),
               ("\N{BYTE ORDER MARK}fx_px = 3.0", "width_px"), (f"fx_px = {'9' * 5000}", "invalid TOML"),
               (f"fx_px = {'[' * 5000}", "invalid TOML")]


@pytest.mark.parametrize(("text", "said"), WRONG_FILES)
def test_a_model_file_that_is_invalid_is_reported(tmp_path, text, said):
    if text is not None:
        (tmp_path / "camera.toml").write_text(text)
    with pytest.raises(ConfigError, match=said):
        camera_model(LensConfig(model_file=tmp_path / "camera.toml"), SIZE)


def test_model_and_model_file_exclude_each_other(tmp_path):
    with pytest.raises(ConfigError, match="keep one"):
        camera_model(LensConfig(model_file=tmp_path / "camera.toml", model=MODEL), SIZE)


def test_camera_model_is_published_unchanged():
    assert set(MODEL) <= set(CameraModel.model_fields)
