"""Draws the kit's images with integers alone, and compares the files with them. Shell (files).

    python -m tests.conformance.vision.drawing --verify     the files are what this code draws
    python -m tests.conformance.vision.drawing --write

Baseline or progressive (spectral selection), every component at full size, 8 bits: ITU-T T.81. The Huffman tables give
all symbols codes of one length: legal, a little larger than the usual ones, and nothing to look up.
"""

import math
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from sightline.conformance.vision.images import FOLDER

Pixel = tuple[int, ...]
"""Y, Cb, Cr, each 0 to 255; or Y alone for a grey picture."""
Scene = Callable[[int, int], Pixel]
"""The colour at column, row."""
Blocks = list[list[int]]
"""Quantised coefficients in zigzag order, one list per block, left to right and top to bottom."""

_BITS = 13
_HALF_COSINE = (4096, 4017, 3784, 3406, 2896, 2276, 1567, 799, 0)
"""cos(k pi / 16) / 2 in units of 2**-13; the row of zero frequency takes 1 / sqrt(8), which is that of k = 4."""
_QUANTISER = 6
"""One step for all frequencies: fine enough that a disc's edge stays where it was drawn."""
_ZIGZAG = sorted(range(64), key=lambda i: (i // 8 + i % 8, i // 8 if (i // 8 + i % 8) % 2 else i % 8))
_DC_SYMBOLS = tuple(range(12))
_AC_SYMBOLS = (0x00, 0xF0, *(run << 4 | size for run in range(16) for size in range(1, 11)))
_DC_LENGTH, _AC_LENGTH = 4, 8


def _half_cosine(k: int) -> int:
    k %= 32
    if k > 16:
        k = 32 - k
    return _HALF_COSINE[k] if k <= 8 else -_HALF_COSINE[16 - k]


_TRANSFORM = tuple(tuple(_half_cosine(4 if u == 0 else (2 * x + 1) * u) for x in range(8)) for u in range(8))


def encode_jpeg(width_px: int, height_px: int, scene: Scene, *, progressive: bool = False) -> bytes:
    """`scene` as a JPEG; grey if its pixels have one component."""
    rows = [[scene(x, y) for x in range(width_px)] for y in range(height_px)]
    components = len(rows[0][0])
    planes = [_blocks(rows, which) for which in range(components)]
    scans = _progressive_scans(planes) if progressive else _baseline_scan(planes)
    head = (b"\xff\xd8", _segment(0xDB, b"\0" + bytes([_QUANTISER]) * 64),
            _segment(0xC2 if progressive else 0xC0, _frame_header(width_px, height_px, components)),
            _segment(0xC4, _table(0x00, _DC_LENGTH, _DC_SYMBOLS) + _table(0x10, _AC_LENGTH, _AC_SYMBOLS)))
    return b"".join((*head, *scans, b"\xff\xd9"))


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body


def _frame_header(width_px: int, height_px: int, components: int) -> bytes:
    each = b"".join(bytes((number + 1, 0x11, 0)) for number in range(components))
    return struct.pack(">BHHB", 8, height_px, width_px, components) + each


def _table(kind: int, length: int, symbols: Sequence[int]) -> bytes:
    return bytes((kind, *(len(symbols) if bits == length else 0 for bits in range(1, 17)), *symbols))


# --- pixels to coefficients ------------------------------------------------------------------------------------------


def _blocks(rows: Sequence[Sequence[Pixel]], which: int) -> Blocks:
    """Split one component into blocks. Raises ValueError for an image without a whole number of blocks."""
    if len(rows) % 8 or len(rows[0]) % 8:
        raise ValueError(f"{len(rows[0])}x{len(rows)} pixels do not divide into blocks of 8x8")
    return [
        _coefficients([pixel[which] - 128 for row in rows[top : top + 8] for pixel in row[left : left + 8]])
        for top in range(0, len(rows), 8) for left in range(0, len(rows[0]), 8)
    ]


def _coefficients(block: list[int]) -> list[int]:
    if min(block) == max(block):  # most of a plain room
        return [_quantised(8 * block[0] << 2 * _BITS)] + [0] * 63
    rows = [[sum(t * block[8 * y + x] for x, t in enumerate(basis)) for basis in _TRANSFORM] for y in range(8)]
    found = [[sum(t * rows[y][u] for y, t in enumerate(basis)) for u in range(8)] for basis in _TRANSFORM]
    return [_quantised(found[at // 8][at % 8]) for at in _ZIGZAG]


def _quantised(value: int) -> int:
    step = _QUANTISER << 2 * _BITS
    return (abs(value) + step // 2) // step * (1 if value >= 0 else -1)


# --- coefficients to bits --------------------------------------------------------------------------------------------


class _Bits:
    """Bits into bytes, with a zero byte after each 0xFF."""

    def __init__(self) -> None:
        self._value = self._count = 0

    def put(self, value: int, count: int) -> None:
        """Append the lowest `count` bits of `value`."""
        self._value = self._value << count | value
        self._count += count

    def number(self, value: int, size: int) -> None:
        """Append a coefficient of `size` bits as T.81 F.1.2.1 writes it."""
        self.put(value if value >= 0 else value + (1 << size) - 1, size)

    def done(self) -> bytes:
        """All bytes, the last filled with ones."""
        fill = -self._count % 8
        self.put((1 << fill) - 1, fill)
        return self._value.to_bytes(self._count // 8).replace(b"\xff", b"\xff\x00")


def _baseline_scan(planes: Sequence[Blocks]) -> Iterator[bytes]:
    bits, before = _Bits(), [0] * len(planes)
    for blocks in zip(*planes, strict=True):
        for which, block in enumerate(blocks):
            _put_dc(bits, block[0] - before[which])
            _put_ac(bits, block)
            before[which] = block[0]
    yield _segment(0xDA, _scan_header(range(len(planes)), 0, 63)) + bits.done()


def _progressive_scans(planes: Sequence[Blocks]) -> Iterator[bytes]:
    bits, before = _Bits(), [0] * len(planes)
    for blocks in zip(*planes, strict=True):
        for which, block in enumerate(blocks):
            _put_dc(bits, block[0] - before[which])
            before[which] = block[0]
    yield _segment(0xDA, _scan_header(range(len(planes)), 0, 0)) + bits.done()
    for which, plane in enumerate(planes):
        bits = _Bits()
        for block in plane:
            _put_ac(bits, block)
        yield _segment(0xDA, _scan_header((which,), 1, 63)) + bits.done()


def _scan_header(components: Sequence[int], first: int, last: int) -> bytes:
    each = b"".join(bytes((which + 1, 0x00)) for which in components)
    return bytes((len(components),)) + each + bytes((first, last, 0))


def _put_dc(bits: _Bits, difference: int) -> None:
    size = abs(difference).bit_length()
    bits.put(_DC_SYMBOLS.index(size), _DC_LENGTH)
    bits.number(difference, size)


def _put_ac(bits: _Bits, block: Sequence[int]) -> None:
    run = 0
    for value in block[1:]:
        if value == 0:
            run += 1
            continue
        while run > 15:
            bits.put(_AC_SYMBOLS.index(0xF0), _AC_LENGTH)
            run -= 16
        size = abs(value).bit_length()
        bits.put(_AC_SYMBOLS.index(run << 4 | size), _AC_LENGTH)
        bits.number(value, size)
        run = 0
    if run:
        bits.put(_AC_SYMBOLS.index(0x00), _AC_LENGTH)


_YELLOW: Final[Pixel] = (191, 28, 165)
"""Y, Cb, Cr of the default target's colour: hue 49 degrees, well saturated."""
_BLACK: Final[Pixel] = (0, 128, 128)
_ROOM: Final[Pixel] = (150, 122, 131)
_FULL: Final = 1000
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
        """Draw the image again at each access."""
        return encode_jpeg(self.width_px, self.height_px, self.scene(), progressive=self.progressive)

    def scene(self) -> Scene:
        last = 1 if self.grey else 3
        ball, dark, room, every = _YELLOW[:last], _BLACK[:last], _ROOM[:last], _FINE * _FINE

        def color(x: int, y: int) -> Pixel:
            share = self._covered(x, y)
            light = self._light(x, y) if share else 0
            lit = (black + (one - black) * light // _FULL for one, black in zip(ball, dark, strict=True))
            return tuple((one * share + other * (every - share) + every // 2) // every
                         for one, other in zip(lit, room, strict=True))

        return color

    def _light(self, x: int, y: int) -> int:
        """The brightness of the ball there, of `_FULL`: a lamp above, a little to the left and behind the camera."""
        right, down, radius = 2 * (x - self.x_px) + 1, 2 * (y - self.y_px) + 1, 2 * self.radius_px
        ahead = math.isqrt(max(0, radius**2 - right**2 - down**2))
        return min(_FULL, 350 + 6500 * max(0, 5 * ahead - 3 * right - 8 * down) // (99 * radius))

    def _covered(self, x: int, y: int) -> int:
        """Count the pixel's samples that lie on the ball; the center is a pixel's corner."""
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
    "far": Drawing("the target straight ahead, three metres away", 160, radius_px=7),
    "near_left": Drawing("the target left of the middle, 0.6 m away", 104, 120, 32),
    "near_right": Drawing("the target right of the middle, as near", 216, 120, 32),
    "absent": Drawing("no target"),
    "left_progressive": Drawing("the same as `left`, written in several passes", 104, radius_px=20, progressive=True),
    "left_half": Drawing("the same view with half as many pixels each way", 52, 56, 10, 160, 120),
    "right_half": Drawing("the same, of the target at the right", 108, 56, 10, 160, 120),
    "grey": Drawing("one component: a picture without colours", 104, radius_px=20, grey=True),
}


# --- the files -------------------------------------------------------------------------------------------------------


def differing() -> list[str]:
    """Names of files that are not what this code draws, are missing, or are left over."""
    found = {path.stem: path.read_bytes() for path in FOLDER.glob("*.jpg")}
    drawn = {name: drawing.jpeg for name, drawing in DRAWINGS.items()}
    return sorted(name for name in found.keys() | drawn.keys() if found.get(name) != drawn.get(name))


def write() -> None:
    """Make the files what this code draws."""
    FOLDER.mkdir(exist_ok=True)
    for path in FOLDER.glob("*.jpg"):
        path.unlink()
    for name, drawing in DRAWINGS.items():
        (FOLDER / f"{name}.jpg").write_bytes(drawing.jpeg)


def main(arguments: Sequence[str]) -> int:
    """`--write` or `--verify`; 5 if a file differs."""
    if list(arguments) == ["--write"]:
        write()
    elif list(arguments) != ["--verify"]:
        print("usage: python -m tests.conformance.vision.drawing --write | --verify", file=sys.stderr)
        return 2
    names = differing()
    if names:
        print(f"{FOLDER}: not what the code draws: {', '.join(names)}; run with --write", file=sys.stderr)
    return 5 if names else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
