"""Cases about pictures: those that must be refused before a decoder sees them, and odd ones that are good. Pure."""

from collections.abc import Callable
from typing import Final

from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Case, Level, Suite
from sightline.protocol.conformance.vision_pictures import claiming, commented, many_scans, picture, png
from sightline.conformance.vision.fixture import RobotPlayed

SUITE = Suite("V")
_CHECK: Final = "3.2 Bounds check"
_SCANS: Final = 4_000
_LARGE_SEGMENTS: Final = 3


def _cut(share: float) -> bytes:
    whole = picture("left")
    return whole[: int(len(whole) * share)]


REFUSED: Final[dict[str, tuple[str, Callable[[], bytes]]]] = {
    "V-LIM-01": ("A JPEG of 21 bytes that claims 65500 x 65500 pixels", lambda: claiming(65_500, 65_500)),
    "V-LIM-02": ("A JPEG that claims a row more than 1920 x 1080 pixels", lambda: claiming(1920, 1081)),
    "V-LIM-03": ("A JPEG without width", lambda: claiming(0, 240)),
    "V-LIM-04": ("A JPEG without height", lambda: claiming(320, 0)),
    "V-LIM-05": ("A JPEG of four components", lambda: claiming(320, 240, components=4)),
    "V-LIM-06": ("A JPEG of 12 bits", lambda: claiming(320, 240, bits=12)),
    "V-LIM-07": ("A lossless JPEG (SOF3)", lambda: claiming(320, 240, marker=0xC3)),
    "V-LIM-08": ("An arithmetic JPEG (SOF9)", lambda: claiming(320, 240, marker=0xC9)),
    "V-LIM-09": ("A JPEG whose scan comes before its frame header", lambda: b"\xff\xd8\xff\xda\x00\x08" + bytes(6)),
    "V-LIM-10": ("A JPEG with 64 segments before its frame header", lambda: commented(picture("left"), 64)),
    "V-LIM-11": ("A JPEG with a segment that ends beyond it", lambda: b"\xff\xd8\xff\xfe\xff\xff" + bytes(8)),
    "V-LIM-12": ("A JPEG cut in its frame header", lambda: claiming(320, 240)[:11]),
    "V-LIM-13": ("A JPEG of a start and nothing else", lambda: b"\xff\xd8"),
    "V-LIM-14": ("A PNG", png),
    "V-LIM-15": ("An empty payload", lambda: b""),
    "V-LIM-16": ("A text", lambda: b"0.5000|0.0000"),
    "V-LIM-17": ("A JPEG that claims the right size and has no pixels", lambda: claiming(320, 240)),
    "V-LIM-19": ("A picture of another size than the camera's", lambda: picture("left_half")),
    "V-LIM-18": ("A JPEG of zeros after its start", lambda: b"\xff\xd8" + bytes(4_000)),
}
"""What must not be driven by: title, payload."""
DOUBTED: Final[dict[str, tuple[str, Callable[[], bytes]]]] = {
    "V-LIM-21": ("A JPEG cut in the middle of its pixels", lambda: _cut(0.5)),
}
"""The same, where a decoder may see it otherwise."""


def _picture_rejected(jpeg: Callable[[], bytes], title: str) -> Callable[[Bench], None]:
    def run(bench: Bench) -> None:
        robot = RobotPlayed(bench).met()
        for _ in range(2):
            sent = robot.frame(jpeg=jpeg())
            robot.is_answered(sent)
            bench.expect(not any(one.is_twist for one in robot.answers_to(sent)), f"it drove by this: {title}")

    return run


for _level, _table in ((Level.MUST, REFUSED), (Level.SHOULD, DOUBTED)):
    for _case_id, (_case_title, _jpeg) in _table.items():
        SUITE.add(Case(_case_id, _level, _CHECK, f"{_case_title} drives nothing.", _picture_rejected(_jpeg, _case_title)))


@SUITE.must("V-LIM-31", "13.2 Bounds")
def all_refused_and_well(bench: Bench) -> None:
    """After every picture that must be refused, plain frames are answered as before."""
    robot = RobotPlayed(bench).met()
    for _, jpeg in (*REFUSED.values(), *DOUBTED.values()):
        robot.frame(jpeg=jpeg())
        bench.rest(20_000)
    robot.expect_driven("pictures that are none")


@SUITE.must("V-LIM-32", "13.2 Bounds")
def scan_bomb(bench: Bench) -> None:
    """A progressive JPEG of thousands of empty scans does not keep it busy: the next frame is answered in time."""
    robot = RobotPlayed(bench).met()
    robot.frame(jpeg=many_scans(picture("left_progressive"), _SCANS))
    bench.rest(50_000)
    robot.answer_to(robot.frame())


READ: Final[dict[str, tuple[str, str, Level, Callable[[], bytes]]]] = {
    "V-LIM-41": ("3.1 Payload", "A progressive JPEG is read.", Level.MUST, lambda: picture("left_progressive")),
    "V-LIM-42": (_CHECK, "A JPEG with 61 comments before its tables is read.", Level.MUST,
                 lambda: commented(picture("left"), 61)),
    "V-LIM-43": ("3.1 Payload", "A grey JPEG is read.", Level.MUST, lambda: picture("grey")),
    "V-LIM-44": ("1.4 Sizes", "A JPEG of 200 kB is read.", Level.SHOULD,
                 lambda: commented(picture("left"), _LARGE_SEGMENTS, 65_000)),
}


def _read(jpeg: Callable[[], bytes]) -> Callable[[Bench], None]:
    def run(bench: Bench) -> None:
        robot = RobotPlayed(bench).met()
        for _ in range(2):
            answer = robot.answer_to(robot.frame(jpeg=jpeg()))
            bench.expect(answer.is_twist, f"it came to {answer.words()}, not to a twist")

    return run


for _case_id, (_case_clause, _case_title, _level, _jpeg) in READ.items():
    SUITE.add(Case(_case_id, _level, _case_clause, _case_title, _read(_jpeg)))
