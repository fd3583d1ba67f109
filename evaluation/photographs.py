"""Read a folder of photographs, and compare them by a perceptual hash. Shell (files)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
import simplejpeg

from sightline.protocol.errors import ConfigError
from sightline.sim.scenes.model import HEIGHT_PX, WIDTH_PX

SHIPPED: Final = Path(__file__).parent / "score" / "photographs"
"""Photographs that come with Sightline, for scores only; `SOURCES.md` there names their origin."""
FEWEST: Final = 20
"""Photographs in a folder, at least."""
_MOST_PIXELS: Final = 50_000_000
_LONGEST_PX: Final = 1024
"""Longest side; larger photographs are scaled down after reading."""
_SAME_BITS: Final = 8
"""Largest number of different bits, of 64, in two hashes of one photograph."""
_ENDINGS: Final = (".jpg", ".jpeg", ".png")


@dataclass(frozen=True, slots=True)
class Photograph:
    """One photograph: file name and upright RGB (H, W, 3)."""

    name: str
    rgb: npt.NDArray[np.uint8]


def read_photographs(folder: Path) -> tuple[Photograph, ...]:
    """Return the photographs of a folder by name. Raises ConfigError for an invalid file, or for too few."""
    try:
        files = sorted(one for one in folder.iterdir() if one.suffix.lower() in _ENDINGS)
    except OSError as error:
        raise ConfigError(f"{folder}: {error.strerror or error}; name a folder of photographs") from None
    if len(files) < FEWEST:
        raise ConfigError(f"{folder} has {len(files)} photographs (.jpg, .png); at least {FEWEST} are needed")
    return tuple(Photograph(one.name, _read(one)) for one in files)


def _read(path: Path) -> npt.NDArray[np.uint8]:
    """Read one image as 8-bit RGB, turned upright by its EXIF, at most `_LONGEST_PX` long."""
    if path.exists() and not path.is_file():  # a pipe or a device may have no end
        raise ConfigError(f"{path} is not a regular file; remove it, or rename it")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from None
    width, height = _size(path, data)
    scale = min(1.0, _LONGEST_PX / max(width, height, 1))
    if width * scale < WIDTH_PX or height * scale < HEIGHT_PX or width * height > _MOST_PIXELS:
        raise ConfigError(f"{path} is {width}x{height} pixels; a photograph has {WIDTH_PX}x{HEIGHT_PX} to "
                          f"{_MOST_PIXELS // 1_000_000} million, and as many as the first at a length of {_LONGEST_PX}")
    bgr = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if bgr is None:
        raise ConfigError(f"{path} cannot be decoded; save it again as JPEG, or remove it")
    if scale < 1.0:
        bgr = cv2.resize(bgr, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def _size(path: Path, data: bytes) -> tuple[int, int]:
    """Read width and height from the head of a JPEG or PNG, before the image is decoded."""
    if data.startswith(b"\x89PNG\r\n\x1a\n") and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    try:
        height, width, _, _ = simplejpeg.decode_jpeg_header(data)
    except ValueError:
        raise ConfigError(f"{path} is not a JPEG or PNG image; remove it, or rename it") from None
    return int(width), int(height)


def shared(first: Sequence[Photograph], second: Sequence[Photograph]) -> list[tuple[str, str]]:
    """Return the pairs of photographs that show the same, also under another name or size."""
    hashes = [(one.name, show_hash(one.rgb)) for one in second]
    return [(one.name, name) for one in first for own in [show_hash(one.rgb)] for name, other in hashes
            if (own ^ other).bit_count() <= _SAME_BITS]


def show_hash(rgb: npt.NDArray[np.uint8]) -> int:
    """Return 64 bits that change little with size, quality and brightness: signs of the low frequencies of a cosine
    transform (pHash; Zauner, Implementation and Benchmarking of Perceptual Image Hash Functions, 2010)."""
    gray = cv2.resize(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (32, 32), interpolation=cv2.INTER_AREA)
    low = cv2.dct(gray.astype(np.float32))[:8, :8].flatten()
    return int.from_bytes(np.packbits(low > np.median(low)).tobytes(), "big")
