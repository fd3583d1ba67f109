"""Cases on requests, replies and counters. Pure."""

from typing import Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import GOOD, Robot, Sender, armed, as_json
from sightline.protocol.channels import ACK, REPLY, REQUEST
from sightline.protocol.messages import Reply, Stamp, State

SUITE: Final = Suite("R")


def _operator(bench: Bench) -> Sender:
    operator = Sender(Robot(bench), "operator")
    operator.robot.status()
    return operator


def _replies(bench: Bench, since: int) -> list[Reply]:
    return [reply for one in bench.heard(REPLY, since) if (reply := one.payload(Reply)) is not None]


@SUITE.must("R-REQ-01", "8.1 Requests and replies")
def one_reply(bench: Bench) -> None:
    """A request that can be read gets exactly one reply."""
    operator, mark = _operator(bench), bench.mark()
    operator.request("disarm")
    bench.rest(700_000)
    bench.expect(len(bench.heard(REPLY, mark)) == 1, f"{len(bench.heard(REPLY, mark))} replies")
    bench.expect(len(_replies(bench, mark)) == 1, f"no Reply: {bench.heard(REPLY, mark)[0].message.payload!r}")


@SUITE.must("R-REQ-02", "8.1 Requests and replies")
def reply_names_the_request(bench: Bench) -> None:
    """`id` of a reply is the request's."""
    operator = _operator(bench)
    for number in (7, 123_456_789):
        reply = operator.ask("disarm", id=number)
        bench.need(reply is not None, "no reply (R-REQ-01)")
        assert reply is not None
        bench.expect(reply.id == number, f"id {reply.id}, the request had {number}")


@SUITE.must("R-REQ-03", "8.1 Requests and replies")
def reply_names_the_asker(bench: Bench) -> None:
    """`to` of a reply is the session of who asked."""
    first = _operator(bench)
    for asker in (first, Sender(first.robot, bench.access.watcher)):
        reply = asker.ask("disarm")
        bench.need(reply is not None, "no reply (R-REQ-01)")
        assert reply is not None
        bench.expect(reply.to == asker.session, f"to {reply.to}, asked by {asker.session}")


@SUITE.must("R-REQ-04", "8.2 Requests and replies")
def repeated_request(bench: Bench) -> None:
    """The same request, asked again because its reply was lost, is answered again."""
    operator = _operator(bench)
    for attempt in ("first", "second", "third"):
        reply = operator.ask("disarm", id=5, seq=5)
        bench.expect(reply is not None and reply.ok, f"the {attempt} time: {reply}")


@SUITE.must("R-REQ-05", "8.1 Requests and replies")
def unknown_verb(bench: Bench) -> None:
    """A verb that the robot does not know is counted as MALFORMED, granted by no reply, and changes nothing."""
    operator, mark = _operator(bench), bench.mark()
    before = operator.robot.status()
    verdict = operator.verdict(lambda: operator.request("fly"))
    bench.expect(verdict == "MALFORMED", f"it was {verdict or 'not counted'}")
    bench.expect(not any(reply.ok for reply in _replies(bench, mark)), "it was granted")
    bench.expect(operator.robot.status().state is before.state, f"then it is {operator.robot.status().state}")


@SUITE.must("R-REQ-06", "8.4 Requests and replies")
def source_disagrees(bench: Bench) -> None:
    """A request whose header names another source than its key is refused as UNKNOWN_SOURCE."""
    human = Sender(_operator(bench).robot, "teleop")
    verdict = human.verdict(lambda: human.request("disarm", source="operator"))
    bench.expect(verdict == "UNKNOWN_SOURCE", f"it was {verdict or 'not counted'}")


@SUITE.must("R-REQ-07", "8.1 Requests and replies")
def state_after(bench: Bench) -> None:
    """`state` of a reply is the state after the request."""
    operator = _operator(bench)
    reply = operator.ask("stop")
    bench.need(reply is not None and reply.ok, "STOP is not granted (R-STOP-03)")
    assert reply is not None
    bench.expect(reply.state == State.STOPPED, f"after STOP the reply says {reply.state}")


@SUITE.must("R-REQ-08", "8.1 Requests and replies")
def header_is_needed(bench: Bench) -> None:
    """A request without header is counted as MALFORMED and not obeyed, STOP included: the asker has no name."""
    operator = _operator(bench)
    verdict = operator.verdict(lambda: bench.publish(REQUEST, b"", b'{"id":1,"verb":"stop"}', operator.source))
    bench.expect(verdict == "MALFORMED", f"it was {verdict or 'not counted'}")


@SUITE.must("R-REQ-09", "2.1 JSON")
def unknown_fields(bench: Bench) -> None:
    """Unknown fields of a request are ignored."""
    reply = _operator(bench).ask("disarm", extra={"colour": "red"}, mood="calm")
    bench.expect(reply is not None and reply.ok, f"the reply: {reply}")


@SUITE.must("R-REQ-10", "8.1 Requests and replies")
def reason_in_words(bench: Bench) -> None:
    """A reply that refuses gives the reason in `detail`, and then words for a person."""
    reply = _operator(bench).ask("arm")
    bench.need(reply is not None and not reply.ok, "arm is granted without twists (R-ARM-01)")
    assert reply is not None
    told = reply.detail.startswith("NOT_ALLOWED: ") and len(reply.detail) > 15
    bench.expect(told, f"detail is {reply.detail!r}, expected NOT_ALLOWED: and why")


@SUITE.must("R-REQ-11", "8.3 Freshness")
def other_session(bench: Bench) -> None:
    """What lets a robot move again must cite this session of the robot, else OTHER_SESSION."""
    operator = _operator(bench)
    stamp = operator.robot.stamp()
    before = operator.robot.status().refused.get("OTHER_SESSION", 0)
    foreign = Stamp(session="fffffff0", seq=stamp.seq, t_us=stamp.t_us)
    reply = operator.ask("reset", cite=foreign)
    bench.need(reply is not None, "no reply (R-REQ-01)")
    assert reply is not None
    bench.expect(not reply.ok, f"the reply: {reply}")
    counted = operator.robot.reaches(lambda status: status.refused.get("OTHER_SESSION", 0) > before, 400_000)
    bench.expect(counted, f"it was not counted as OTHER_SESSION: {reply.detail}")


# --- status ----------------------------------------------------------------------------------------------------------


@SUITE.must("R-STAT-01", "9. Status")
def counts_each(bench: Bench) -> None:
    """Each refused twist is counted once under its reason."""
    sender = Sender(Robot(bench))
    sender.need_unknown()
    before = sender.robot.next_status().refused.get("UNKNOWN_FRAME", 0)
    for _ in range(5):
        frame = sender.robot.frame()
        sender.twist(frame, echo_seq=frame.seq + 5000)
        bench.rest(100_000)
    counted = sender.robot.next_status(2).refused.get("UNKNOWN_FRAME", 0) - before
    bench.expect(counted == 5, f"5 twists on unknown frames were counted {counted} times")


@SUITE.must("R-STAT-02", "9. Status")
def last_refusal(bench: Bench) -> None:
    """`last_refusal` names source and reason of the newest refusal, in words."""
    sender = Sender(Robot(bench))
    sender.need_good()
    verdict = sender.judged(b"nan|0")
    bench.need(verdict == "NOT_FINITE", "nan is not refused as NOT_FINITE (R-GRAM-04)")
    last = sender.robot.status().last_refusal
    told = last is not None and (last.source, last.reason) == ("vision", "NOT_FINITE") and last.detail
    bench.expect(told, f"last_refusal is {last}")


@SUITE.must("R-STAT-03", "9. Status")
def accepted_counts(bench: Bench) -> None:
    """`accepted` counts the twists that were accepted, and no others."""
    robot, driver = armed(bench)
    bench.rest(300_000)
    driver.drive(None)
    before, sent = robot.next_status(2).accepted, 4
    for _ in range(sent):
        frame = robot.frame()
        driver.twist(frame)
        driver.twist(frame, b"x")
        bench.rest(100_000)
    grown = robot.next_status(2).accepted - before
    bench.expect(grown == sent, f"{sent} good and {sent} bad twists raised `accepted` by {grown}")


@SUITE.must("R-STAT-04", "9. Status")
def frame_age(bench: Bench) -> None:
    """`frame_age_us` is the age of the frame behind the command in force, absent where there is none."""
    robot = Robot(bench)
    bench.expect(robot.status().frame_age_us is None, f"without a command it is {robot.status().frame_age_us}")
    armed(bench)
    bench.rest(300_000)
    age_us = robot.next_status().frame_age_us
    bench.expect(age_us is not None and age_us < 400_000, f"while driving it is {age_us}")


@SUITE.must("R-STAT-05", "9. Status")
def latency(bench: Bench) -> None:
    """`latency_us` is the robot's own measure from capture to accepted command."""
    robot, driver = armed(bench)
    driver.delay_us = driver.compute_us = 60_000
    bench.rest(1_000_000)
    latency_us = robot.next_status(2).latency_us
    bench.expect(latency_us is not None, "it is absent while driving")
    assert latency_us is not None
    bench.expect(55_000 <= latency_us <= 400_000, f"answers after 60 ms are said to take {latency_us / 1e3:.0f} ms")


@SUITE.must("R-STAT-06", "9. Status")
def sent_counts(bench: Bench) -> None:
    """`stream.sent` counts the frames."""
    robot = Robot(bench)
    Sender(robot)
    before, mark = robot.next_status(3).stream.sent, bench.mark()
    bench.rest(1_500_000)
    grown, came = robot.next_status(3).stream.sent - before, len(robot.frames(mark))
    bench.need(came > 5, "too few frames")
    bench.expect(grown >= came // 2, f"{came} frames came, `stream.sent` grew by {grown}")


@SUITE.must("R-STAT-07", "9. Status")
def reason_of_the_state(bench: Bench) -> None:
    """`reason` says why the robot does not move, and changes with the state."""
    robot = Robot(bench)
    unarmed = robot.status().reason
    Sender(robot, "operator").request("stop")
    bench.need(robot.reaches(lambda status: status.state is State.STOPPED, 500_000), "it does not stop (R-STOP-03)")
    stopped = robot.status().reason
    bench.expect(unarmed and stopped and unarmed != stopped, f"{unarmed!r}, then {stopped!r}")


@SUITE.must("R-STAT-08", "9. Status")
def applied_is_told(bench: Bench) -> None:
    """`applied` in `status` is what is given to the wheels: above zero while driving, zero at rest."""
    robot = Robot(bench)
    bench.expect(robot.status().applied == (0.0, 0.0), f"at rest it is {robot.status().applied}")
    armed(bench)
    bench.rest(700_000)
    mark = bench.mark()
    bench.rest(300_000)
    frames = [header.applied[0] for _, header in robot.frames(mark)]
    bench.need(frames and max(frames) > 0.05, "the frames show no motion (R-FRAM-12)")
    bench.expect(robot.next_status().applied[0] > 0.05, f"while driving it is {robot.status().applied}")


@SUITE.must("R-STAT-09", "9. Status")
def holder_is_none(bench: Bench) -> None:
    """`holder` is absent once a driver has released the lease."""
    first = Sender(Robot(bench))
    first.need_good()
    first.ask("release")
    second = Sender(first.robot)
    bench.need(second.judged() == GOOD, "release frees nothing (R-LEASE-15)")
    second.ask("release")
    free = first.robot.reaches(lambda status: status.holder is None, 400_000)
    bench.expect(free, f"{first.robot.status().holder} is said to drive")


# Cases on requests that cannot be read or cite the wrong thing, and on counters that never fall. Pure.


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
