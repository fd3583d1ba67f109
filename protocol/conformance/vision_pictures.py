"""The pictures that the kit's robot sends: a yellow ball in a plain room, and what is no picture at all. Pure.

    python -m sightline.protocol.conformance.vision_pictures --verify     the files are what this code draws
    python -m sightline.protocol.conformance.vision_pictures --write

They are made with integers alone and kept as files, so that a person can look at them, and a peer in another language
can be tried on them without the kit. `CAMERA` is the lens that they were drawn for.
"""

import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

from sightline.conformance.vision.drawing import Pixel, Scene, encode_jpeg
from sightline.protocol.messages import CameraModel

HERE = Path(__file__).parent.parent.parent / "conformance" / "vision" / "pictures"
CAMERA: Final = CameraModel(width_px=320, height_px=240, fx_px=190.7, fy_px=190.7, cx_px=160.0, cy_px=120.0,
                            x_m=0.055, z_m=0.06, calibrated=True)
"""80 degrees wide. A ball of 0.1 m radius at one metre has a radius of 20 px."""
HALF_CAMERA: Final = CAMERA.model_copy(update={"width_px": 160, "height_px": 120, "fx_px": 95.35, "fy_px": 95.35,
                                               "cx_px": 80.0, "cy_px": 60.0})
_YELLOW: Final[Pixel] = (191, 28, 165)
"""Y, Cb, Cr of the default target's colour: hue 49 degrees, well saturated."""
_ROOM: Final[Pixel] = (150, 122, 131)
_FINE: Final = 4
"""Samples per pixel and axis at the ball's edge."""


@dataclass(frozen=True, slots=True)
class Drawing:
    """A picture: where the ball is (radius 0: nowhere), and how it is written."""

    purpose: str
    x_px: int = 0
    y_px: int = 112
    radius_px: int = 0
    width_px: int = 320
    height_px: int = 240
    progressive: bool = False
    grey: bool = False

    @property
    def jpeg(self) -> bytes:
        """Drawn anew."""
        return encode_jpeg(self.width_px, self.height_px, self._scene(), progressive=self.progressive)

    def _scene(self) -> Scene:
        last = 1 if self.grey else 3
        ball, room, every = _YELLOW[:last], _ROOM[:last], _FINE * _FINE
        mixed = [tuple((one * share + other * (every - share) + every // 2) // every
                       for one, other in zip(ball, room, strict=True)) for share in range(every + 1)]
        return lambda x, y: mixed[self._covered(x, y)]

    def _covered(self, x: int, y: int) -> int:
        """How many of the pixel's samples lie on the ball; the centre is a pixel's corner."""
        if not self.radius_px or abs(x - self.x_px) > self.radius_px or abs(y - self.y_px) > self.radius_px:
            return 0
        reach = (2 * _FINE * self.radius_px) ** 2
        return sum(
            (2 * (_FINE * (x - self.x_px) + i) + 1) ** 2 + (2 * (_FINE * (y - self.y_px) + j) + 1) ** 2 <= reach
            for i in range(_FINE) for j in range(_FINE)
        )


DRAWINGS: Final = {
    "left": Drawing("the target left of the middle, about a metre away", 104, radius_px=20),
    "right": Drawing("the target right of the middle, as far", 216, radius_px=20),
    "centre": Drawing("the target straight ahead, two metres away", 160, radius_px=10),
    "absent": Drawing("no target"),
    "left_progressive": Drawing("the same as `left`, written in several passes", 104, radius_px=20, progressive=True),
    "left_half": Drawing("the same view with half as many pixels each way", 52, 56, 10, 160, 120),
    "grey": Drawing("one component: a picture without colours", 104, radius_px=20, grey=True),
}


@cache
def picture(name: str) -> bytes:
    """The file's bytes. Raises KeyError for a name that is none."""
    if name not in DRAWINGS:
        raise KeyError(name)
    return (HERE / f"{name}.jpg").read_bytes()


# --- no pictures -----------------------------------------------------------------------------------------------------


def claiming(width_px: int, height_px: int, *, bits: int = 8, components: int = 3, marker: int = 0xC0) -> bytes:
    """A JPEG that claims a size, and has no pixels: 21 bytes for three components."""
    body = bytes((bits, *height_px.to_bytes(2), *width_px.to_bytes(2), components)) + b"\x01\x11\x00" * components
    return b"\xff\xd8\xff" + bytes((marker,)) + (len(body) + 2).to_bytes(2) + body


def commented(jpeg: bytes, comments: int, size: int = 0) -> bytes:
    """`jpeg` with so many comments of `size` bytes before its first segment."""
    return jpeg[:2] + (b"\xff\xfe" + (size + 2).to_bytes(2) + bytes(size)) * comments + jpeg[2:]


def many_scans(jpeg: bytes, scans: int) -> bytes:
    """A progressive `jpeg` whose last scan comes over and over: each costs a decoder a pass over the whole picture."""
    last = jpeg.rfind(b"\xff\xda")
    empty = jpeg[last : last + 2 + int.from_bytes(jpeg[last + 2 : last + 4])]
    return jpeg[:-2] + empty * scans + jpeg[-2:]


def png() -> bytes:
    """One grey pixel, in a format that is not the protocol's."""
    parts = ((b"IHDR", (1).to_bytes(4) * 2 + b"\x08\0\0\0\0"), (b"IDAT", zlib.compress(b"\0\x80")), (b"IEND", b""))
    chunks = (len(body).to_bytes(4) + kind + body + zlib.crc32(kind + body).to_bytes(4) for kind, body in parts)
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


# --- the files -------------------------------------------------------------------------------------------------------


def differing() -> list[str]:
    """Names of files that are not what this code draws, are missing, or are left over."""
    found = {path.stem: path.read_bytes() for path in HERE.glob("*.jpg")}
    drawn = {name: drawing.jpeg for name, drawing in DRAWINGS.items()}
    return sorted(name for name in found.keys() | drawn.keys() if found.get(name) != drawn.get(name))


def write() -> None:
    """Make the files what this code draws."""
    HERE.mkdir(exist_ok=True)
    for path in HERE.glob("*.jpg"):
        path.unlink()
    for name, drawing in DRAWINGS.items():
        (HERE / f"{name}.jpg").write_bytes(drawing.jpeg)


def main(arguments: Sequence[str]) -> int:
    """`--write` or `--verify`; 5 if a file differs."""
    if list(arguments) == ["--write"]:
        write()
    elif list(arguments) != ["--verify"]:
        print("usage: python -m sightline.protocol.conformance.vision_pictures --write | --verify", file=sys.stderr)
        return 2
    names = differing()
    if names:
        print(f"{HERE}: not what the code draws: {', '.join(names)}; run with --write", file=sys.stderr)
    return 5 if names else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
