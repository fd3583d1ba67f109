"""The kit's pictures and its JPEG writer: what the files are, and that two decoders see in them what was drawn."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st

from sightline.conformance.vision.images import (
    CAMERA,
    HALF_CAMERA,
    claiming,
    commented,
    filled,
    many_scans,
    picture,
    png,
)
from sightline.protocol.errors import WireError
from sightline.protocol.jpeg import read_jpeg_size
from tests.conformance.vision import drawing as vision_pictures
from tests.conformance.vision.drawing import DRAWINGS, Drawing, encode_jpeg

pytestmark = pytest.mark.computes


def decoded(jpeg):
    """Decode an image by OpenCV to Y, Cb, Cr."""
    bgr = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2YCrCb)[:, :, [0, 2, 1]].astype(int)


def test_the_files_are_what_the_code_draws():
    assert vision_pictures.differing() == []


def test_verify_finds_what_was_changed_and_write_restores_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(vision_pictures, "FOLDER", tmp_path)
    small = Drawing("a small ball", 16, 16, 4, 32, 32)
    monkeypatch.setattr(vision_pictures, "DRAWINGS", {"small": small, "gray": replace(small, grey=True)})
    assert vision_pictures.main(["--verify"]) == 5
    assert "gray, small" in capsys.readouterr().err
    assert vision_pictures.main(["--write"]) == 0
    (tmp_path / "left_over.jpg").write_bytes(b"")
    assert vision_pictures.main(["--verify"]) == 5
    assert "left_over" in capsys.readouterr().err
    assert vision_pictures.main(["--write"]) == vision_pictures.main(["--verify"]) == 0
    assert vision_pictures.main([]) == 2


@pytest.mark.parametrize("name", DRAWINGS)
def test_a_picture_is_seen_as_it_was_drawn(name):
    drawing = DRAWINGS[name]
    size = read_jpeg_size(picture(name))
    assert (size.width_px, size.height_px) == (drawing.width_px, drawing.height_px)
    seen = decoded(picture(name))
    at = drawing.scene()
    drawn = np.array([[at(x, y) for x in range(drawing.width_px)] for y in range(drawing.height_px)])
    if not drawing.grey:
        assert np.abs(seen - drawn).mean() < 0.5
        assert simplejpeg.decode_jpeg(picture(name)).shape == seen.shape
    else:
        assert np.abs(seen[:, :, 0] - drawn[:, :, 0]).mean() < 0.5


@settings(max_examples=25)
@given(st.randoms(use_true_random=False), st.booleans())
def test_any_pixels_come_back(random, progressive):
    """Noise is the worst case: every coefficient, both signs, all run lengths."""
    pixels = [[tuple(random.randrange(256) for _ in range(3)) for _ in range(16)] for _ in range(8)]
    jpeg = encode_jpeg(16, 8, lambda x, y: pixels[y][x], progressive=progressive)
    seen = simplejpeg.decode_jpeg(jpeg, "BGR", fastdct=False, fastupsample=False)
    drawn = cv2.cvtColor(np.array(pixels, np.uint8)[:, :, [0, 2, 1]], cv2.COLOR_YCrCb2BGR)
    assert np.abs(seen.astype(int) - drawn).mean() < 4


def test_partial_blocks_are_rejected():
    with pytest.raises(ValueError, match="17x8"):
        encode_jpeg(17, 8, lambda x, y: (0, 0, 0))


def test_missing_image_is_a_key_error():
    with pytest.raises(KeyError):
        picture("../left")


def test_the_half_camera_sees_the_same_angles():
    assert CAMERA.width_px / CAMERA.fx_px == HALF_CAMERA.width_px / HALF_CAMERA.fx_px


def test_invalid_image_has_its_stated_defect():
    assert len(claiming(65_500, 65_500)) == 21
    with pytest.raises(WireError, match="65500x65500"):
        read_jpeg_size(claiming(65_500, 65_500))
    assert read_jpeg_size(commented(picture("left"), 61)).width_px == 320
    with pytest.raises(WireError, match="64 segments"):
        read_jpeg_size(commented(picture("left"), 64))
    assert cv2.imdecode(np.frombuffer(png(), np.uint8), cv2.IMREAD_GRAYSCALE).tolist() == [[128]]
    assert read_jpeg_size(filled(picture("left"), 8)).width_px == 320
    bomb = many_scans(picture("left_progressive"), 50)
    assert bomb.count(b"\xff\xda") == 54 and read_jpeg_size(bomb).height_px == 240
