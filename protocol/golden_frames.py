"""Golden cases of frames: headers and pictures. Pure."""

from sightline.protocol.spec.message_cases import (
    ANSWER,
    FRAME_HEADER,
    INEXACT,
    MALFORMED,
    PEER,
    STAMP,
    MessageCase,
    case,
    jpeg,
    segments,
    without,
)


def frames() -> list[MessageCase]:
    return [
        case("frame", "stamp_only", "odometry and latency may be left out", header=STAMP),
        case("frame", "latency_null", "null is as good as absent", header=FRAME_HEADER | {"latency_us": None}),
        case("frame", "seq_max", "the largest integer", header=FRAME_HEADER | {"seq": 2**53 - 1}),
        case("frame", "seq_real", "7.0 is no integer", MALFORMED, header=FRAME_HEADER | {"seq": 7.0}),
        case("frame", "time_true", "true is no integer", MALFORMED, header=FRAME_HEADER | {"t_us": True}),
        case("frame", "pose_of_two", "a pose has three numbers", MALFORMED, header=FRAME_HEADER | {"pose": [0, 0]}),
        case("frame", "pose_far", "numbers end at a million", MALFORMED, header=FRAME_HEADER | {"pose": [2e6, 0, 0]}),
        case("frame", "pose_nan", "NaN in a header", MALFORMED, header=FRAME_HEADER | {"pose": [float("nan"), 0, 0]}),
        case("frame", "no_header", "a frame needs its header", MALFORMED, header=b""),
        case("frame", "header_array", "a header is an object", MALFORMED, header=b"[1]"),
        case("frame", "header_not_utf8", "a header is UTF-8", MALFORMED, header=b'{"v":1,"session":"\xff"}'),
        case("frame", "no_time", "a frame without its time", MALFORMED, header=without(FRAME_HEADER, "t_us")),
        case("frame", "other_session", "of another start", header=FRAME_HEADER | {"session": PEER}),
        case("frame", "with_source", "a robot's key has no role", INEXACT, key="sightline/r1/frame/vision"),
        case("frame", "robot_wildcard", "a wildcard for the robot", INEXACT, key="sightline/*/frame"),
        case("frame", "foreign_prefix", "another prefix", INEXACT, key="starline/r1/frame"),
    ]


def pictures() -> list[MessageCase]:
    return [
        case("frame", "jpeg_progressive", "SOF2", payload=jpeg(320, 240, 0xC2)),
        case("frame", "jpeg_grey", "one component", payload=jpeg(320, 240, components=1)),
        case("frame", "jpeg_full_hd", "as many pixels as allowed by default", payload=jpeg(1920, 1080)),
        case("frame", "jpeg_one_row_more", "a row over the bound", MALFORMED, payload=jpeg(1920, 1081)),
        case("frame", "jpeg_bomb", "65500 x 65500 in 21 bytes", MALFORMED, payload=jpeg(65_500, 65_500)),
        case("frame", "jpeg_zero_width", "no width", MALFORMED, payload=jpeg(0, 480)),
        case("frame", "jpeg_zero_height", "no height", MALFORMED, payload=jpeg(640, 0)),
        case("frame", "jpeg_cmyk", "four components", MALFORMED, payload=jpeg(640, 480, components=4)),
        case("frame", "jpeg_12_bit", "12 bits", MALFORMED, payload=jpeg(640, 480, bits=12)),
        case("frame", "jpeg_lossless", "SOF3", MALFORMED, payload=jpeg(640, 480, 0xC3)),
        case("frame", "jpeg_arithmetic", "SOF9", MALFORMED, payload=jpeg(640, 480, 0xC9)),
        case("frame", "jpeg_scan_first", "SOS before SOF", MALFORMED, payload=b"\xff\xd8\xff\xda\x00\x08" + bytes(6)),
        case("frame", "jpeg_63_segments", "63 segments, then SOF", payload=segments(63)),
        case("frame", "jpeg_64_segments", "64 segments before SOF", MALFORMED, payload=segments(64)),
        case("frame", "jpeg_segment_short", "length 1", MALFORMED, payload=b"\xff\xd8\xff\xfe\x00\x01" + bytes(8)),
        case("frame", "jpeg_segment_past_end", "too long", MALFORMED, payload=b"\xff\xd8\xff\xfe\xff\xff" + bytes(8)),
        case("frame", "jpeg_fill_byte", "0xFF before a marker", payload=b"\xff\xd8\xff" + jpeg(640, 480)[2:]),
        case("frame", "jpeg_cut_in_sof", "cut in the frame header", MALFORMED, payload=jpeg(640, 480)[:11]),
        case("frame", "jpeg_soi_only", "nothing after SOI", MALFORMED, payload=b"\xff\xd8"),
        case("frame", "jpeg_empty", "no bytes", MALFORMED, payload=b""),
        case("frame", "png", "another format", MALFORMED, payload=b"\x89PNG\r\n\x1a\n" + bytes(24)),
    ]


def views() -> list[MessageCase]:
    """Pictures that vision made for people."""
    return [
        case("overlay", "without_echo", "for showing only", header=without(ANSWER, "echo")),
        case("overlay", "no_role", "a key without its role", INEXACT, key="sightline/r1/overlay"),
        case("overlay", "jpeg_bomb", "65500 x 65500", MALFORMED, payload=jpeg(65_500, 65_500)),
        case("overlay", "jpeg_empty", "no bytes", MALFORMED, payload=b""),
        case("preview", "without_echo", "for showing only", header=without(ANSWER, "echo")),
        case("preview", "no_role", "a key without its role", INEXACT, key="sightline/r1/preview"),
        case("preview", "png", "another format", MALFORMED, payload=b"\x89PNG\r\n\x1a\n" + bytes(24)),
        case("preview", "jpeg_cut_in_sof", "cut in the frame header", MALFORMED, payload=jpeg(320, 240)[:11]),
    ]
