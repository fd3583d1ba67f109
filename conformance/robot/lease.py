"""Cases on the lease: who drives, by rank, for how long, and what happens when the driver is gone. Pure."""

from typing import Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import GOOD, Robot, Sender, armed
from sightline.protocol.messages import Holder, State

SUITE: Final = Suite("R")
_LEASE_US: Final = 1_000_000


def _held(bench: Bench, source: str = "vision") -> Sender:
    """A sender that has just been judged good and so holds the lease."""
    sender = Sender(Robot(bench), source)
    sender.need_good()
    return sender


def _held_alone(bench: Bench) -> tuple[Sender, Sender]:
    """Who holds the lease, and a second driver whom it keeps out."""
    first = _held(bench)
    second = Sender(first.robot)
    bench.need(second.judged() == "NOT_HOLDER", "a second driver is not kept out (R-LEASE-02)")
    return first, second


def _held_for_a_while(bench: Bench) -> Sender:
    """Who holds the lease, at a robot where it ends by silence."""
    first = _held(bench)
    first.fall_silent()
    bench.rest(_LEASE_US * 3 // 2)
    second = Sender(first.robot)
    bench.need(second.judged() == GOOD, "the lease does not end by silence (R-LEASE-04)")
    return second


def _holder_is(sender: Sender, within_us: int = 400_000) -> bool:
    me = Holder(source=sender.source, session=sender.session)
    return sender.robot.reaches(lambda status: status.holder == me, within_us)


@SUITE.must("R-LEASE-01", "6.1 Lease")
def first_holds(bench: Bench) -> None:
    """Who sends the first good twist holds the lease, and `status` says so."""
    sender = _held(bench)
    bench.expect(_holder_is(sender), f"holder is {sender.robot.status().holder}, not vision {sender.session}")


@SUITE.must("R-LEASE-02", "6.1 Lease")
def equal_rank_waits(bench: Bench) -> None:
    """A second driver of the same rank is refused as NOT_HOLDER."""
    first = _held(bench)
    verdict = Sender(first.robot).judged()
    bench.expect(verdict == "NOT_HOLDER", f"it was {verdict or 'not counted'}")


@SUITE.should("R-LEASE-03", "5.1 Order")
def loser_is_told(bench: Bench) -> None:
    """The words of the refusal name the source and session that drive."""
    first = _held(bench)
    bench.need(Sender(first.robot).judged() == "NOT_HOLDER", "a second driver is not refused so (R-LEASE-02)")
    last = first.robot.status().last_refusal
    told = last is not None and first.session in last.detail and first.source in last.detail
    bench.expect(told, f"last_refusal is {last}")


@SUITE.must("R-LEASE-04", "6.1 Lease")
def lease_ends(bench: Bench) -> None:
    """The lease ends one second after the last good twist; then another may drive."""
    first = _held(bench)
    first.fall_silent()
    bench.rest(_LEASE_US * 3 // 2)
    verdict = Sender(first.robot).judged()
    bench.expect(verdict == GOOD, f"after 1.5 s of silence a second driver is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-05", "6.1 Lease")
def lease_lasts(bench: Bench) -> None:
    """Half a second after the last good twist the lease still holds."""
    first, second = _held_alone(bench)
    first.twist(first.robot.frame())
    bench.rest(_LEASE_US // 2)
    verdict = second.judged()
    bench.expect(verdict == "NOT_HOLDER", f"a second driver is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-06", "6.1 Lease")
def refused_twists_renew_nothing(bench: Bench) -> None:
    """Refused twists of the holder do not renew its lease."""
    first = _held_for_a_while(bench)
    first.need_unknown()
    first.need_good()
    first.acks = False
    for _ in range(7):
        frame = first.robot.frame()
        first.twist(frame, echo_seq=frame.seq + 5000)
        bench.rest(200_000)
    verdict = Sender(first.robot).judged()
    bench.expect(verdict == GOOD, f"after 1.4 s of refused twists a second driver is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-07", "6.1 Lease")
def acks_renew_nothing(bench: Bench) -> None:
    """Acks of the holder do not renew its lease."""
    first = _held_for_a_while(bench)
    mark = first.ack_seq
    bench.rest(_LEASE_US * 3 // 2)
    bench.need(first.ack_seq > mark + 2, "too few frames to acknowledge")
    verdict = Sender(first.robot).judged()
    bench.expect(verdict == GOOD, f"after 1.5 s of acks alone a second driver is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-08", "6.1 Lease")
def acks_take_nothing(bench: Bench) -> None:
    """Acks take no lease."""
    watcher = Sender(Robot(bench))
    bench.rest(1_700_000)  # whoever acknowledged before owns the credit for another second
    bench.need(watcher.ack_seq > 2, "too few frames to acknowledge")
    holder = watcher.robot.next_status().holder
    bench.expect(holder is None, f"{holder} holds it, though nobody sent a twist")


@SUITE.must("R-LEASE-09", "6.1 Lease")
def human_takes(bench: Bench) -> None:
    """`teleop` takes the lease from `vision`."""
    first = _held(bench)
    human = Sender(first.robot, "teleop")
    verdict = human.judged()
    bench.expect(verdict == GOOD, f"a twist of teleop is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-10", "6.1 Lease")
def human_keeps(bench: Bench) -> None:
    """`vision` does not take the lease from `teleop`."""
    human = _held(bench, "teleop")
    verdict = Sender(human.robot).judged()
    bench.expect(verdict == "NOT_HOLDER", f"a twist of vision is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-11", "6.2 Losing the human")
def lost_human_disarms(bench: Bench) -> None:
    """A human driver who falls silent disarms the robot, also while vision's commands flow."""
    robot, human = armed(bench, "teleop")
    Sender(robot).drive()
    human.fall_silent()
    reached = robot.reaches(lambda status: status.state is State.DISARMED, 2_500_000)
    bench.expect(reached, f"2.5 s after the human fell silent: {robot.status().state}, {robot.status().holder} drives")
    robot.next_status(5)
    bench.expect(robot.status().state is State.DISARMED, f"then it went on as {robot.status().state}")


@SUITE.must("R-LEASE-12", "6.2 Losing the human")
def human_lets_go(bench: Bench) -> None:
    """A human driver who releases the lease disarms the robot."""
    robot, human = armed(bench, "teleop")
    human.drive(None)
    bench.need(human.granted("release"), "release is not granted (R-LEASE-15)")
    reached = robot.reaches(lambda status: status.state is State.DISARMED, 500_000)
    bench.expect(reached, f"half a second after the release it is {robot.status().state}")


@SUITE.must("R-LEASE-13", "8.2 Requests and replies")
def acquire(bench: Bench) -> None:
    """`acquire` takes the lease before the first twist."""
    sender = Sender(Robot(bench))
    bench.expect(sender.granted("acquire"), "acquire was not granted, though nobody drove")
    holds = _holder_is(sender) or Sender(sender.robot).judged() == "NOT_HOLDER"
    bench.expect(holds, f"holder is {sender.robot.status().holder}, and a second driver is not refused")


@SUITE.must("R-LEASE-14", "8.2 Requests and replies")
def acquire_does_not_renew(bench: Bench) -> None:
    """Asking again does not keep the lease alive without twists."""
    sender = _held_for_a_while(bench)
    sender.acks = False
    bench.rest(_LEASE_US * 3 // 2)
    bench.need(sender.granted("acquire"), "acquire is not granted (R-LEASE-13)")
    began_us = bench.now_us
    while bench.now_us - began_us < 800_000:
        bench.rest(150_000)
        sender.request("acquire")
    bench.rest(500_000)
    verdict = Sender(sender.robot).judged()
    bench.expect(verdict == GOOD, f"1.3 s after the first, 0.5 s after the last acquire another is {verdict}")


@SUITE.must("R-LEASE-15", "8.2 Requests and replies")
def release(bench: Bench) -> None:
    """`release` frees the lease at once."""
    first = _held(bench)
    bench.expect(first.granted("release"), "release by the holder was not granted")
    verdict = Sender(first.robot).judged()
    bench.expect(verdict == GOOD, f"then a second driver is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-16", "8.2 Requests and replies")
def release_is_the_holders(bench: Bench) -> None:
    """`release` by somebody else frees nothing."""
    _first, second = _held_alone(bench)
    second.ask("release")
    verdict = second.judged()
    bench.expect(verdict == "NOT_HOLDER", f"after its release a stranger's twist is {verdict or 'not counted'}")


@SUITE.must("R-LEASE-17", "8.2 Requests and replies")
def acquire_waits(bench: Bench) -> None:
    """`acquire` is refused while an equal or higher rank drives."""
    _first, second = _held_alone(bench)
    reply = second.ask("acquire")
    bench.need(reply is not None, "no reply to acquire (R-REQ-01)")
    bench.expect(reply is not None and not reply.ok, "a second vision was granted the lease")


@SUITE.must("R-LEASE-18", "8.2 Requests and replies")
def acquire_is_for_drivers(bench: Bench) -> None:
    """`acquire` is refused to a role that may not drive."""
    watcher = Sender(Robot(bench), "operator")
    reply = watcher.ask("acquire")
    bench.need(reply is not None, "no reply to acquire (R-REQ-01)")
    bench.expect(reply is not None and not reply.ok, "a role that may not drive was granted the lease")


@SUITE.must("R-LEASE-19", "8.2 Requests and replies")
def release_of_nothing(bench: Bench) -> None:
    """`release` of what the asker does not hold is granted all the same."""
    human = Sender(Robot(bench), "teleop")
    reply = human.ask("release")
    bench.need(reply is not None, "no reply to release (R-REQ-01)")
    bench.expect(reply is not None and reply.ok, f"it was refused: {reply}")


@SUITE.must("R-LEASE-20", "8.3 Freshness")
def acquire_needs_echo(bench: Bench) -> None:
    """`acquire` without `echo` is refused as MALFORMED."""
    human = Sender(Robot(bench), "teleop")
    before = human.robot.status().refused.get("MALFORMED", 0)
    reply = human.ask("acquire", cite=False)
    bench.need(reply is not None, "no reply to acquire (R-REQ-01)")
    bench.expect(reply is not None and not reply.ok, "it was granted")
    counted = human.robot.reaches(lambda status: status.refused.get("MALFORMED", 0) > before, 400_000)
    bench.expect(counted, f"it was not counted as MALFORMED: {reply}")
