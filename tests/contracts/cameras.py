"""Contract of every camera plug-in. Run it over your own: `check_camera(lambda: YourCamera(config))`."""

import time
from collections.abc import Callable

from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.messages import CameraModel
from sightline.robot_side.ports import Adjustable, Camera, Picture, scaled_model

MAX_AGE_S = 0.15
"""From capture to the return of `read`: transfer and encoding, but no storing."""
PATIENCE_S = 2.0


def check_camera(opened: Callable[[], Camera]) -> None:
    """Every promise in turn, on one camera; an AssertionError names the one that is broken."""
    camera = opened()
    try:
        _has_a_model(camera)
        _gives_pictures_of_its_model_in_order(camera)
        _keeps_its_timeouts(camera)
        _hands_over_nothing_old(camera)
        _adjusts_or_says_that_it_does_not(camera)
    finally:
        camera.close()
        camera.close()  # idempotent


def next_picture(camera: Camera) -> Picture:
    """Return the next capture, after as many calls of `read` as it takes."""
    deadline_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline_s:
        picture = camera.read(0.2)
        if picture is not None:
            return picture
    raise AssertionError(f"no picture within {PATIENCE_S} s")


def _has_a_model(camera: Camera) -> None:
    assert isinstance(camera.model, CameraModel)
    assert isinstance(camera.live, bool)


def _gives_pictures_of_its_model_in_order(camera: Camera) -> None:
    earlier_us = 0
    for _ in range(5):
        picture = next_picture(camera)
        size = read_jpeg_size(picture.jpeg)
        assert (size.width_px, size.height_px) == (camera.model.width_px, camera.model.height_px)
        assert type(picture.jpeg) is bytes
        assert type(picture.t_us) is int
        assert earlier_us < picture.t_us <= time.monotonic_ns() // 1000, "times rise and are not in the future"
        earlier_us = picture.t_us


def _keeps_its_timeouts(camera: Camera) -> None:
    for timeout_s in (0.0, 0.002, 0.1):
        started_s = time.monotonic()
        camera.read(timeout_s)
        assert time.monotonic() - started_s < timeout_s + 0.25


def _hands_over_nothing_old(camera: Camera) -> None:
    """After a pause of the reader the first picture is of now, not the one that came first."""
    next_picture(camera)
    time.sleep(0.5)
    for _ in range(3):
        picture = next_picture(camera)
        assert time.monotonic() - picture.t_us / 1e6 < MAX_AGE_S, "an old picture was handed over"


def _adjusts_or_says_that_it_does_not(camera: Camera) -> None:
    """Request smaller images, check that each has its own scale and that size, and request the full size again."""
    if not isinstance(camera, Adjustable):
        return
    full = camera.model
    before = next_picture(camera)
    followed = camera.adjust(30, 50)
    small = _first_of_scale(camera, 50 if followed else 100)
    size, model = read_jpeg_size(small.jpeg), scaled_model(full, small.scale_percent)
    assert (size.width_px, size.height_px) == (model.width_px, model.height_px)
    assert len(small.jpeg) < len(before.jpeg) or not followed
    assert camera.model == full, "the model stays that of the full size"
    camera.adjust(100, 100)
    again = read_jpeg_size(_first_of_scale(camera, 100).jpeg)
    assert (again.width_px, again.height_px) == (full.width_px, full.height_px)


def _first_of_scale(camera: Camera, scale_percent: int) -> Picture:
    """Return the first image of the scale among the next five images."""
    for _ in range(5):
        picture = next_picture(camera)
        if picture.scale_percent == scale_percent:
            return picture
    raise AssertionError(f"no picture of {scale_percent} % came within five")
