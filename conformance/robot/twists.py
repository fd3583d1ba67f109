"""Cases on single twists: header, grammar, cited message, order. Pure.

A robot that is not armed validates every command too and counts a good one as DISARMED, so no wheel turns here.
"""

from collections.abc import Callable, Sequence
from typing import Any, Final

from sightline.conformance.case import Bench, Case, Level, Suite
from sightline.conformance.robot.fixture import (
    CRAWL,
    GOOD,
    Robot,
    Sender,
    as_json,
    ready,
    ready_human,
    vision,
)
from sightline.protocol.channels import MAX_HEADER_BYTES, TWIST
from sightline.protocol.messages import MAX_INTEGER, FrameHeader, Status

SUITE: Final = Suite("R")

Fields = dict[str, Any]
Making = Callable[[Fields], bytes]


def _set(**changes: Any) -> Making:
    return lambda fields: as_json({**fields, **changes})


def _without(name: str) -> Making:
    return lambda fields: as_json({key: value for key, value in fields.items() if key != name})


def _echo(**changes: Any) -> Making:
    return lambda fields: as_json({**fields, "echo": {**fields["echo"], **changes}})


def _again(name: str, first: str) -> Making:
    """Return `name` given twice: `first`, then the original."""
    return lambda fields: b'{"%b":%b,' % (name.encode(), first.encode()) + as_json(fields)[1:]


def _wrapped(before: bytes, after: bytes = b"") -> Making:
    return lambda fields: before + as_json(fields) + after


def _bytes(data: bytes) -> Making:
    return lambda _fields: data


Row = tuple[str, Level, str, str, str, Sequence[Making]]
MUST, SHOULD = Level.MUST, Level.SHOULD

HEADERS: Final[Sequence[Row]] = (
    ("R-HEAD-01", MUST, "2.1 JSON", "Unknown fields of a header are ignored.", GOOD,
     (_set(colour="red", nested={"a": [1, 2]}), _echo(note="x"))),
    ("R-HEAD-02", MUST, "2.4 Version", "Another version is rejected as UNSUPPORTED_VERSION.", "UNSUPPORTED_VERSION",
     (_set(v=2), _set(v=0))),
    ("R-HEAD-03", MUST, "2.4 Version", "An absent version means 1.", GOOD, (_without("v"),)),
    ("R-HEAD-04", MUST, "2.8 Fields", "A header without `session` or `seq` is MALFORMED.", "MALFORMED",
     (_without("session"), _without("seq"))),
    ("R-HEAD-05", MUST, "2.8 Fields", "A header without `echo` is MALFORMED.", "MALFORMED", (_without("echo"),)),
    ("R-HEAD-06", MUST, "2.1 JSON", "A real number, a string, true or null in place of an integer is MALFORMED.",
     "MALFORMED", (_set(seq=1000.5), _set(seq="1000"), _set(seq=True), _set(seq=None))),
    ("R-HEAD-07", MUST, "2.2 Numbers", "An integer beyond 2^53 - 1 is MALFORMED, be it 30 digits long.", "MALFORMED",
     (_set(seq=MAX_INTEGER + 1), _set(seq=10**29))),
    ("R-HEAD-08", MUST, "2.2 Numbers", "A negative integer is MALFORMED.", "MALFORMED",
     (_set(compute_us=-1), _set(seq=-1))),
    ("R-HEAD-09", MUST, "2.5 Session and sequence", "A session that is not 8 lower-case hex digits is MALFORMED.",
     "MALFORMED", (_set(session="ABCDEF01"), _set(session="abc"), _set(session="0123456789"))),
    ("R-HEAD-10", MUST, "2.1 JSON", "Of a field given twice the last counts.", GOOD,
     (_again("session", '"ffffffff"'), _again("v", "9"))),
    ("R-HEAD-11", MUST, "2.1 JSON", "A byte order mark before the header is MALFORMED.", "MALFORMED",
     (_wrapped(b"\xef\xbb\xbf"),)),
    ("R-HEAD-12", MUST, "2.1 JSON", "A header that is not JSON object is MALFORMED.", "MALFORMED",
     (_bytes(b"[1,2]"), _bytes(b'{"v":1,'), _bytes(b"null"), _wrapped(b"", b"}"))),
    ("R-HEAD-13", MUST, "2.8 Fields", "An absent `compute_us` means 0.", GOOD, (_without("compute_us"),)),
    ("R-HEAD-14", MUST, "2.2 Numbers", "NaN and Infinity in a header are MALFORMED.", "MALFORMED",
     (_bytes(b'{"v":1,"source":"vision","session":"0a0b0c0d","seq":NaN}'), _set(compute_us=float("inf")))),
    ("R-HEAD-15", MUST, "2.1 JSON", "A header that is not UTF-8 is MALFORMED.", "MALFORMED",
     (lambda fields: as_json({**fields, "note": "#"}).replace(b"#", b"\xff\xfe"),)),
    ("R-HEAD-16", MUST, "4.6 Guests", "A twist of a role other than guest without a header is MALFORMED.", "MALFORMED",
     (_bytes(b""),)),
    ("R-HEAD-18", MUST, "2.2 Numbers", "The greatest integer that the bounds allow, 2^53 - 1, is taken.", GOOD,
     (_set(compute_us=MAX_INTEGER),)),
    ("R-HEAD-19", MUST, "2.4 Version", "`v` is validated before all else: whatever is not 1 is UNSUPPORTED_VERSION.",
     "UNSUPPORTED_VERSION", (_set(v="1"), _set(v=True), _set(v=None), _set(v=1.0), _bytes(b'{"v":null,"seq":[]}'))),
    ("R-HEAD-20", MUST, "2.2 Numbers", "An integer written with a point or an exponent is MALFORMED: 7.0, 7e0.",
     "MALFORMED", (_set(compute_us=0.0), lambda fields: as_json({**fields, "compute_us": 7})[:-1] + b"e0}",
                   lambda fields: _echo(seq=float(fields["echo"]["seq"]))(fields))),
    ("R-HEAD-21", MUST, "1.4 Sizes", "A header of 512 bytes is read.", GOOD,
     (lambda fields: as_json(fields)[:-1].ljust(MAX_HEADER_BYTES - 1) + b"}",)),
    ("R-HEAD-22", MUST, "18.6 What an answer went by", "A twist may name the scan and the mission that it went by.",
     GOOD, (_set(scan=7, mission={"digest": "0a0b0c0d", "id": 3}),)),
    ("R-HEAD-23", MUST, "18.6 What an answer went by",
     "A scan that is not an integer, or a mission without digest or id, is MALFORMED.", "MALFORMED",
     (_set(scan="7"), _set(mission={"id": 3}), _set(mission={"digest": "0a", "id": 3}), _set(mission=3))),
)  # fmt: skip

CITED: Final[Sequence[Row]] = (
    ("R-CAUS-02", MUST, "5.1 Order", "A twist that cites a `seq` never issued is rejected as UNKNOWN_FRAME.",
     "UNKNOWN_FRAME", (_echo(seq=MAX_INTEGER), lambda fields: _echo(seq=fields["echo"]["seq"] + 1000)(fields))),
    ("R-CAUS-03", MUST, "5.1 Order", "A twist that cites a frame with a `t_us` off by one is UNKNOWN_FRAME.",
     "UNKNOWN_FRAME", (lambda fields: _echo(t_us=fields["echo"]["t_us"] + 1)(fields),
                       lambda fields: _echo(t_us=fields["echo"]["t_us"] - 1)(fields))),
    ("R-CAUS-05", MUST, "5.1 Order",
     "A time from the future on a known `seq` is UNKNOWN_FRAME: the record before the age.", "UNKNOWN_FRAME",
     (lambda fields: _echo(t_us=fields["echo"]["t_us"] + 10_000_000)(fields),)),
    ("R-CAUS-06", MUST, "5.1 Order", "A twist that cites another session of the robot is rejected as OTHER_SESSION.",
     "OTHER_SESSION", (_echo(session="fffffff0"),)),
    ("R-CAUS-08", MUST, "4.5 Echo", "A twist that cites a `beat` is rejected as UNKNOWN_FRAME where none is issued.",
     "UNKNOWN_FRAME", (_echo(channel="beat"),)),
    ("R-CAUS-09", MUST, "2.7 Echo", "A twist that cites a channel the robot does not know is MALFORMED.", "MALFORMED",
     (_echo(channel="camera"), _echo(channel="")),),
)  # fmt: skip


def _row_case(row: Row) -> Case:
    number, level, clause, title, expected, makings = row

    def run(bench: Bench) -> None:
        sender = ready(bench)
        for making in makings:
            sent = b""

            def send(frame: FrameHeader, making: Making = making) -> None:
                nonlocal sent
                sender.seq += 1
                sent = making(sender.header(frame))
                bench.publish(TWIST, sent, CRAWL, sender.source)

            result = sender.result_on_next(send)
            bench.expect(result == expected, f"{sent[:160]!r}: {result}, expected {expected}")
        if row in CITED:
            sender.robot.expect_unmoved("though no twist was applied")

    return Case(number, level, clause, title, run)


TEXTS: Final[Sequence[tuple[str, str, str, Sequence[bytes]]]] = (
    ("R-GRAM-01", "Signs, a missing digit before or after the point, and exponents are taken.", GOOD,
     (b"0.2000|-0.3500", b"+.1|-0.", b"1e-2|-1E-1", b"0|0", b"2.3028209556706964|0")),
    ("R-GRAM-02", "A twist of one number or of three is MALFORMED.", "MALFORMED", (b"1", b"1|", b"|1", b"1|2|3", b"")),
    ("R-GRAM-03", "Blanks and line ends are MALFORMED.", "MALFORMED", (b" 1|2", b"1|2\n", b"1 |2", b"1|2\0")),
    ("R-GRAM-04", "`nan` is NOT_FINITE.", "NOT_FINITE", (b"nan|0", b"0|NaN", b"-nan|1")),
    ("R-GRAM-05", "`inf` is NOT_FINITE.", "NOT_FINITE", (b"inf|0", b"0|-Infinity")),
    ("R-GRAM-06", "A number beyond a double is NOT_FINITE.", "NOT_FINITE", (b"1e999|0", b"0|-9e308")),
    ("R-GRAM-07", "Other ways of writing a number are MALFORMED.", "MALFORMED",
     (b"1_0|2", b"0x1|0", "\u0661|0".encode(), b"--1|0", b"1e|0")),
    ("R-GRAM-08", "An exponent of more than three digits is MALFORMED.", "MALFORMED", (b"1e0001|0",)),
    ("R-GRAM-09", "Another mark than the bar is MALFORMED.", "MALFORMED", (b"1,2", b"0.2-0.35", b"1/2", b"1||2")),
    ("R-GRAM-10", "Bytes that are not text are MALFORMED.", "MALFORMED", (b"\xff\xfe\0\x80", bytes(range(128, 192)))),
    ("R-GRAM-11", "A number too small for a double is zero.", GOOD, (b"1e-999|0", b"0|-1e-400")),
    ("R-GRAM-12", "`nan` in one of two fields is NOT_FINITE, whatever the other is.", "NOT_FINITE",
     (b"nan|x", b"x|-NaN")),
    ("R-GRAM-13", "`nan` alone, or as a part of a word, is MALFORMED.", "MALFORMED", (b"nan", b"nans|0", b"0|nano")),
    ("R-GRAM-14", "A twist of 64 bytes is read.", GOOD, (b"0.1".ljust(62, b"0") + b"|0",)),
)  # fmt: skip


def _text_case(number: str, title: str, expected: str, texts: Sequence[bytes]) -> Case:
    def run(bench: Bench) -> None:
        sender = ready(bench)
        for text in texts:
            sender.expect(expected, text, what=f"{text!r}")

    return Case(number, Level.MUST, "4.1 Grammar", title, run)


for _row in (*HEADERS, *CITED):
    SUITE.add(_row_case(_row))
for _text in TEXTS:
    SUITE.add(_text_case(*_text))


@SUITE.must("R-HEAD-17", "1.3 Keys", ready)
def source_disagrees(bench: Bench, sender: Sender) -> None:
    """A source in the header other than the key's is rejected as UNKNOWN_SOURCE."""

    def send(frame: FrameHeader) -> None:
        sender.seq += 1
        bench.publish(TWIST, as_json(sender.header(frame)), CRAWL, "teleop")

    result = sender.result_on_next(send)
    bench.expect(result == "UNKNOWN_SOURCE", f"a header of vision under the key of teleop: {result}")


# --- the cited message, over time ------------------------------------------------------------------------------------


@SUITE.must("R-CAUS-04", "5.3 Age", ready)
def stale_frame(bench: Bench, sender: Sender) -> None:
    """A twist that cites a frame more than a second old is rejected as STALE, or UNKNOWN_FRAME if that is forgotten."""
    frame = sender.robot.frame()
    bench.rest(1_200_000)
    result = sender.result_of(lambda: sender.twist(frame))
    bench.expect(result in ("STALE", "UNKNOWN_FRAME"), f"it was {result}")
    sender.robot.expect_unmoved("though no twist was applied")


@SUITE.must("R-CAUS-17", "5.1 Order", ready_human)
def human_cites_too(bench: Bench, human: Sender) -> None:
    """A twist of `teleop` is validated by its frame: STALE a second later, UNKNOWN_FRAME with a `t_us` off by one."""
    frame = human.robot.frame()
    human.expect("UNKNOWN_FRAME", what="a `t_us` off by one", echo_t_us=frame.t_us + 1)
    bench.rest(1_200_000)
    result = human.result_of(lambda: human.twist(frame))
    bench.expect(result in ("STALE", "UNKNOWN_FRAME"), f"on a frame more than a second old it was {result}")


@SUITE.must("R-SEQ-17", "5.1 Order", ready_human)
def human_counts_too(_bench: Bench, human: Sender) -> None:
    """A twist of `teleop` with the `seq` of the one before is rejected as OUT_OF_ORDER."""
    human.expect("OUT_OF_ORDER", seq=human.seq)


@SUITE.must("R-CAUS-07", "4.5 Echo", ready)
def cites_a_status(bench: Bench, sender: Sender) -> None:
    """A twist that cites a `status` is rejected as UNKNOWN_FRAME."""
    frame, stamp = sender.robot.frame(), sender.robot.stamp()
    assert stamp is not None
    result = sender.result_of(
        lambda: sender.twist(frame, echo_channel="status", echo_seq=stamp.seq, echo_t_us=stamp.t_us)
    )
    bench.expect(result == "UNKNOWN_FRAME", f"it was {result}")


@SUITE.must("R-CAUS-10", "5.1 Order", ready)
def earlier_frame(bench: Bench, sender: Sender) -> None:
    """A twist that answers the frame before the newest is accepted while that is young."""
    link_us = sender.robot.link_us()
    bench.rest(8 * link_us)  # until the window is so wide that the second frame comes while the first is young
    earlier = sender.robot.frame()
    young_us = max(0, 300_000 - link_us)
    bench.wait(lambda: _newest_seq(sender.robot) > earlier.seq, young_us)
    bench.need(_newest_seq(sender.robot) > earlier.seq, f"no second frame within {young_us / 1e3:.0f} ms")
    sender.expect_result(GOOD, lambda: sender.twist(earlier))


def _newest_seq(robot: Robot) -> int:
    received = robot.frames()
    return received[-1][1].seq if received else -1


@SUITE.must("R-CAUS-11", "5.1 Order", ready)
def reasons_in_order(bench: Bench, sender: Sender) -> None:
    """The first of several faults in the order of validation is the reason: session before `seq`."""
    foreign = sender.twist_result(echo_session="fffffff0")
    bench.need(foreign == "OTHER_SESSION", f"another session is {foreign} (R-CAUS-06)")
    sender.expect("OTHER_SESSION", echo_session="fffffff0", seq=0)


# --- the sender's seq ------------------------------------------------------------------------------------------------


@SUITE.must("R-SEQ-07", "5.1 Order", ready)
def earlier_seq(bench: Bench, sender: Sender) -> None:
    """A twist with a `seq` below the last is rejected as OUT_OF_ORDER."""
    sender.seq = 50
    bench.need(sender.twist_result() == GOOD, "an ordinary twist is not accepted")
    sender.expect("OUT_OF_ORDER", seq=20)


@SUITE.must("R-SEQ-09", "5.1 Order", ready)
def new_session_counts_again(bench: Bench, first: Sender) -> None:
    """Another session of the same role counts from its own beginning."""
    first.seq = 5000
    bench.need(first.twist_result() == GOOD, "an ordinary twist is not accepted")
    first.fall_silent()
    bench.rest(1_500_000)
    result = Sender(first.robot).twist_result()
    bench.need(result != "NOT_HOLDER", "the lease does not end by silence (R-LEASE-04)")
    bench.expect(result == GOOD, f"it was {result}")


@SUITE.must("R-SEQ-10", "5.1 Order", ready)
def rejected_seq_bars_no_driver(bench: Bench, sender: Sender) -> None:
    """The `seq` of a twist rejected for what it cites is not remembered: the next ordinary one is good."""
    rejected = sender.twist_result(echo_seq=MAX_INTEGER, seq=MAX_INTEGER)
    bench.need(rejected == "UNKNOWN_FRAME", f"an unknown frame is {rejected} (R-CAUS-02)")
    sender.expect(GOOD)


# Cases on the order of the validation of a twist, and on the memory of a robot for it. Pure.


_REMEMBERED_FRAMES: Final = 256
_OLD_FRAMES: Final = 200
_APART_US: Final = 8_000
"""Time between twists on one frame: none may replace another, and all must come before the frame is too old."""
_OTHERS: Final = 80
"""Rejected senders between a twist and its replay; they must not displace the one that held the lease."""
_OF_ONE_FRAME: Final = 16
"""Senders that cite one frame, so that all have sent before the robot may forget the driver."""
_REMEMBERED_US: Final = 9_000_000
"""Within the ten seconds for which a robot remembers a driver."""


def _watcher(bench: Bench) -> Sender:
    """Return a peer that may not drive, at a robot that rejects it as UNKNOWN_SOURCE."""
    watcher = Sender(Robot(bench), bench.access.watcher)
    result = watcher.twist_result()
    bench.need(result == "UNKNOWN_SOURCE", f"a watcher's twist is {result} (R-HOST-01)")
    return watcher


def _good(status: Status) -> int:
    """Return the number of valid twists: applied, or rejected only as DISARMED."""
    return status.accepted + status.refused.get("DISARMED", 0)


def _leaps(sender: Sender, numbers: Sequence[int], **changes: Any) -> None:
    """Fail the case unless a twist with each of these `seq` is out of order."""
    for seq in numbers:
        sender.expect("OUT_OF_ORDER", seq=seq, what=f"seq {seq}", **changes)


SUITE.must_all(vision, {
    "R-CAUS-01": ("5.2 Record", "A twist that answers the newest frame at once is accepted.",
                  lambda it: it.expect(GOOD)),
})
SUITE.must_all(ready, {
    "R-SEQ-06": ("5.1 Order", "A twist with the `seq` of the one before is rejected as OUT_OF_ORDER.",
                 lambda it: it.expect("OUT_OF_ORDER", seq=it.seq)),
    "R-SEQ-08": ("2.5 Session and sequence", "A `seq` that jumps forward is taken.",
                 lambda it: it.expect(GOOD, seq=it.seq + 1001)),
    "R-SEQ-13": ("5.1 Order", "A `seq` more than 2^20 above the last does not continue a session: it would bar its "
                 "owner.", lambda it: _leaps(it, (1 << 52, it.seq + (1 << 20) + 1))),
    "R-SEQ-14": ("5.1 Order", "A `seq` above 2^32 does not begin a session.",
                 lambda it: _leaps(it, (1 << 52, (1 << 32) + 1), session="fffffff1")),
})
SUITE.must_all(_watcher, {
    "R-CAUS-12": ("5.1 Order", "The grammar is validated before the role: nonsense of a watcher is MALFORMED.",
                  lambda it: it.expect("MALFORMED", b"x")),
    "R-CAUS-13": ("5.1 Order",
                  "The role is validated before the session: a watcher that cites another session is UNKNOWN_SOURCE.",
                  lambda it: it.expect("UNKNOWN_SOURCE", echo_session="fffffff0")),
})


@SUITE.must("R-CAUS-14", "5.1 Order", ready)
def record_before_count(_bench: Bench, sender: Sender) -> None:
    """The record is validated before the count: a replayed `seq` that cites an unknown frame is UNKNOWN_FRAME."""
    sender.need_unknown()
    sender.need_good()
    sender.expect("UNKNOWN_FRAME", echo_seq=MAX_INTEGER, seq=sender.seq)


@SUITE.must("R-CAUS-15", "4.5 Echo", ready)
def several_on_one_frame(bench: Bench, sender: Sender) -> None:
    """Several twists may cite one frame, with rising `seq`: all are validated."""
    before = _good(sender.robot.next_status())
    sender.acks = False
    frame = sender.robot.frame()
    for _ in range(3):
        sender.twist(frame)
        bench.rest(_APART_US)
    accepted = _good(sender.robot.next_status(2)) - before
    bench.expect(accepted == 3, f"of three twists on one frame {accepted} were accepted")


@SUITE.must("R-CAUS-16", "5.1 Order", ready)
def remembers_frames(bench: Bench, sender: Sender) -> None:
    """A robot remembers 256 frames: one of 200 frames or nine seconds ago is STALE and not UNKNOWN_FRAME."""
    frame = sender.robot.frame()
    bench.wait(lambda: sender.robot.frames()[-1][1].seq - frame.seq >= _OLD_FRAMES, 9_000_000)
    issued = sender.robot.frames()[-1][1].seq - frame.seq
    bench.need(issued < _REMEMBERED_FRAMES - 20, f"{issued} frames came meanwhile")
    result = sender.result_of(lambda: sender.twist(frame))
    bench.need(result in ("STALE", "UNKNOWN_FRAME"), f"it was {result} (R-CAUS-04)")
    bench.expect(result == "STALE", f"it was {result}")


@SUITE.must("R-SEQ-11", "5.1 Order", ready)
def rejected_for_the_lease_counts(bench: Bench, first: Sender) -> None:
    """A `seq` is used up though the lease rejects its twist: one below it is OUT_OF_ORDER then."""
    second = Sender(first.robot)
    bench.need(second.twist_result(seq=5000) == "NOT_HOLDER", "a second driver is not rejected (R-LEASE-02)")
    second.expect("OUT_OF_ORDER", seq=100)


@SUITE.must("R-SEQ-12", "5.1 Order", ready)
def remembers_senders(bench: Bench, sender: Sender) -> None:
    """A robot remembers the senders that drove: a replay is OUT_OF_ORDER after eighty others were rejected."""
    replayed = sender.twist_result(seq=sender.seq)
    bench.need(replayed == "OUT_OF_ORDER", f"a replay is {replayed} (R-SEQ-06)")
    began_us = bench.now_us
    sender.need_good()
    for _ in range(_OTHERS // _OF_ONE_FRAME):
        frame = sender.robot.frame()
        for _ in range(_OF_ONE_FRAME):
            Sender(sender.robot, sender.source, acks=False).twist(frame, seq=1 << 20)
            bench.rest(_APART_US)
    sender.robot.next_status(2)
    result = sender.twist_result(seq=sender.seq)
    bench.need(bench.now_us - began_us < _REMEMBERED_US, "too few frames: a robot may have forgotten the driver")
    bench.expect(result == "OUT_OF_ORDER", f"after {_OTHERS} others a replay is {result}")


@SUITE.must("R-SEQ-16", "5.1 Order", ready)
def remembers_for_ten_seconds(bench: Bench, first: Sender) -> None:
    """A robot remembers a driver for ten seconds: a replay is OUT_OF_ORDER while another drives."""
    began_us, last = bench.now_us, first.seq
    replayed = first.twist_result(seq=last)
    bench.need(replayed == "OUT_OF_ORDER", f"a replay is {replayed} (R-SEQ-06)")
    first.fall_silent()
    bench.rest(_REMEMBERED_US - 2_000_000)
    Sender(first.robot).need_good()
    result = first.twist_result(seq=last)
    bench.need(bench.now_us - began_us < _REMEMBERED_US, "too few frames: a robot may have forgotten the driver")
    bench.expect(result == "OUT_OF_ORDER", f"7 s after its last twist a replay is {result}")


@SUITE.must("R-SEQ-15", "5.1 Order", vision)
def greatest_leaps(_bench: Bench, sender: Sender) -> None:
    """A `seq` of 2^32 begins a session, and one 2^20 above it continues that."""
    sender.expect(GOOD, seq=1 << 32)
    sender.expect(GOOD, seq=(1 << 32) + (1 << 20))
