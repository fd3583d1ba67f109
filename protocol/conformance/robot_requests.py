"""Cases on requests that cannot be read or cite the wrong thing, and on counters that never fall. Pure."""

from typing import Final

from sightline.protocol.channels import ACK, REPLY, REQUEST
from sightline.protocol.conformance.bench import Bench
from sightline.conformance.case import Suite
from sightline.conformance.robot.fixture import Robot, Sender, as_json
from sightline.protocol.messages import Reply, Stamp, State

SUITE: Final = Suite("R")


def _operator(bench: Bench) -> Sender:
    operator = Sender(Robot(bench), "operator")
    operator.robot.status()
    return operator


def _refused(operator: Sender, reply: Reply | None, reason: str, before: int) -> None:
    """Fail the case unless the request was refused, and counted under `reason`."""
    bench = operator.bench
    bench.need(reply is not None, "no reply (R-REQ-01)")
    assert reply is not None
    bench.expect(not reply.ok, f"it was granted: {reply}")
    counted = operator.robot.reaches(lambda status: status.refused.get(reason, 0) > before, 400_000)
    bench.expect(counted, f"it was not counted as {reason}: {reply.detail}")


@SUITE.must("R-REQ-12", "8.1 Requests and replies")
def unreadable(bench: Bench) -> None:
    """A request that cannot be read is counted as MALFORMED and gets no reply."""
    operator, mark = _operator(bench), bench.mark()
    header = as_json({"v": 1, "source": operator.source, "session": operator.session, "seq": 1})
    verdict = operator.verdict(
        lambda: bench.publish(REQUEST, header, b'{"id":"one","verb":"disarm"}', operator.source)
    )
    bench.expect(verdict == "MALFORMED", f"it was {verdict or 'not counted'}")
    bench.rest(300_000)
    bench.expect(not bench.heard(REPLY, mark), "it was answered")


@SUITE.must("R-REQ-13", "8.3 Freshness")
def status_never_issued(bench: Bench) -> None:
    """`reset` that cites a `status` never issued is refused as UNKNOWN_FRAME."""
    operator = _operator(bench)
    stamp, before = operator.robot.stamp(), operator.robot.status().refused.get("UNKNOWN_FRAME", 0)
    unknown = Stamp(session=stamp.session, seq=stamp.seq + 5000, t_us=stamp.t_us)
    _refused(operator, operator.ask("reset", cite=unknown), "UNKNOWN_FRAME", before)


@SUITE.must("R-REQ-14", "8.3 Freshness")
def frame_for_status(bench: Bench) -> None:
    """`reset` that cites a frame in place of a `status` is refused as MALFORMED."""
    operator = _operator(bench)
    frame = operator.robot.frame()
    before = operator.robot.status().refused.get("MALFORMED", 0)
    echo = {"channel": "frame", "session": frame.session, "seq": frame.seq, "t_us": frame.t_us}
    _refused(operator, operator.ask("reset", cite=False, echo=echo), "MALFORMED", before)


@SUITE.must("R-STAT-10", "9. Status")
def unreadable_acks(bench: Bench) -> None:
    """An ack that cannot be read is counted as MALFORMED."""
    watcher = Sender(Robot(bench), bench.access.watcher)
    verdict = watcher.verdict(lambda: bench.publish(ACK, b'{"v":1,"seq":"x"}', b"", watcher.source))
    bench.expect(verdict == "MALFORMED", f"it was {verdict or 'not counted'}")


@SUITE.must("R-STAT-11", "9. Status")
def counters_never_fall(bench: Bench) -> None:
    """What `refused` counts only grows, over STOP and reset too."""
    operator = _operator(bench)
    sender = Sender(operator.robot)
    sender.need_unknown()
    before = operator.robot.next_status().refused
    operator.request("stop")
    stopped = operator.robot.reaches(lambda status: status.state is State.STOPPED, 500_000)
    bench.need(stopped, "STOP does not stop this robot (R-STOP-01)")
    bench.need(operator.granted("reset"), "reset is not granted (R-STOP-06)")
    after = operator.robot.next_status(2).refused
    fallen = {name: (count, after.get(name, 0)) for name, count in before.items() if after.get(name, 0) < count}
    bench.expect(not fallen, f"before STOP and after reset: {fallen}")
