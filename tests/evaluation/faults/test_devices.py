"""The failing camera: its images are young and new, so that only the fault itself can stop the robot."""

import pytest

from sightline.evaluation.faults import devices
from sightline.protocol.jpeg import read_jpeg_size
from sightline.robot_side.ports import Picture


class Camera:
    """Gives the same black image with a new time at each call; at half size, a name in its place."""

    model, live = None, True

    def __init__(self, config):
        self._t_us, self._scale_percent = 0, 100

    def adjust(self, quality_percent, scale_percent):
        self._scale_percent = scale_percent
        return True

    def read(self, timeout_s):
        self._t_us += 1
        return Picture(b"whole" if self._scale_percent == 100 else b"half", self._t_us, self._scale_percent)


@pytest.fixture
def camera(tmp_path, monkeypatch):
    monkeypatch.setattr(devices, "SimCamera", Camera)
    devices.write_spares(tmp_path)
    return devices.FaultyCamera(devices.FaultyCamera.Config(socket_dir="none", folder=tmp_path))


@pytest.mark.parametrize("mode", ["black", "bomb"])
def test_replaced_image_is_new_each_time(camera, tmp_path, mode):
    (tmp_path / devices.MODE).write_text(mode, "ascii")
    first, second = camera.read(0.1), camera.read(0.1)
    assert first.jpeg != second.jpeg
    assert read_jpeg_size(first.jpeg, 2**33) == read_jpeg_size(second.jpeg, 2**33)


def test_resized_image_is_the_real_one_of_another_size_than_announced(camera, tmp_path):
    (tmp_path / devices.MODE).write_text("resized", "ascii")
    assert camera.read(0.1) == Picture(b"half", 1, 100)
    (tmp_path / devices.MODE).write_text("", "ascii")
    assert camera.read(0.1) == Picture(b"whole", 2, 100)
