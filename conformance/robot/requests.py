"""Cases on requests, replies and counters. Pure."""

from typing import Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import (
    GOOD,
    Robot,
    Sender,
    armed,
    as_json,
    operator,
    ready,
    teleop,
    vision,
    watcher,
)
from sightline.protocol.channels import ACK, REPLY, REQUEST, Channel
from sightline.protocol.messages import Reply, Stamp, State
from sightline.protocol.proof import session_digest

SUITE: Final = Suite("R")


def _replies(bench: Bench, since: int) -> list[Reply]:
    return [reply for one in bench.received(REPLY, since) if (reply := one.payload(Reply)) is not None]


@SUITE.must("R-REQ-01", "8.1 Requests and replies", operator)
def one_reply(bench: Bench, operator: Sender) -> None:
    """A request that can be read gets exactly one reply."""
    mark = bench.mark()
    operator.send_request("disarm")
    bench.rest(700_000)
    bench.expect(len(bench.received(REPLY, mark)) == 1, f"{len(bench.received(REPLY, mark))} replies")
    bench.expect(len(_replies(bench, mark)) == 1, f"no Reply: {bench.received(REPLY, mark)[0].message.payload!r}")


@SUITE.must("R-REQ-02", "8.1 Requests and replies", operator)
def reply_names_the_request(bench: Bench, operator: Sender) -> None:
    """`id` of a reply is the request's."""
    for number in (7, 123_456_789):
        reply = operator.reply("disarm", id=number)
        bench.expect(reply.id == number, f"id {reply.id}, the request had {number}")


@SUITE.must("R-REQ-03", "8.1 Requests and replies", operator)
def reply_names_the_requester(bench: Bench, first: Sender) -> None:
    """`to` of a reply is the digest of the requester, not its session."""
    for asker in (first, Sender(first.robot, bench.access.watcher)):
        reply = asker.reply("disarm")
        digest = session_digest(asker.source, asker.session)
        bench.expect(reply.to == digest, f"to {reply.to}, requested by {digest}")


@SUITE.must("R-REQ-04", "8.2 Requests and replies", operator)
def repeated_request(_bench: Bench, operator: Sender) -> None:
    """The same request, requested again because its reply was lost, is answered again."""
    for attempt in ("first", "second", "third"):
        operator.expect_granted("disarm", f"the {attempt} time", id=5, seq=5)


@SUITE.must("R-REQ-15", "8.4 Requests and replies", operator)
def seq_of_requests(_bench: Bench, operator: Sender) -> None:
    """The `seq` of a request is not validated: one below the last is granted."""
    for seq in (1000, 3):
        operator.expect_granted("disarm", f"with seq {seq}", seq=seq)


@SUITE.must("R-REQ-05", "8.1 Requests and replies", operator)
def unknown_verb(bench: Bench, operator: Sender) -> None:
    """A verb that the robot does not know is counted as MALFORMED, granted by no reply, and changes nothing."""
    mark = bench.mark()
    before = operator.robot.status()
    operator.expect_result("MALFORMED", lambda: operator.send_request("fly"))
    bench.expect(not any(reply.ok for reply in _replies(bench, mark)), "it was granted")
    bench.expect(operator.robot.status().state is before.state, f"then it is {operator.robot.status().state}")


@SUITE.must("R-REQ-07", "8.1 Requests and replies", operator)
def state_after(bench: Bench, operator: Sender) -> None:
    """`state` of a reply is the state after the request."""
    reply = operator.reply("stop")
    bench.need(reply.ok, "STOP is not granted (R-STOP-03)")
    bench.expect(reply.state == State.STOPPED, f"after STOP the reply reports {reply.state}")


@SUITE.must("R-REQ-10", "8.1 Requests and replies", operator)
def reason_in_words(bench: Bench, operator: Sender) -> None:
    """A reply that rejects gives the reason in `detail`, and then an explanation."""
    reply = operator.reply("arm")
    bench.need(not reply.ok, "arm is granted without twists (R-ARM-01)")
    reported = reply.detail.startswith("NOT_ALLOWED: ") and len(reply.detail) > 15
    bench.expect(reported, f"detail is {reply.detail!r}, expected NOT_ALLOWED: and why")


# --- status ----------------------------------------------------------------------------------------------------------


@SUITE.must("R-STAT-01", "9. Status", vision)
def counts_each(bench: Bench, sender: Sender) -> None:
    """Each rejected twist is counted once under its reason."""
    sender.need_unknown()
    before = sender.robot.next_status().refused.get("UNKNOWN_FRAME", 0)
    for _ in range(5):
        frame = sender.robot.frame()
        sender.twist(frame, echo_seq=frame.seq + 5000)
        bench.rest(100_000)
    counted = sender.robot.next_status(2).refused.get("UNKNOWN_FRAME", 0) - before
    bench.expect(counted == 5, f"5 twists on unknown frames were counted {counted} times")


@SUITE.must("R-STAT-02", "9. Status", ready)
def last_refusal(bench: Bench, sender: Sender) -> None:
    """`last_refusal` names source and reason of the newest rejection, in words."""
    result = sender.twist_result(b"nan|0")
    bench.need(result == "NOT_FINITE", "nan is not rejected as NOT_FINITE (R-GRAM-04)")
    last = sender.robot.status().last_refusal
    reported = last is not None and (last.source, last.reason) == ("vision", "NOT_FINITE") and last.detail
    bench.expect(reported, f"last_refusal is {last}")


@SUITE.must("R-STAT-03", "9. Status", armed)
def accepted_counts(bench: Bench, driver: Sender) -> None:
    """`accepted` counts the twists that were accepted, and no others."""
    bench.rest(300_000)
    driver.drive(None)
    before, sent = driver.robot.next_status(2).accepted, 4
    for _ in range(sent):
        frame = driver.robot.frame()
        driver.twist(frame)
        driver.twist(frame, b"x")
        bench.rest(100_000)
    grown = driver.robot.next_status(2).accepted - before
    bench.expect(grown == sent, f"{sent} good and {sent} bad twists raised `accepted` by {grown}")


@SUITE.must("R-STAT-04", "9. Status", Robot)
def frame_age(bench: Bench, robot: Robot) -> None:
    """`frame_age_us` is the age of the frame behind the command in force, absent without one."""
    bench.expect(robot.status().frame_age_us is None, f"without a command it is {robot.status().frame_age_us}")
    driver = armed(bench)
    driver.delay_us = driver.compute_us = 60_000
    bench.rest(500_000)
    seen = robot.reaches(lambda status: 60_000 <= (status.frame_age_us or 0) < 400_000, 1_500_000)
    bench.expect(seen, f"driven 60 ms late it is {robot.status().frame_age_us} us")


@SUITE.must("R-STAT-05", "9. Status", armed)
def latency(bench: Bench, driver: Sender) -> None:
    """`latency_us` is the robot's own measure from capture to accepted command."""
    driver.delay_us = driver.compute_us = 60_000
    bench.rest(1_000_000)
    latency_us = driver.robot.next_status(2).latency_us
    bench.expect(latency_us is not None, "it is absent while driving")
    assert latency_us is not None
    bench.expect(55_000 <= latency_us <= 400_000, f"answers after 60 ms are reported to take {latency_us / 1e3:.0f} ms")


@SUITE.must("R-STAT-06", "9. Status", Robot)
def sent_counts(bench: Bench, robot: Robot) -> None:
    """`stream.sent` counts the frames."""
    Sender(robot)
    before, mark = robot.next_status(3).stream.sent, bench.mark()
    bench.rest(1_500_000)
    grown, came = robot.next_status(3).stream.sent - before, len(robot.frames(mark))
    bench.need(came > 5, "too few frames")
    bench.expect(grown >= came // 2, f"{came} frames came, `stream.sent` grew by {grown}")


@SUITE.must("R-STAT-12", "9. Status", Robot)
def rate_is_reported(bench: Bench, robot: Robot) -> None:
    """`stream.fps` is the rate of the frames."""
    Sender(robot)
    bench.rest(1_500_000)
    mark = bench.mark()
    bench.rest(1_500_000)
    fps = len(robot.frames(mark)) / 1.5
    bench.need(fps >= 4, "too few frames")
    reported = robot.next_status(3).stream.fps
    bench.expect(fps / 2 <= reported <= fps * 2, f"{fps:.0f} frames a second came, `stream.fps` is {reported:g}")


@SUITE.must("R-STAT-07", "9. Status", Robot)
def reason_of_the_state(bench: Bench, robot: Robot) -> None:
    """`reason` reports why the robot does not move, and changes with the state."""
    unarmed = robot.status().reason
    Sender(robot, "operator").send_request("stop")
    bench.need(robot.becomes(State.STOPPED), "it does not stop (R-STOP-03)")
    stopped = robot.status().reason
    bench.expect(unarmed and stopped and unarmed != stopped, f"{unarmed!r}, then {stopped!r}")


@SUITE.must("R-STAT-13", "2.3 Text", ready)
def texts_are_one_line(bench: Bench, sender: Sender) -> None:
    """Texts for an operator are one line: `reason` and `last_refusal` of a status, `detail` of a reply."""
    sender.twist_result(b"nan|0")
    reply = Sender(sender.robot, "operator").reply("arm")
    status = sender.robot.status()
    texts = {"reason": status.reason, "detail of a reply": reply.detail,
             "detail of last_refusal": status.last_refusal.detail if status.last_refusal else ""}
    for name, text in texts.items():
        bench.expect(text.isprintable(), f"{name} is {text!r}")


@SUITE.must("R-STAT-08", "9. Status", Robot)
def applied_is_reported(bench: Bench, robot: Robot) -> None:
    """`applied` in `status` is what is given to the wheels: above zero while driving, zero at rest."""
    bench.expect(robot.status().applied == (0.0, 0.0), f"at rest it is {robot.status().applied}")
    armed(bench)
    bench.rest(700_000)
    mark = bench.mark()
    bench.rest(300_000)
    frames = [header.applied[0] for _, header in robot.frames(mark)]
    bench.need(frames and max(frames) > 0.05, "the frames show no motion (R-FRAM-12)")
    bench.expect(robot.next_status().applied[0] > 0.05, f"while driving it is {robot.status().applied}")


@SUITE.must("R-STAT-09", "9. Status", ready)
def holder_is_none(bench: Bench, first: Sender) -> None:
    """`holder` is absent once a driver has released the lease."""
    first.request("release")
    second = Sender(first.robot)
    bench.need(second.twist_result() == GOOD, "release frees nothing (R-LEASE-15)")
    second.request("release")
    free = first.robot.reaches(lambda status: status.holder is None, 400_000)
    bench.expect(free, f"{first.robot.status().holder} is reported to drive")


# Cases on requests that are invalid or cite the wrong message, and on counters that never decrease. Pure.


@SUITE.must("R-REQ-12", "8.1 Requests and replies", operator)
def unreadable(bench: Bench, operator: Sender) -> None:
    """A request that cannot be read is counted as MALFORMED and gets no reply."""
    mark = bench.mark()
    header = as_json({"v": 1, "source": operator.source, "session": operator.session, "seq": 1})
    result = operator.result_of(
        lambda: bench.publish(REQUEST, header, b'{"id":"one","verb":"disarm"}', operator.source)
    )
    bench.expect(result == "MALFORMED", f"it was {result}")
    bench.rest(300_000)
    bench.expect(not bench.received(REPLY, mark), "it was answered")


def _cites_unknown_status(operator: Sender) -> None:
    stamp = operator.robot.stamp()
    for seq, t_us, what in ((stamp.seq + 5000, stamp.t_us, "a status never issued"),
                            (stamp.seq, stamp.t_us - 1, "a status with `t_us` off by one")):
        unknown = Stamp(session=stamp.session, seq=seq, t_us=t_us)
        operator.expect_rejected("reset", "UNKNOWN_FRAME", what, cite=unknown)


def _cites_other_session(operator: Sender) -> None:
    stamp = operator.robot.stamp()
    foreign = Stamp(session="fffffff0", seq=stamp.seq, t_us=stamp.t_us)
    operator.expect_rejected("reset", "OTHER_SESSION", "another session", cite=foreign)


def _cites_frame(operator: Sender) -> None:
    frame = operator.robot.frame()
    echo = {"channel": "frame", "session": frame.session, "seq": frame.seq, "t_us": frame.t_us}
    operator.expect_rejected("reset", "MALFORMED", "a frame in place of a status", cite=False, echo=echo)


def _is_malformed(sender: Sender, channel: Channel, header: bytes, payload: bytes) -> None:
    sender.expect_result("MALFORMED", lambda: sender.bench.publish(channel, header, payload, sender.source))


SUITE.must_all(operator, {
    "R-REQ-08": ("8.1 Requests and replies", "A request without header is counted as MALFORMED and not applied, STOP "
                 "included: the requester has no name.",
                 lambda it: _is_malformed(it, REQUEST, b"", b'{"id":1,"verb":"stop"}')),
    "R-REQ-09": ("2.1 JSON", "Unknown fields of a request are ignored.",
                 lambda it: it.expect_granted("disarm", "the reply", extra={"colour": "red"}, mood="calm")),
    "R-REQ-11": ("8.3 Freshness", "What lets a robot move again must cite this session of the robot, else "
                 "OTHER_SESSION.", _cites_other_session),
    "R-REQ-13": ("8.3 Freshness", "`reset` that cites a `status` never issued, or not with that `t_us`, is "
                 "rejected as UNKNOWN_FRAME.",
                 _cites_unknown_status),
    "R-REQ-14": ("8.3 Freshness", "`reset` that cites a frame in place of a `status` is rejected as MALFORMED.",
                 _cites_frame),
})
SUITE.must_all(watcher, {
    "R-STAT-10": ("9. Status", "An ack that cannot be read is counted as MALFORMED.",
                  lambda it: _is_malformed(it, ACK, b'{"v":1,"seq":"x"}', b"")),
})
SUITE.must_all(teleop, {
    "R-REQ-06": ("8.4 Requests and replies", "A request whose header names another source than its key is rejected as "
                 "UNKNOWN_SOURCE.",
                 lambda it: it.expect_result("UNKNOWN_SOURCE", lambda: it.send_request("disarm", source="operator"))),
})


@SUITE.must("R-STAT-11", "9. Status", operator)
def counters_never_fall(bench: Bench, operator: Sender) -> None:
    """`accepted` and the counters in `refused` never decrease, also over STOP and reset."""
    driver = armed(bench)
    driver.drive(None)
    bench.need(operator.robot.stops(2_000_000), "it does not stop (R-SIL-01)")
    driver.robot.next_status()
    driver.need_unknown()
    before = operator.robot.next_status()
    operator.send_request("stop")
    bench.need(operator.robot.becomes(State.STOPPED), "STOP does not stop this robot (R-STOP-01)")
    bench.need(operator.granted("reset"), "reset is not granted (R-STOP-06)")
    after = operator.robot.next_status(2)
    counts = {"accepted": (before.accepted, after.accepted)}
    counts |= {name: (count, after.refused.get(name, 0)) for name, count in before.refused.items()}
    fallen = {name: pair for name, pair in counts.items() if pair[1] < pair[0]}
    bench.expect(not fallen, f"before STOP and after reset: {fallen}")
