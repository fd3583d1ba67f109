"""Cases on invalid headers, cameras, keys and images. Pure."""

from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any, Final

from sightline.conformance.case import Bench, Level, Suite
from sightline.conformance.vision.fixture import ANSWER_US, RobotPlayed, met
from sightline.conformance.vision.images import (
    CAMERA as LENS,
)
from sightline.conformance.vision.images import (
    HALF_CAMERA,
    claiming,
    commented,
    filled,
    many_scans,
    picture,
    png,
)
from sightline.protocol.channels import CAMERA, FRAME, MAX_HEADER_BYTES, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.spec.message_cases import packed

SUITE = Suite("V")
_JSON, _NUMBERS, _VERSION, _FIELDS = "2.1 JSON", "2.2 Numbers", "2.4 Version", "2.8 Fields"
_SESSION, _CAMERA = "2.5 Session and sequence", "10.1 Camera, odometry, scan"
_NOISE: Final = 600
Fields = dict[str, Any]


def _without(fields: Fields, name: str) -> Fields:
    return {one: value for one, value in fields.items() if one != name}


HEADERS: Final[dict[str, tuple[str, str, Callable[[Fields], bytes]]]] = {
    "V-HOST-01": ("An empty header", _JSON, lambda _: b""),
    "V-HOST-02": ("A header cut short", _JSON, lambda it: packed(it)[:-1]),
    "V-HOST-03": ("A header that is a list", _JSON, lambda it: b"[" + packed(it) + b"]"),
    "V-HOST-04": ("A header that is not UTF-8", _JSON, lambda it: packed(it)[:-1] + b',"x":"\xff\xfe"}'),
    "V-HOST-05": ("A header with a byte order mark", _JSON, lambda it: b"\xef\xbb\xbf" + packed(it)),
    "V-HOST-06": ("Something after the header's object", _JSON, lambda it: packed(it) + b"{}"),
    "V-HOST-07": ("Version 2", _VERSION, lambda it: packed(it | {"v": 2})),
    "V-HOST-08": ("Version 0", _VERSION, lambda it: packed(it | {"v": 0})),
    "V-HOST-09": ("A version that is a text", _VERSION, lambda it: packed(it | {"v": "1"})),
    "V-HOST-10": ("A negative `seq`", _NUMBERS, lambda it: packed(it | {"seq": -it["seq"]})),
    "V-HOST-11": ("A `seq` of 2^53", _NUMBERS, lambda it: packed(it | {"seq": 2**53})),
    "V-HOST-12": ("A `seq` that is a text", _JSON, lambda it: packed(it | {"seq": str(it["seq"])})),
    "V-HOST-13": ("A `seq` that is a real number", _NUMBERS, lambda it: packed(it | {"seq": float(it["seq"])})),
    "V-HOST-14": ("A time that is `true`", _NUMBERS, lambda it: packed(it | {"t_us": True})),
    "V-HOST-15": ("A session in upper case", _SESSION, lambda it: packed(it | {"session": "ABCDEF01"})),
    "V-HOST-16": ("A session of seven digits", _SESSION, lambda it: packed(it | {"session": it["session"][:7]})),
    "V-HOST-17": ("A frame without its time", _FIELDS, lambda it: packed(_without(it, "t_us"))),
    "V-HOST-18": ("A frame without its `seq`", _FIELDS, lambda it: packed(_without(it, "seq"))),
    "V-HOST-19": ("A frame without its session", _FIELDS, lambda it: packed(_without(it, "session"))),
    "V-HOST-20": ("A pose of two numbers", _FIELDS, lambda it: packed(it | {"pose": [0, 0]})),
    "V-HOST-21": ("A pose that is not a number", _NUMBERS, lambda it: packed(it | {"pose": [float("nan"), 0, 0]})),
    "V-HOST-22": ("A pose ten thousand kilometres away", _FIELDS, lambda it: packed(it | {"pose": [1e7, 0, 0]})),
    "V-HOST-23": ("`null` where no null belongs", _JSON, lambda it: packed(it | {"moving": None})),
    "V-HOST-24": ("Brackets in brackets, 150 deep, and one left open", _JSON,
                  lambda it: packed(it)[:-1] + b',"x":' + b"[" * 150 + b"]" * 149 + b"}"),
    "V-HOST-25": ("A version that is `true`", _VERSION, lambda it: packed(it | {"v": True})),
    "V-HOST-26": ("A version 1.0", _VERSION, lambda it: packed(it | {"v": 1.0})),
    "V-HOST-27": ("An `applied` of one number", _FIELDS, lambda it: packed(it | {"applied": [0]})),
    "V-HOST-28": ("A negative `latency_us`", _FIELDS, lambda it: packed(it | {"latency_us": -1})),
    "V-HOST-29": ("A `moving` that is a text", _JSON, lambda it: packed(it | {"moving": "0,0"})),
    "V-HOST-30": ("A `seq` with an exponent", _NUMBERS,
                  lambda it: packed(it).replace(b'"seq":%d' % it["seq"], b'"seq":%de0' % it["seq"])),
}
"""Headers that make a frame invalid: title, clause, header."""


def _header_drives_nothing(write: Callable[[Fields], bytes], title: str, robot: RobotPlayed) -> None:
    bench = robot.bench
    for _ in range(2):
        mark = bench.mark()
        header = write(robot.next_fields())
        bench.need(len(header) <= MAX_HEADER_BYTES, "this header is too long to be sent")
        robot.frame("left", header=header)
        bench.rest(ANSWER_US // 4)
        drove = any(one.is_twist for one in robot.answers_to_others(mark))
        bench.expect(not drove, f"it drove by this: {title}")


SUITE.must_all(met, {
    number: (clause, f"{title} drives nothing.", partial(_header_drives_nothing, write, title))
    for number, (title, clause, write) in HEADERS.items()
})


@SUITE.must("V-HOST-31", "13.2 Bounds", met)
def all_headers_and_well(bench: Bench, robot: RobotPlayed) -> None:
    """After every broken header, plain frames are answered as before."""
    for _, _, write in HEADERS.values():
        robot.frame("left", header=write(robot.next_fields()))
        bench.rest(20_000)
    robot.expect_driven("broken headers")


@SUITE.must("V-HOST-32", "13.2 Bounds")
def noise(bench: Bench) -> None:
    """After hundreds of random messages on the robot's channels, plain frames are answered as before."""
    random = Random(bench.now_us)
    robot = RobotPlayed(bench).met()
    good = {FRAME: picture("left"), CAMERA: encode(LENS), STATUS: packed({"state": "HOLD", "reason": "x"})}
    for number in range(_NOISE):
        channel = random.choice((FRAME, CAMERA, STATUS))
        header = _damaged(random, encode(robot.stamp()))
        bench.publish(channel, header, _damaged(random, good[channel]))
        if number % 10 == 9:
            bench.rest(5_000)
    robot.show(LENS)
    robot = RobotPlayed(bench)
    robot.expect_driven("random messages")


def _damaged(random: Random, data: bytes) -> bytes:
    """Replace some bytes, cut the data, or randomize all of it."""
    kind = random.randrange(3)
    if kind == 0:
        return random.randbytes(random.randrange(200))
    if kind == 1:
        return data[: random.randrange(len(data))]
    changed = bytearray(data)
    for _ in range(1 + random.randrange(4)):
        changed[random.randrange(len(changed))] = random.randrange(256)
    return bytes(changed)


@SUITE.must("V-HOST-33", "13.2 Bounds", met)
def absurd_odometry(_bench: Bench, robot: RobotPlayed) -> None:
    """Odometry at its bounds, a thousand kilometres away at a million metres a second, gets a finite answer."""
    far: Fields = {"pose": (1e6, -1e6, 1e6), "moving": (1e6, -1e6), "applied": (-1e6, 1e6), "latency_us": 2**53 - 1}
    for _ in range(3):
        robot.answer_to(robot.frame("left", **far))
    robot.expect_driven("absurd odometry")
    robot.expect_finite()


# --- cameras ---------------------------------------------------------------------------------------------------------

_LENS: Final[Fields] = LENS.model_dump(mode="json")
_SMALL: Final[Fields] = HALF_CAMERA.model_dump(mode="json")
CAMERAS: Final[dict[str, tuple[str, str, bytes, Fields]]] = {
    "V-HOST-41": ("A camera model that is not JSON", _CAMERA, b"{width", {}),
    "V-HOST-42": ("A camera model without focal length", _CAMERA, packed(_SMALL | {"fx_px": 0}), {}),
    "V-HOST-43": ("A camera model 15 pixels wide", _CAMERA, packed(_SMALL | {"width_px": 15}), {}),
    "V-HOST-44": ("A camera model with nine terms of distortion", _CAMERA,
                  packed(_SMALL | {"distortion": [0.0] * 9}), {}),
    "V-HOST-45": ("A camera model with texts for numbers", _CAMERA, packed(_SMALL | {"height_px": "120"}), {}),
    "V-HOST-46": ("A camera model that is not a number", _CAMERA, packed(_SMALL | {"cx_px": float("nan")}), {}),
    "V-HOST-47": ("A camera model of version 2", _VERSION, packed(_SMALL), {"v": 2}),
    "V-HOST-48": ("A camera model with a negative `seq` in its header", _NUMBERS, packed(_SMALL), {"seq": -1}),
    "V-HOST-49": ("A camera model whose `fy_px` is zero", _CAMERA, packed(_SMALL | {"fy_px": 0}), {}),
    "V-HOST-50": ("A camera model with a text for the place of the lens", _CAMERA, packed(_SMALL | {"x_m": "0"}), {}),
    "V-HOST-52": ("A camera model whose `calibrated` is a number", _CAMERA, packed(_SMALL | {"calibrated": 1}), {}),
}
"""Camera models that must be rejected, since images would not fit: title, clause, payload, changes of the header."""


def _not_believed(payload: bytes, header: Fields, title: str, robot: RobotPlayed) -> None:
    robot.camera = None  # the valid model is not repeated
    robot.publish(CAMERA, payload, packed(robot.stamp().model_dump() | header))
    robot.film("centre", 4, 80_000)  # it may process cameras between frames only
    robot.expect_driven(title[0].lower() + title[1:])


SUITE.must_all(met, {
    number: (clause, f"{title} is not used.", partial(_not_believed, payload, header, title))
    for number, (title, clause, payload, header) in CAMERAS.items()
})


@SUITE.must("V-HOST-51", "13.2 Bounds", met)
def absurd_lens(_bench: Bench, robot: RobotPlayed) -> None:
    """A lens within the bounds and beyond reason gets finite answers: with a good one, twists come within a second."""
    for changes in ({"fx_px": 1e-3}, {"cx_px": 1e6, "cy_px": -1e6}, {"pitch_rad": 1e6}, {"distortion": (1e6,) * 8},
                    {"z_m": -1e6}):
        robot.show(LENS.model_copy(update=changes))
        robot.film("left", 3, 20_000)
    robot.show(LENS)
    sent = robot.film("left", 20, 50_000)
    robot.expect_any_twist(sent)
    robot.expect_finite()


# --- keys ------------------------------------------------------------------------------------------------------------

KEYS: Final = {
    "V-HOST-61": ("A frame under a wildcard", "sightline/*/frame"),
    "V-HOST-62": ("A frame of another robot", "sightline/another/frame"),
    "V-HOST-63": ("A frame under everything", "**"),
}


def _not_received(key: str, title: str, robot: RobotPlayed) -> None:
    bench, mark = robot.bench, robot.bench.mark()
    bench.put(key.replace("another", f"x{bench.robot}"[:32]), packed(robot.next_fields()), picture("left"))
    bench.rest(ANSWER_US)
    bench.expect(not robot.answers_to_others(mark), f"it answered this: {title}")


SUITE.must_all(met, {
    number: ("1.3 Keys", f"{title} is not this robot's.", partial(_not_received, key, title))
    for number, (title, key) in KEYS.items()
})


# Cases about images: those that must be rejected before decoding, and unusual valid ones. Pure.


_CHECK: Final = "3.2 Bounds check"
_SCANS: Final = 4_000
_LARGE_SEGMENTS: Final = 3
_LARGEST_SEGMENTS: Final = 6


def _cut(share: float) -> bytes:
    whole = picture("left")
    return whole[: int(len(whole) * share)]


REJECTED: Final[dict[str, tuple[str, Callable[[], bytes]]]] = {
    "V-LIM-01": ("A JPEG of 21 bytes that claims 65500 x 65500 pixels", lambda: claiming(65_500, 65_500)),
    "V-LIM-02": ("A JPEG that claims a row more than 1920 x 1080 pixels", lambda: claiming(1920, 1081)),
    "V-LIM-03": ("A JPEG without width", lambda: claiming(0, 240)),
    "V-LIM-04": ("A JPEG without height", lambda: claiming(320, 0)),
    "V-LIM-05": ("A JPEG of four components", lambda: claiming(320, 240, components=4)),
    "V-LIM-06": ("A JPEG of 12 bits", lambda: claiming(320, 240, bits=12)),
    "V-LIM-07": ("A lossless JPEG (SOF3)", lambda: claiming(320, 240, marker=0xC3)),
    "V-LIM-08": ("An arithmetic JPEG (SOF9)", lambda: claiming(320, 240, marker=0xC9)),
    "V-LIM-09": ("A JPEG whose scan comes before its frame header", lambda: b"\xff\xd8\xff\xda\x00\x08" + bytes(6)),
    "V-LIM-10": ("A JPEG with 64 segments before its frame header", lambda: commented(picture("left"), 63)),
    "V-LIM-11": ("A JPEG with a segment that ends beyond it", lambda: b"\xff\xd8\xff\xfe\xff\xff" + bytes(8)),
    "V-LIM-12": ("A JPEG cut in its frame header", lambda: claiming(320, 240)[:11]),
    "V-LIM-13": ("A JPEG of a start and nothing else", lambda: b"\xff\xd8"),
    "V-LIM-14": ("A PNG", png),
    "V-LIM-15": ("An empty payload", lambda: b""),
    "V-LIM-16": ("A text", lambda: b"0.5000|0.0000"),
    "V-LIM-17": ("A JPEG that claims the right size and has no pixels", lambda: claiming(320, 240)),
    "V-LIM-20": ("A JPEG with a segment of length zero", lambda: b"\xff\xd8\xff\xfe\x00\x00" + picture("left")[2:]),
    "V-LIM-22": ("A JPEG with its tables and 63 fill bytes before its frame header",
                 lambda: filled(picture("left"), 63)),
    "V-LIM-23": ("A JPEG with its tables and 63 markers without a length before its frame header",
                 lambda: picture("left")[:2] + b"\xff\x01" * 63 + picture("left")[2:]),
    "V-LIM-19": ("An image of another size than the camera's", lambda: picture("left_half")),
    "V-LIM-18": ("A JPEG of zeros after its start", lambda: b"\xff\xd8" + bytes(4_000)),
}
"""Images that must not drive: title, payload."""
DOUBTED: Final[dict[str, tuple[str, Callable[[], bytes]]]] = {
    "V-LIM-21": ("A JPEG cut in the middle of its pixels", lambda: _cut(0.5)),
}
"""The same, for images that a decoder may accept."""


def _image_drives_nothing(jpeg: Callable[[], bytes], title: str, robot: RobotPlayed) -> None:
    sent = []
    for _ in range(2):
        sent.append(robot.frame(jpeg=jpeg()))
        robot.is_answered(sent[-1])
    robot.bench.expect(not robot.is_driven(*sent), f"it drove by this: {title}")


for _level, _table in ((Level.MUST, REJECTED), (Level.SHOULD, DOUBTED)):
    SUITE.must_all(met, {
        number: (_CHECK, f"{title} drives nothing.", partial(_image_drives_nothing, jpeg, title))
        for number, (title, jpeg) in _table.items()
    }, level=_level)


@SUITE.must("V-LIM-31", "13.2 Bounds", met)
def all_rejected_and_well(bench: Bench, robot: RobotPlayed) -> None:
    """After every image that must be rejected, plain frames are answered as before."""
    for _, jpeg in (*REJECTED.values(), *DOUBTED.values()):
        robot.frame(jpeg=jpeg())
        bench.rest(20_000)
    robot.expect_driven("invalid images")


@SUITE.must("V-LIM-32", "13.2 Bounds", met)
def scan_bomb(bench: Bench, robot: RobotPlayed) -> None:
    """A progressive JPEG of thousands of empty scans does not keep it busy: the next frame is answered in time."""
    plain = robot.frame()
    plain_us = robot.answer_to(plain).received.at_us - plain.at_us
    robot.frame(jpeg=many_scans(picture("left_progressive"), _SCANS))
    bench.rest(50_000)
    # The next frame waits during the decoding of the bomb, which may take as long as that of a plain image.
    robot.answer_to(robot.frame(), ANSWER_US + plain_us)


READ: Final[dict[str, tuple[str, str, Level, Callable[[], bytes]]]] = {
    "V-LIM-41": ("3.1 Payload", "A progressive JPEG is read.", Level.MUST, lambda: picture("left_progressive")),
    "V-LIM-42": (_CHECK, "A JPEG with 62 comments before its tables is read.", Level.MUST,
                 lambda: commented(picture("left"), 62)),
    "V-LIM-43": ("3.1 Payload", "A grey JPEG is read.", Level.MUST, lambda: picture("grey")),
    "V-LIM-44": ("1.4 Sizes", "A JPEG of 200 kB is read.", Level.SHOULD,
                 lambda: commented(picture("left"), _LARGE_SEGMENTS, 65_000)),
    "V-LIM-45": (_CHECK, "A JPEG with fill bytes before its segments is read.", Level.MUST,
                 lambda: filled(picture("left"), 8)),
    "V-LIM-46": ("3.1 Payload", "A JPEG of extended sequential form (SOF1), 8 bits, is read.", Level.MUST,
                 lambda: picture("left").replace(b"\xff\xc0", b"\xff\xc1", 1)),
    "V-LIM-47": ("1.4 Sizes", "A JPEG of 390 kB is read.", Level.SHOULD,
                 lambda: commented(picture("left"), _LARGEST_SEGMENTS, 64_000)),
}


def _is_read(jpeg: Callable[[], bytes], robot: RobotPlayed) -> None:
    for _ in range(2):
        robot.expect_twist(robot.frame(jpeg=jpeg()))


for _number, (_clause, _title, _level, _jpeg) in READ.items():
    SUITE.must_all(met, {_number: (_clause, _title, partial(_is_read, _jpeg))}, level=_level)
