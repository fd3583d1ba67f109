"""A film and a snapshot on a full disk: one line, and no unfinished file."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from sightline.operator_side.client.pictures import Shot
from sightline.operator_side.recording.film import film, snapshot
from sightline.protocol.channels import FRAME
from sightline.protocol.errors import ConfigError

NOISE = simplejpeg.encode_jpeg(np.random.default_rng(1).integers(0, 255, (120, 160, 3), np.uint8), 90)


class Played:
    """Images of noise, which compress badly."""

    def __init__(self) -> None:
        self._shots = iter([Shot(FRAME, NOISE, "0000000a", at, at * 100_000, 160, 120) for at in range(1, 12)])

    def take(self, _seconds: float) -> Shot:
        return next(self._shots)


@contextmanager
def full_disk(room_bytes: int = 1000) -> Iterator[None]:
    """Let no file grow beyond that."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("room_bytes", [0, 1, 1000, 4000])
def test_video_on_a_full_disk_is_reported(tmp_path: Path, room_bytes: int) -> None:
    with full_disk(room_bytes), pytest.raises(ConfigError, match=f"cannot write {tmp_path}/run.mp4: File too large; "):
        film(Played(), tmp_path / "run.mp4", FRAME, 0.9)
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_ends_a_film_and_before_its_first_image_the_command(tmp_path: Path) -> None:
    class Interrupted(Played):
        left = 0

        def take(self, seconds: float) -> Shot:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            return super().take(seconds)

    with pytest.raises(KeyboardInterrupt):
        film(Interrupted(), tmp_path / "run.mp4", FRAME, 0.9)
    assert list(tmp_path.iterdir()) == []
    pictures = Interrupted()
    pictures.left = 2
    assert film(pictures, tmp_path / "run.mp4", FRAME, 0.9).frames == 2


def test_snapshot_on_a_full_disk_is_reported(tmp_path: Path) -> None:
    with full_disk(), pytest.raises(ConfigError, match=f"cannot write {tmp_path}/one.jpg: File too large; "):
        snapshot(Played(), tmp_path / "one.jpg", FRAME)
    assert list(tmp_path.iterdir()) == []
