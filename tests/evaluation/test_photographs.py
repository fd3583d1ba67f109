"""A folder of photographs: what is read, what is rejected with one line, and which show the same."""

import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from sightline.evaluation.photographs import FEWEST, SHIPPED, read_photographs, shared, show_hash
from sightline.protocol.errors import ConfigError


def photograph(seed, size=(480, 360)):
    """Smooth, of any content."""
    coarse = np.random.default_rng(seed).integers(0, 255, (9, 12, 3), np.uint8)
    return cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)


@pytest.fixture
def folder(tmp_path):
    for number in range(FEWEST):
        cv2.imwrite(str(tmp_path / f"{number:02}.jpg"), photograph(number))
    return tmp_path


def test_a_folder_is_read_by_name(folder):
    (folder / "SOURCES.json").write_text("{}")
    read = read_photographs(folder)
    assert [one.name for one in read] == [f"{number:02}.jpg" for number in range(FEWEST)]
    expected = cv2.cvtColor(photograph(3), cv2.COLOR_BGR2RGB)
    assert np.abs(read[3].rgb.astype(int) - expected).mean() < 4


def test_gray_deep_transparent_and_large_images_become_rgb(folder):
    deep = photograph(50).astype(np.uint16) * 257
    cv2.imwrite(str(folder / "a-deep.png"), deep)
    cv2.imwrite(str(folder / "b-gray.png"), cv2.cvtColor(photograph(51), cv2.COLOR_BGR2GRAY))
    cv2.imwrite(str(folder / "c-alpha.png"), cv2.cvtColor(photograph(52), cv2.COLOR_BGR2BGRA))
    cv2.imwrite(str(folder / "d-large.jpg"), photograph(53, (3000, 2000)))
    read = {one.name: one.rgb for one in read_photographs(folder)}
    assert all(rgb.ndim == 3 and rgb.shape[2] == 3 and rgb.dtype == np.uint8 for rgb in read.values())
    assert np.abs(read["a-deep.png"][..., ::-1].astype(int) - photograph(50)).max() <= 1
    assert read["d-large.jpg"].shape == (683, 1024, 3)


def test_a_turned_photograph_is_upright(folder):
    encoded = cv2.imencode(".jpg", photograph(60))[1].tobytes()
    # EXIF with the orientation 6: to be turned by a quarter, clockwise
    tiff = b"II*\x00\x08\x00\x00\x00" + struct.pack("<HHHIHHI", 1, 0x0112, 3, 1, 6, 0, 0)
    exif = b"Exif\x00\x00" + tiff
    turned = encoded[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + encoded[2:]
    (folder / "turned.jpg").write_bytes(turned)
    read = {one.name: one.rgb for one in read_photographs(folder)}["turned.jpg"]
    assert read.shape == (480, 360, 3)


def png_of(width, height):
    """The head of a PNG of that size, without its content."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunk = b"IHDR" + head
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", len(head)) + chunk + struct.pack(">I", zlib.crc32(chunk))


def test_pipe_device_or_folder_that_is_named_as_an_image_is_one_line(folder):
    """A pipe without a writer, or a device without an end, would block the command."""
    makes = (os.mkfifo, Path.mkdir, lambda path: path.symlink_to("/dev/zero"))
    for make, name in zip(makes, ("a.jpg", "b.png", "c.JPEG"), strict=True):
        make(folder / name)
        with pytest.raises(ConfigError, match=f"{name} is not a regular file; remove it"):
            read_photographs(folder)
        (folder / name).rename(folder / "other")
        (folder / "other").rmdir() if (folder / "other").is_dir() else (folder / "other").unlink()
    (folder / "link.jpg").symlink_to(folder / "07.jpg")
    assert len(read_photographs(folder)) == FEWEST + 1


@pytest.mark.parametrize(("content", "reason"), [
    (b"hello, I am text", "is not a JPEG or PNG"),
    (b"", "is not a JPEG or PNG"),
    (cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes(), "is 1x1 pixels"),
    (png_of(30_000, 30_000), "is 30000x30000 pixels"),
    (cv2.imencode(".jpg", np.zeros((320, 12_000, 3), np.uint8))[1].tobytes(), "is 12000x320 pixels"),
    (png_of(640, 480), "cannot be decoded"),
    (cv2.imencode(".jpg", photograph(1))[1].tobytes()[:20], "is not a JPEG or PNG"),
])
def test_an_invalid_file_is_one_line(folder, content, reason):
    (folder / "bad.jpg").write_bytes(content)
    with pytest.raises(ConfigError, match=reason) as told:
        read_photographs(folder)
    assert "bad.jpg" in str(told.value) and "\n" not in str(told.value)


def test_shipped_photographs_are_distinct_and_have_a_source():
    read = read_photographs(SHIPPED)
    sources = (SHIPPED / "SOURCES.md").read_text("utf-8")
    assert len(read) >= 30 and all(f"| {one.name} |" in sources for one in read)
    assert sources.count(".jpg |") == len(read)
    assert [pair for pair in shared(read, read) if pair[0] != pair[1]] == []


def test_too_few_photographs_and_no_folder_are_one_line(folder, tmp_path):
    (folder / "00.jpg").unlink()
    with pytest.raises(ConfigError, match=f"has {FEWEST - 1} photographs"):
        read_photographs(folder)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ConfigError, match="has 0 photographs"):
        read_photographs(tmp_path / "empty")
    with pytest.raises(ConfigError, match="No such file"):
        read_photographs(tmp_path / "nowhere")


def test_the_same_photograph_is_found_under_another_name_size_and_quality(folder, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    for number in range(FEWEST):
        cv2.imwrite(str(other / f"x{number:02}.jpg"), photograph(100 + number))
    copy = cv2.convertScaleAbs(cv2.resize(photograph(7), (1000, 700))[8:-6, 5:-9], alpha=0.9, beta=8)
    cv2.imwrite(str(other / "copy.jpg"), copy, [cv2.IMWRITE_JPEG_QUALITY, 40])
    assert shared(read_photographs(folder), read_photographs(other)) == [("07.jpg", "copy.jpg")]


def test_different_photographs_have_different_hashes():
    hashes = [show_hash(photograph(seed)) for seed in range(200)]
    nearest = min((one ^ other).bit_count() for at, one in enumerate(hashes) for other in hashes[:at])
    assert nearest > 8
