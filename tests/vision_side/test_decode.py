"""Decoding: any bytes whatever give a picture or a WireError, and soon."""

import time

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.protocol.errors import WireError
from sightline.vision_side.decode import MAX_SCANS, Decoder
from tests.fixtures.vision.vision import camera, jpeg_of, scene

GOOD = jpeg_of(scene(camera(), 0.855, 0.1))


def decoder(width_px: int = 320, height_px: int = 240) -> Decoder:
    return Decoder(width_px, height_px, 1920 * 1080)


@pytest.mark.parametrize(("size", "scale"), [((320, 240), 1), ((638, 480), 1), ((640, 480), 2), ((801, 601), 2)])
def test_scale_is_half_from_vga_up_and_pixels_keep_their_place(size: tuple[int, int], scale: int) -> None:
    width, height = size
    drawn = np.zeros((height, width, 3), np.uint8)
    drawn[height // 2 :, width // 2 :] = (13, 199, 242)
    picture = decoder(*size).decode(jpeg_of(drawn, 95))
    assert picture.scale == scale
    assert picture.bgr.shape == (-(-height // scale), -(-width // scale), 3)
    near, far = (height // 2 + 20) // scale, (height // 2 - 20) // scale
    assert picture.bgr[near, (width // 2 + 20) // scale].max() > 200
    assert picture.bgr[far, (width // 2 - 20) // scale].max() < 40


def test_buffer_is_allocated_once() -> None:
    one = decoder()
    assert one.decode(GOOD).bgr is one.decode(GOOD).bgr


@pytest.mark.parametrize("size", [(320, 240), (640, 480), (801, 601)])
def test_pixels_stay_in_the_cache(size: tuple[int, int]) -> None:
    """On a 32-byte boundary libjpeg-turbo writes past it."""
    assert {decoder(*size)._picture.bgr.ctypes.data % 32 for _ in range(8)} == {16}


def test_known_image_header_skips_only_its_own_check() -> None:
    one, fresh = decoder(), decoder()
    first = one.decode(GOOD).bgr.copy()
    for other in (jpeg_of(np.zeros((241, 320, 3), np.uint8)), GOOD[:-200], GOOD[:100], b""):
        with pytest.raises(WireError):
            one.decode(other)
    finer = jpeg_of(scene(camera(), 1, 0), 95)
    assert np.array_equal(one.decode(finer).bgr, fresh.decode(finer).bgr)
    assert np.array_equal(one.decode(GOOD).bgr, first)


def test_gray_images_decode() -> None:
    grey = cv2.imencode(".jpg", np.full((240, 320), 77, np.uint8))[1].tobytes()
    assert np.ptp(decoder().decode(grey).bgr) <= 2


@pytest.mark.parametrize("data", [
    b"", b"\xff", b"\xff\xd8", b"\x89PNG\r\n", GOOD[:100], GOOD[: len(GOOD) // 2], GOOD[:-200], GOOD[2:],
    jpeg_of(np.zeros((241, 320, 3), np.uint8)), cv2.imencode(".png", np.zeros((240, 320, 3), np.uint8))[1].tobytes(),
], ids=["empty", "one", "soi", "png-magic", "header", "half", "no-end", "no-soi", "other-size", "png"])
def test_image_of_another_camera_is_rejected(data: bytes) -> None:
    with pytest.raises(WireError):
        decoder().decode(data)


def test_progressive_bomb_is_rejected_before_decoding() -> None:
    progressive = cv2.imencode(".jpg", scene(camera(), 1, 0), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    decoder().decode(progressive)
    scan = progressive[progressive.rfind(b"\xff\xda") : -2]
    bomb = progressive[:-2] + scan * 400 + b"\xff\xd9"
    started = time.process_time()
    with pytest.raises(WireError, match=f"more than {MAX_SCANS} scans"):
        decoder().decode(bomb)
    assert time.process_time() - started < 0.05


@pytest.mark.parametrize("known", [False, True], ids=["new-head", "known-head"])
def test_scans_after_a_whole_one_cost_nothing(known: bool) -> None:
    one, scan = decoder(), GOOD[GOOD.rfind(b"\xff\xda") : -2]
    if known:
        one.decode(GOOD)
    started = time.process_time()
    with pytest.raises(WireError, match="does not decode"):
        one.decode(GOOD[:-2] + scan * 60 + b"\xff\xd9")
    assert time.process_time() - started < 0.05


def test_baseline_scans_one_component_each_are_counted() -> None:
    """A first scan that lacks components lets more follow: the head alone proves nothing."""
    one = decoder()
    one.decode(GOOD)
    at = GOOD.rfind(b"\xff\xda")
    luma = bytes.fromhex("ffda0008010100003f00") + GOOD[at + 14 : -2]
    with pytest.raises(WireError, match=f"more than {MAX_SCANS} scans"):
        one.decode(GOOD[:at] + luma * (MAX_SCANS + 1) + b"\xff\xd9")


@settings(max_examples=150)
@given(at=st.integers(0, len(GOOD) - 1), junk=st.binary(min_size=1, max_size=8), cut=st.integers(0, 200))
def test_damaged_images_decode_or_are_rejected(at: int, junk: bytes, cut: int) -> None:
    damaged = GOOD[:at] + junk + GOOD[at + len(junk) : len(GOOD) - cut]
    try:
        assert decoder().decode(damaged).bgr.shape == (240, 320, 3)
    except WireError as error:
        assert "\n" not in str(error)
