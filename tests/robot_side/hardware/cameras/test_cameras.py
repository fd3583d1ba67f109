"""The camera contract over every camera that can run here: folder, still, video, V4L2 and Pi stand-ins, simulation."""

import pytest
from pydantic import ValidationError

from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import PluginChoice
from sightline.robot_side.hardware.cameras.picamera import PiCamera
from sightline.robot_side.hardware.cameras.v4l2 import V4l2Camera
from sightline.robot_side.pipe import NetworkSetup
from sightline.robot_side.plugins import CAMERAS
from tests.contracts.cameras import check_camera
from tests.fixtures import demanded
from tests.fixtures.cameras import FakeDevice, install_fake_picamera2, jpeg, video

pytestmark = pytest.mark.waits

KINDS = ("folder", "still", "video", "v4l2", "picamera")


def folder_of_pictures(tmp_path):
    for shade in (10, 90, 170):
        (tmp_path / f"{shade:03}.jpg").write_bytes(jpeg(320, 240, shade))
    return tmp_path


def test_folder(tmp_path):
    options = {"path": str(folder_of_pictures(tmp_path))}
    check_camera(lambda: CAMERAS.build(PluginChoice(kind="folder", options=options)))


def test_still(tmp_path):
    options = {"path": str(folder_of_pictures(tmp_path) / "010.jpg")}
    check_camera(lambda: CAMERAS.build(PluginChoice(kind="still", options=options)))


def test_video(tmp_path):
    options = {"path": str(video(tmp_path / "film.avi"))}
    check_camera(lambda: CAMERAS.build(PluginChoice(kind="video", options=options)))


@pytest.mark.parametrize("pixel_format", ["MJPG", "YUYV"])
def test_v4l2(pixel_format):
    device = FakeDevice()
    check_camera(lambda: V4l2Camera(V4l2Camera.Config(format=pixel_format), device.open))
    assert device.is_released()


def test_picamera(monkeypatch):
    seen = install_fake_picamera2(monkeypatch)
    check_camera(lambda: PiCamera(PiCamera.Config()))
    assert seen.cameras[0].closed


@pytest.mark.alone
def test_simulation(tmp_path):
    demanded.module("pybullet", "sim")
    from sightline.sim.bus import SimCamera
    from tests.sim.test_bus import started

    simulator = started(tmp_path)
    try:
        check_camera(lambda: SimCamera(SimCamera.Config(socket_dir=simulator.socket_dir)))
    finally:
        simulator.process.kill()
        simulator.process.wait(10)


def test_only_real_cameras_are_live(tmp_path):
    folder = folder_of_pictures(tmp_path)
    film = video(tmp_path / "film.avi")
    for kind, path in (("folder", folder), ("still", folder / "010.jpg"), ("video", film)):
        assert CAMERAS.build(PluginChoice(kind=kind, options={"path": str(path)})).live is False
    assert V4l2Camera.live is True
    assert PiCamera.live is True


@pytest.mark.parametrize("camera", [V4l2Camera, PiCamera])
def test_camera_is_frozen_before_another_process_opens_it(camera):
    patience_us = NetworkSetup.model_fields["camera_patience_us"].default
    assert camera.Config(frozen_after_s=2).frozen_after_s * 1e6 <= patience_us
    with pytest.raises(ValidationError, match="less than or equal to 2"):
        camera.Config(frozen_after_s=2.01)


@pytest.mark.parametrize("kind", KINDS)
def test_an_option_that_is_invalid_is_named(kind):
    with pytest.raises(ConfigError, match=r"option 'colour'"):
        CAMERAS.build(PluginChoice(kind=kind, options={"path": ".", "colour": "red"} if kind in KINDS[:3]
                                      else {"colour": "red"}))
