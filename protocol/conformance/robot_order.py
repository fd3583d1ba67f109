"""Cases on the order in which a twist is judged, and on how much a robot remembers for it. Pure."""

from typing import Final

from sightline.protocol.channels import TWIST
from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.robot.fixture import CRAWL, Robot, Sender, as_json
from sightline.protocol.messages import MAX_INTEGER, Status

SUITE: Final = Suite("R")
_REMEMBERED_FRAMES: Final = 256
_APART_US: Final = 8_000
"""Twists on one frame: apart enough for none to replace another, and all before the next frame."""
_OTHERS: Final = 60
"""Senders between a twist and its replay; a robot remembers 64."""


def _watcher(bench: Bench) -> Sender:
    """Who may not drive, at a robot that says so."""
    watcher = Sender(Robot(bench), bench.access.watcher)
    verdict = watcher.judged()
    bench.need(verdict == "UNKNOWN_SOURCE", f"a watcher's twist is {verdict or 'not counted'} (R-HOST-01)")
    return watcher


def _ready(bench: Bench) -> Sender:
    sender = Sender(Robot(bench))
    sender.need_good()
    return sender


def _good(status: Status) -> int:
    """How many twists were judged good: obeyed, or kept from the wheels by nothing but the arming."""
    return status.accepted + status.refused.get("DISARMED", 0)


def _expect(bench: Bench, verdict: str, expected: str) -> None:
    bench.expect(verdict == expected, f"it was {verdict or 'not counted'}, expected {expected}")


@SUITE.must("R-CAUS-12", "5.1 Order")
def grammar_before_role(bench: Bench) -> None:
    """The grammar is judged before the role: nonsense of who may not drive is MALFORMED."""
    _expect(bench, _watcher(bench).judged(b"x"), "MALFORMED")


@SUITE.must("R-CAUS-13", "5.1 Order")
def role_before_session(bench: Bench) -> None:
    """The role is judged before the session: who may not drive and cites another session is UNKNOWN_SOURCE."""
    _expect(bench, _watcher(bench).judged(echo_session="fffffff0"), "UNKNOWN_SOURCE")


@SUITE.must("R-CAUS-14", "5.1 Order")
def record_before_count(bench: Bench) -> None:
    """The record is judged before the count: a replayed `seq` that cites an unknown frame is UNKNOWN_FRAME."""
    sender = _ready(bench)
    sender.need_unknown()
    sender.need_good()
    _expect(bench, sender.judged(echo_seq=MAX_INTEGER, seq=sender.seq), "UNKNOWN_FRAME")


@SUITE.must("R-CAUS-15", "4.5 Echo")
def several_on_one_frame(bench: Bench) -> None:
    """Several twists may cite one frame, with rising `seq`: all are judged."""
    sender = _ready(bench)
    before = _good(sender.robot.next_status())
    sender.acks = False
    frame = sender.robot.frame()
    for _ in range(3):
        sender.twist(frame)
        bench.rest(_APART_US)
    judged = _good(sender.robot.next_status(2)) - before
    bench.expect(judged == 3, f"of three twists on one frame {judged} were judged good")


@SUITE.must("R-CAUS-16", "5.1 Order")
def remembers_frames(bench: Bench) -> None:
    """A robot remembers 256 frames: one of three seconds ago is STALE and not UNKNOWN_FRAME."""
    sender = _ready(bench)
    frame = sender.robot.frame()
    bench.rest(3_000_000)
    issued = sender.robot.frames()[-1][1].seq - frame.seq
    bench.need(issued < _REMEMBERED_FRAMES - 20, f"{issued} frames came meanwhile")
    verdict = sender.verdict(lambda: sender.twist(frame))
    bench.need(verdict in ("STALE", "UNKNOWN_FRAME"), f"it was {verdict or 'not counted'} (R-CAUS-04)")
    _expect(bench, verdict, "STALE")


@SUITE.must("R-SEQ-11", "5.1 Order")
def refused_for_the_lease_counts(bench: Bench) -> None:
    """A `seq` is used up though the lease refuses its twist: one below it is OUT_OF_ORDER then."""
    first = _ready(bench)
    second = Sender(first.robot)
    bench.need(second.judged(seq=5000) == "NOT_HOLDER", "a second driver is not kept out (R-LEASE-02)")
    _expect(bench, second.judged(seq=100), "OUT_OF_ORDER")


@SUITE.must("R-SEQ-12", "5.1 Order")
def remembers_senders(bench: Bench) -> None:
    """A robot remembers 64 senders: a replay is OUT_OF_ORDER after sixty others have sent."""
    sender = _ready(bench)
    replayed = sender.judged(seq=sender.seq)
    bench.need(replayed == "OUT_OF_ORDER", f"a replay is {replayed or 'not counted'} (R-SEQ-06)")
    sender.need_good()
    for number in range(_OTHERS):
        header = {**sender.header(sender.robot.frame()), "session": f"{0xA0000000 + number:08x}", "seq": 1 << 40}
        bench.publish(TWIST, as_json(header), CRAWL, sender.source)
    sender.robot.next_status(2)
    _expect(bench, sender.judged(seq=sender.seq), "OUT_OF_ORDER")
