"""Every number of the twist grammar and of the JPEG bound: just inside, at it, just outside."""

import pytest

from sightline.protocol.errors import RejectReason, WireError
from sightline.protocol.jpeg import JpegSize, read_jpeg_size
from sightline.protocol.messages import Twist
from sightline.protocol.text import format_twist, parse_twist


def twist(linear_mps, angular_rad_s):
    return Twist(linear_mps=linear_mps, angular_rad_s=angular_rad_s)


def refusal(parse, *args):
    with pytest.raises(WireError) as caught:
        parse(*args)
    return caught.value


# --- twist text --------------------------------------------------------------------------------------------------

READ = {
    "0": 0.0, "9": 9.0, "0123456789": 123456789.0, "12": 12.0, "1.": 1.0, "1.09": 1.09, "1.90": 1.9, ".5": 0.5,
    ".0": 0.0, ".9": 0.9, ".09": 0.09, "+1": 1.0, "-1": -1.0, "+.5": 0.5, "-1.5": -1.5, "1e3": 1e3, "1E3": 1e3,
    "1e0": 1.0, "9e9": 9e9, "1e+3": 1e3, "1e-3": 1e-3, "1e12": 1e12, "1e308": 1e308, "1e-099": 1e-99, "1.e1": 10.0,
    "1.5e-2": 0.015, ".5E+1": 5.0, "-.5e1": -5.0, "2.3028209556706964": 2.3028209556706964,
}  # fmt: skip
NOT_READ = [
    "", "+", "-", ".", "e1", ".e1", "1e", "1e+", "1e-", "1e1234", "1e0000", "++1", "--1", "1..", "1.1.1", "..1",
    "1e1.5", "1_0", " 1", "1 ", "1\n", "0x1", "1f", "/1", ":1", "1/", "1:", ".:", "1./", "1e/", "1e:", "e", "1d3",
    "1ee3", "1e++1", "1 2", "\u0661", "\uff11", "True", "nano", "xinf", "infinit", "infx",
]  # fmt: skip


@pytest.mark.parametrize("text", READ)
def test_numbers_of_the_grammar_are_read_on_either_side(text):
    assert parse_twist(f"{text}|0".encode()) == twist(READ[text], 0.0)
    assert parse_twist(f"0|{text}".encode()) == twist(0.0, READ[text])


@pytest.mark.parametrize("text", NOT_READ)
def test_all_other_numbers_are_malformed_on_either_side(text):
    for data in (f"{text}|0", f"0|{text}"):
        error = refusal(parse_twist, data.encode())
        assert error.reason is RejectReason.MALFORMED
        assert "linear|angular" in error.detail


@pytest.mark.parametrize(
    "data", [b"", b"|", b"||", b"1", b"1|2|3", b"1||2", b"|1|2", b"1|2|", b"12", b"1-2", b"nan", b"nan|1|1"]
)
def test_other_counts_of_fields_are_malformed(data):
    assert refusal(parse_twist, data).reason is RejectReason.MALFORMED


@pytest.mark.parametrize(
    "text", ["nan", "inf", "infinity", "+nan", "-inf", "NaN", "INF", "+Infinity", "1e309", "-1e309", "1e400", "9e999"]
)
def test_number_that_is_not_finite_is_named(text):
    for data in (f"{text}|0", f"0|{text}", f"{text}|{text}", f"{text}|nonsense" if "e" not in text else f"{text}|1"):
        assert refusal(parse_twist, data.encode()).reason is RejectReason.NOT_FINITE


@pytest.mark.parametrize(
    ("size", "reason"), [(63, None), (64, None), (65, RejectReason.MALFORMED), (257, RejectReason.MALFORMED)]
)
def test_the_text_is_at_most_64_bytes(size, reason):
    data = b"1|" + b"0" * (size - 2)
    if reason is None:
        assert parse_twist(data) == twist(1.0, 0.0)
    else:
        error = refusal(parse_twist, data)
        assert error.reason is reason and str(size) in error.detail and "64" in error.detail


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0.0000"),
        (-0.0, "0.0000"),
        (-4.9e-5, "0.0000"),
        (-5.1e-5, "-0.0001"),
        (4.9e-5, "0.0000"),
        (5.1e-5, "0.0001"),
        (-0.35, "-0.3500"),
        (1e4, "10000.0000"),
    ],
)
def test_a_twist_is_written_with_four_decimals_and_never_minus_zero(value, text):
    assert format_twist(twist(value, 0.25)) == f"{text}|0.2500".encode()
    assert format_twist(twist(0.25, value)) == f"0.2500|{text}".encode()


# --- the picture's header ----------------------------------------------------------------------------------------


def frame_header(width=320, height=240, *, marker=0xC0, bits=8, components=3, length=17):
    head = bytes([0xFF, marker]) + length.to_bytes(2) + bytes([bits]) + height.to_bytes(2) + width.to_bytes(2)
    return head + bytes([components])


def picture(*parts):
    return b"\xff\xd8" + b"".join(parts)


def segment(marker, length, filled=None):
    return bytes([0xFF, marker]) + length.to_bytes(2) + bytes(length - 2 if filled is None else filled)


@pytest.mark.parametrize(
    ("width", "height", "bound", "fits"),
    [
        (1, 1, 1, True), (1, 2, 1, False), (2, 1, 1, False), (0, 1, 1, False), (1, 0, 1, False), (0, 0, 1, False),
        (2, 3, 6, True), (3, 2, 5, False), (65_535, 1, 65_535, True), (1, 65_535, 65_535, True),
        (65_535, 65_535, 65_535**2, True), (65_535, 65_535, 65_535**2 - 1, False), (0x0102, 0x0304, 10**6, True),
    ],
)  # fmt: skip
def test_the_bound_is_exact_in_pixels(width, height, bound, fits):
    data = picture(frame_header(width, height))
    if fits:
        assert read_jpeg_size(data, bound) == JpegSize(width, height, 3)
    else:
        error = refusal(read_jpeg_size, data, bound)
        assert f"{width}x{height}" in error.detail and error.reason is RejectReason.MALFORMED


@pytest.mark.parametrize(
    ("width", "height", "fits"),
    [
        (1920, 1080, True),
        (1920, 1081, False),
        (1921, 1080, False),
        (2_073_600 // 64, 64, True),
        (14_918, 139, False),
        (15_829, 131, True),
    ],
)
def test_the_default_bound_is_full_hd(width, height, fits):
    data = picture(frame_header(width, height))
    assert read_jpeg_size(data).width_px == width if fits else refusal(read_jpeg_size, data)


def test_each_marker_is_a_frame_header_rejected_alone_or_a_segment():
    for marker in range(256):
        check_marker(marker)


def check_marker(marker):
    behind = frame_header(7, 5)
    if marker in (0xC0, 0xC1, 0xC2):
        assert read_jpeg_size(picture(frame_header(9, 4, marker=marker), behind)) == JpegSize(9, 4, 3)
    elif marker in (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF, 0xDA):
        assert f"0x{marker:02X}" in refusal(read_jpeg_size, picture(segment(marker, 4), behind)).detail
    elif marker == 0x01 or 0xD0 <= marker <= 0xD8:
        assert read_jpeg_size(picture(bytes([0xFF, marker]), behind)) == JpegSize(7, 5, 3)
    elif marker == 0xFF:
        assert read_jpeg_size(picture(b"\xff\xff\xff", behind)) == JpegSize(7, 5, 3)
    else:
        assert read_jpeg_size(picture(segment(marker, 4), behind)) == JpegSize(7, 5, 3)


@pytest.mark.parametrize(
    ("length", "fits"), [(0, False), (1, False), (2, True), (3, True), (0x0102, True), (65_535, True)]
)
def test_a_segment_is_at_least_its_own_length_field(length, fits):
    data = picture(segment(0xE0, length, max(0, length - 2)), frame_header(7, 5))
    if fits:
        assert read_jpeg_size(data) == JpegSize(7, 5, 3)
    else:
        error = refusal(read_jpeg_size, data)
        assert f"length {length} at byte 2" in error.detail


@pytest.mark.parametrize("bits", [0, 7, 8, 9, 12, 255])
@pytest.mark.parametrize("components", [0, 1, 2, 3, 4, 255])
def test_eight_bits_and_one_or_three_components(bits, components):
    data = picture(frame_header(7, 5, bits=bits, components=components))
    if bits == 8 and components in (1, 3):
        assert read_jpeg_size(data) == JpegSize(7, 5, components)
    else:
        error = refusal(read_jpeg_size, data)
        assert f"{bits} bits and {components} components" in error.detail


@pytest.mark.parametrize("ahead", [b"", segment(0xE0, 9)])
def test_an_image_cut_anywhere_before_its_size_is_rejected(ahead):
    whole = picture(ahead, frame_header(7, 5))
    for size in range(len(whole)):
        what = refusal(read_jpeg_size, whole[:size]).detail
        assert ("SOI" in what) == (size < 2)
        assert ("cut short" in what) == (2 + len(ahead) + 4 <= size)
    assert read_jpeg_size(whole) == JpegSize(7, 5, 3)


@pytest.mark.parametrize("start", [b"", b"\xff", b"\xd8\xff", b"\x89PNG", b"\xff\xd9", b"\xfe\xd8", b"\x00\xff\xd8"])
def test_an_image_starts_with_soi(start):
    assert "SOI" in refusal(read_jpeg_size, start + frame_header()).detail


def test_segments_begin_with_ff():
    assert "broken segment at byte 2" in refusal(read_jpeg_size, picture(b"\xfe\xe0\x00\x02", frame_header())).detail
    assert "broken segment at byte 7" in refusal(read_jpeg_size, picture(segment(0xE0, 3), b"\x00" * 20)).detail


@pytest.mark.parametrize(("count", "fits"), [(0, True), (62, True), (63, True), (64, False), (65, False)])
def test_at_most_64_segments_the_frame_header_included(count, fits):
    data = picture(segment(0xE0, 2) * count, frame_header(7, 5))
    if fits:
        assert read_jpeg_size(data) == JpegSize(7, 5, 3)
    else:
        assert "more than 64 segments" in refusal(read_jpeg_size, data).detail
