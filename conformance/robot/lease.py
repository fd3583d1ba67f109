"""Cases on the lease: the driver, its rank, the duration, and the loss of the driver. Pure."""

from collections.abc import Callable
from typing import Any, Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import (
    CRAWL,
    GOOD,
    NOT_COUNTED,
    Sender,
    moving,
    operator,
    ready,
    ready_human,
    teleop,
    vision,
)
from sightline.protocol.channels import STATUS, TWIST
from sightline.protocol.messages import LeaseHolder, State
from sightline.protocol.proof import ProofChain

SUITE: Final = Suite("R")
_LEASE_US: Final = 1_000_000
_STALE_US: Final = 1_000_000
"""Above the greatest age of a frame, also at a robot with other limits than the default ones."""
_NOTICED_US: Final = 300_000
"""From the end of a lease until a `status` (10 Hz) shows it, with room for a slow machine."""
_TOKEN_US: Final = 100_000
"""Until a token or its end is known everywhere; a dead process takes 4 ms."""
_SUCCESSION_US: Final = 450_000
"""Silence after which a robot with the default limits accepts a successor, from 400 ms on."""


def _result_while_held(first: Sender, second: Sender, **changes: Any) -> str:
    """Return the result of the next twist of `second`, within a second of the last twist of `first`."""
    held_us = first.sent_us
    result = second.twist_result(**changes)
    in_time = second.sent_us - held_us < _LEASE_US * 9 // 10
    first.bench.need(in_time or result == NOT_COUNTED, "no frame came while the lease lasted")
    return result


def _expect_while_held(expected: str, first: Sender, second: Sender, what: str = "the twist", **changes: Any) -> None:
    """Fail the case unless the next twist of `second`, while `first` holds the lease, gets the result `expected`."""
    result = _result_while_held(first, second, **changes)
    first.bench.expect(result == expected, f"{what}: {result}, expected {expected}")


def _held_alone(bench: Bench) -> tuple[Sender, Sender]:
    """Return the holder of the lease, and a second driver that is rejected."""
    first = ready(bench)
    second = Sender(first.robot)
    bench.need(second.twist_result() == "NOT_HOLDER", "a second driver is not rejected (R-LEASE-02)")
    first.need_good()
    return first, second


def _held_for_a_while(bench: Bench) -> Sender:
    """Return the holder of the lease, at a robot where silence ends the lease."""
    first = ready(bench)
    first.fall_silent()
    bench.rest(_LEASE_US * 3 // 2)
    second = Sender(first.robot)
    bench.need(second.twist_result() == GOOD, "the lease does not end by silence (R-LEASE-04)")
    return second


def _with_token(bench: Bench) -> tuple[Sender, Callable[[], None]]:
    """Return the holder of a lease with a token, and a function that ends the token."""
    robot = ready(bench).robot
    bench.rest(_LEASE_US * 3 // 2)
    first = Sender(robot)
    withdraw = first.declare()
    bench.rest(_TOKEN_US)
    first.need_good()
    return first, withdraw


def _holder_is(sender: Sender, within_us: int = 400_000) -> bool:
    me = LeaseHolder.of(sender.source, sender.session)
    return sender.robot.reaches(lambda status: status.holder == me, within_us)


@SUITE.must("R-LEASE-01", "6.1 Lease", ready)
def first_holds(bench: Bench, sender: Sender) -> None:
    """The source of the first good twist holds the lease, and `status` names it as holder."""
    bench.expect(_holder_is(sender), f"holder is {sender.robot.status().holder}, not vision, session {sender.session}")


@SUITE.should("R-LEASE-03", "5.1 Order", ready)
def rejected_driver_receives_holder(bench: Bench, first: Sender) -> None:
    """The words of the rejection name the source that drives and the digest of its session, never the session."""
    bench.need(Sender(first.robot).twist_result() == "NOT_HOLDER", "a second driver is not rejected so (R-LEASE-02)")
    last = first.robot.status().last_refusal
    reported = last is not None and first.source in last.detail and (
        LeaseHolder.of(first.source, first.session).digest in last.detail and first.session not in last.detail)
    bench.expect(reported, f"last_refusal is {last}")


@SUITE.must("R-LEASE-04", "6.1 Lease", ready)
def lease_ends(bench: Bench, first: Sender) -> None:
    """The lease ends one second after the last good twist; then another may drive."""
    first.fall_silent()
    bench.rest(_LEASE_US * 3 // 2)
    Sender(first.robot).expect(GOOD, what="after 1.5 s of silence a second driver")


@SUITE.must("R-LEASE-05", "6.1 Lease")
def lease_lasts(bench: Bench) -> None:
    """Half a second after the last good twist the lease still holds."""
    first, second = _held_alone(bench)
    first.twist(first.robot.frame())
    bench.rest(_LEASE_US // 2)
    _expect_while_held("NOT_HOLDER", first, second, "a second driver")


@SUITE.must("R-LEASE-06", "6.1 Lease", _held_for_a_while)
def rejected_twists_renew_nothing(bench: Bench, first: Sender) -> None:
    """Rejected twists of the holder do not renew its lease: of an unknown frame, out of order, and too old."""
    first.need_unknown()
    old = first.robot.frame()
    bench.rest(_STALE_US)
    first.need_good()
    first.acks = False
    for _ in range(7):
        frame = first.robot.frame()
        first.twist(frame, echo_seq=frame.seq + 5000)
        first.twist(frame, seq=1)
        first.twist(old)
        bench.rest(200_000)
    bench.rest(first.robot.link_us())
    Sender(first.robot).expect(GOOD, what="after 1.4 s of rejected twists a second driver")


@SUITE.must("R-LEASE-07", "6.1 Lease", _held_for_a_while)
def acks_renew_nothing(bench: Bench, first: Sender) -> None:
    """Acks of the holder do not renew its lease."""
    mark = first.ack_seq
    bench.rest(_LEASE_US * 3 // 2)
    bench.need(first.ack_seq > mark + 2, "too few frames to acknowledge")
    Sender(first.robot).expect(GOOD, what="after 1.5 s of acks alone a second driver")


@SUITE.must("R-LEASE-08", "6.1 Lease", vision)
def acks_take_nothing(bench: Bench, watcher: Sender) -> None:
    """Acks take no lease."""
    bench.rest(1_700_000)  # the peer that acknowledged before owns the credit for another second
    bench.need(watcher.ack_seq > 2, "too few frames to acknowledge")
    holder = watcher.robot.next_status().holder
    bench.expect(holder is None, f"{holder} holds it, though no source sent a twist")


@SUITE.must("R-LEASE-10", "6.1 Lease")
def human_keeps(bench: Bench) -> None:
    """`vision` does not take the lease from `teleop`."""
    human = teleop(bench)
    human.need_good()
    _expect_while_held("NOT_HOLDER", human, Sender(human.robot), "a twist of vision")


@SUITE.must("R-LEASE-11", "6.2 Losing the human")
def lost_human_disarms(bench: Bench) -> None:
    """A human driver who falls silent disarms the robot, also while vision's commands flow."""
    human = moving(bench, "teleop")
    robot = human.robot
    Sender(robot).drive()
    human.fall_silent()
    reached = robot.becomes(State.DISARMED, within_us=2_500_000)
    bench.expect(reached, f"2.5 s after the human fell silent: {robot.status().state}, {robot.status().holder} drives")
    robot.next_status(5)
    bench.expect(robot.status().state is State.DISARMED, f"then it went on as {robot.status().state}")
    robot.expect_rest("after the human fell silent")


@SUITE.must("R-LEASE-12", "6.2 Losing the human")
def human_lets_go(bench: Bench) -> None:
    """A human driver who releases the lease disarms the robot."""
    human = moving(bench, "teleop")
    robot = human.robot
    human.drive(None)
    bench.need(human.granted("release"), "release is not granted (R-LEASE-15)")
    robot.expect_state(State.DISARMED, what="half a second after the release")
    bench.expect(robot.stops(700_000), f"the wheels still turn: {robot.status().applied}")
    robot.expect_rest("after the release")


@SUITE.must("R-LEASE-28", "6.2 Losing the human", moving)
def lost_human_who_only_acquired(bench: Bench, driver: Sender) -> None:
    """A human that took the lease by `acquire` and falls silent disarms the robot, while vision's commands flow."""
    human = Sender(driver.robot, "teleop", acks=False)
    bench.need(human.granted("acquire") and _holder_is(human), "acquire takes no lease (R-LEASE-13)")
    reached = driver.robot.becomes(State.DISARMED, within_us=2_500_000)
    state, holder = driver.robot.status().state, driver.robot.status().holder
    bench.expect(reached, f"2.5 s after a human acquired and fell silent: {state}, {holder} drives")
    driver.robot.expect_rest("after the human fell silent")


@SUITE.must("R-LEASE-29", "6.1 Lease", teleop)
def second_human_waits(_bench: Bench, human: Sender) -> None:
    """A second human is rejected as NOT_HOLDER."""
    human.need_good()
    _expect_while_held("NOT_HOLDER", human, Sender(human.robot, "teleop"), "a twist of the second")


@SUITE.must("R-LEASE-30", "6.1 Lease")
def guest_waits(bench: Bench) -> None:
    """`guest` does not take the lease from `vision`, without a header or with one."""
    bench.need(not bench.access.is_guarded, "where keys are required no guest is accepted")
    first = ready(bench)
    guest = Sender(first.robot, "guest", acks=False)
    bare = guest.result_of(lambda: bench.publish(TWIST, b"", CRAWL, "guest"))
    bench.need(bare in (GOOD, "NOT_HOLDER"), f"guests are not received here: {bare} (R-DIAL-01)")
    bench.expect(bare == "NOT_HOLDER", f"a guest's twist without header: {bare}, expected NOT_HOLDER")
    first.need_good()
    _expect_while_held("NOT_HOLDER", first, guest, "a guest's twist with a header")


@SUITE.must("R-LEASE-31", "6.1 Lease", ready)
def lease_is_one_second(bench: Bench, first: Sender) -> None:
    """One second after the last good twist `status` names no holder any more, and not before."""
    robot = first.robot
    bench.need(_holder_is(first), "`status` names no holder (R-LEASE-01)")
    sent_us = robot.clock_us() - (bench.now_us - first.sent_us)
    first.fall_silent()
    bench.need(robot.reaches(lambda status: status.holder is None, 2_500_000), "the lease does not end (R-LEASE-04)")
    lasted_us = robot.stamp().t_us - sent_us
    lasts = _LEASE_US * 9 // 10 <= lasted_us <= _LEASE_US + _NOTICED_US + robot.link_us()
    bench.expect(lasts, f"`status` named it for {lasted_us / 1e6:.2f} s")


@SUITE.must("R-LEASE-13", "8.2 Requests and replies", vision)
def acquire(bench: Bench, sender: Sender) -> None:
    """`acquire` takes the lease before the first twist."""
    bench.expect(sender.granted("acquire"), "acquire was not granted, though no source drove")
    holds = _holder_is(sender) or Sender(sender.robot).twist_result() == "NOT_HOLDER"
    bench.expect(holds, f"holder is {sender.robot.status().holder}, and a second driver is not rejected")


@SUITE.must("R-LEASE-14", "8.2 Requests and replies", _held_for_a_while)
def acquire_does_not_renew(bench: Bench, sender: Sender) -> None:
    """Requesting again does not keep the lease alive without twists."""
    sender.acks = False
    bench.rest(_LEASE_US * 3 // 2)
    began_us = bench.now_us
    bench.need(sender.granted("acquire"), "acquire is not granted (R-LEASE-13)")
    while bench.now_us - began_us < 700_000:  # the last one arrives before the lease of the first ends
        bench.rest(150_000)
        sender.send_request("acquire")
    bench.rest(500_000)
    Sender(sender.robot).expect(GOOD, what="1.2 s after the first, 0.5 s after the last acquire another")


@SUITE.must("R-LEASE-15", "8.2 Requests and replies", ready)
def release(bench: Bench, first: Sender) -> None:
    """`release` frees the lease at once."""
    bench.expect(first.granted("release"), "release by the holder was not granted")
    Sender(first.robot).expect(GOOD, what="then a second driver")


def _frees_nothing(first: Sender, second: Sender) -> None:
    second.request("release")
    _expect_while_held("NOT_HOLDER", first, second, "after its release a twist of the second driver")


SUITE.must_all(ready, {
    "R-LEASE-02": ("6.1 Lease", "A second driver of the same rank is rejected as NOT_HOLDER.",
                   lambda it: _expect_while_held("NOT_HOLDER", it, Sender(it.robot))),
    "R-LEASE-09": ("6.1 Lease", "`teleop` takes the lease from `vision`.",
                   lambda it: Sender(it.robot, "teleop").expect(GOOD, what="a twist of teleop")),
})
SUITE.must_all(_held_alone, {
    "R-LEASE-16": ("8.2 Requests and replies", "`release` by another source frees nothing.",
                   lambda held: _frees_nothing(*held)),
    "R-LEASE-17": ("8.2 Requests and replies", "`acquire` is rejected while an equal or higher rank drives.",
                   lambda held: held[1].expect_rejected("acquire", "", "a second vision service")),
})
SUITE.must_all(operator, {
    "R-LEASE-18": ("8.2 Requests and replies", "`acquire` is rejected to a role that may not drive.",
                   lambda it: it.expect_rejected("acquire", "", "a role that may not drive")),
})
SUITE.must_all(teleop, {
    "R-LEASE-19": ("8.2 Requests and replies", "`release` of what the requester does not hold is granted all the same.",
                   lambda it: it.bench.expect(it.reply("release").ok, "it was rejected")),
    "R-LEASE-20": ("8.3 Freshness", "`acquire` without `echo` is rejected as MALFORMED.",
                   lambda it: it.expect_rejected("acquire", "MALFORMED", "a request without echo", cite=False)),
})


# --- proof of identity -----------------------------------------------------------------------------------------------

_FORGED: Final = "ab" * 16


def _copied(bench: Bench) -> tuple[Sender, Sender]:
    """Return the driver, and a peer that knows its session and last number and has another chain."""
    return _copy_of(ready(bench))


def _copied_human(bench: Bench) -> tuple[Sender, Sender]:
    return _copy_of(ready_human(bench))


def _copy_of(first: Sender) -> tuple[Sender, Sender]:
    copy = Sender(first.robot, first.source, acks=False)
    copy.session, copy.seq = first.session, first.seq + 100
    return first, copy


SUITE.must_all(_copied, {
    "R-PROOF-01": ("6.6 Proof", "A twist that states the driver's session with another proof is NOT_PROVEN.",
                   lambda held: _expect_while_held("NOT_PROVEN", *held)),
    "R-PROOF-02": ("6.6 Proof", "A twist that states the driver's session without a proof is NOT_PROVEN.",
                   lambda held: _expect_while_held("NOT_PROVEN", *held, proof=None)),
})


SUITE.must_all(_copied_human, {
    "R-PROOF-13": ("6.6 Proof", "A twist that states the session of a human who drives, without its proof, is "
                   "NOT_PROVEN.", lambda held: _expect_while_held("NOT_PROVEN", *held, proof=None)),
})


@SUITE.must("R-PROOF-03", "6.6 Proof", ready)
def read_proof_is_over(_bench: Bench, first: Sender) -> None:
    """A proof that was accepted once proves nothing: a copy with a higher `seq` is NOT_PROVEN."""
    proof = first.proofs.next().proof
    first.expect(GOOD, proof=proof)
    _expect_while_held("NOT_PROVEN", first, first, proof=proof)


@SUITE.must("R-PROOF-04", "6.6 Proof", ready)
def copied_identity_bars_no_driver(_bench: Bench, first: Sender) -> None:
    """The `seq` of a twist that is NOT_PROVEN is not used up: the driver's next one is good."""
    _expect_while_held("NOT_PROVEN", first, first, proof=_FORGED, seq=first.seq + 1000)
    first.expect(GOOD)


@SUITE.must("R-PROOF-05", "6.6 Proof", ready)
def lost_commands_are_no_forgery(_bench: Bench, first: Sender) -> None:
    """A proof that is 64 commands ahead continues: 63 may be lost."""
    for _ in range(63):
        first.proofs.next()
    first.expect(GOOD)


@SUITE.must("R-PROOF-09", "6.6 Proof", ready)
def too_many_lost_commands(_bench: Bench, first: Sender) -> None:
    """A proof that is 65 commands ahead does not continue: NOT_PROVEN."""
    for _ in range(64):
        first.proofs.next()
    _expect_while_held("NOT_PROVEN", first, first)


@SUITE.must("R-PROOF-14", "6.6 Proof", teleop)
def acquire_commits(bench: Bench, human: Sender) -> None:
    """The proof of an `acquire` that takes the lease is a commitment: a twist with another proof is NOT_PROVEN."""
    bench.need(human.granted("acquire") and _holder_is(human), "acquire takes no lease (R-LEASE-13)")
    bench.expect((result := human.twist_result(proof=_FORGED)) == "NOT_PROVEN", f"the twist: {result}")


@SUITE.must("R-PROOF-15", "6.6 Proof", ready_human)
def request_uses_up_its_proof(bench: Bench, human: Sender) -> None:
    """The proof of a granted request is the last one accepted: a twist that repeats it is NOT_PROVEN."""
    for verb in ("reset", "acquire"):
        used = human.proofs.next().proof
        bench.need(human.granted(verb, proof=used), f"{verb} is not granted (R-LEASE-13)")
        _expect_while_held("NOT_PROVEN", human, human, f"a twist with the proof of {verb}", proof=used)
        human.need_good()


@SUITE.must("R-PROOF-16", "6.6 Proof", vision)
def keys_demand_proofs(bench: Bench, first: Sender) -> None:
    """A twist and an `acquire` without a proof are NOT_PROVEN where peers show keys, also of a new session."""
    bench.need(bench.access.is_guarded, "no keys were named (--secure, --token)")
    first.expect("NOT_PROVEN", proof=None)
    human = Sender(first.robot, "teleop", acks=False)
    human.expect_rejected("acquire", "NOT_PROVEN", "an acquire without a proof", proof=None)


@SUITE.must("R-PROOF-06", "6.6 Proof", ready)
def chain_is_renewed(_bench: Bench, first: Sender) -> None:
    """A driver that announced its next chain continues in it."""
    following = ProofChain(lambda count: bytes(range(count)))
    first.expect(GOOD, proof=first.proofs.next().proof, next_proof=following.next().proof)
    first.proofs = following
    first.expect(GOOD, what="the first twist of the next chain")
    first.expect(GOOD, what="the second twist of the next chain")


@SUITE.must("R-PROOF-07", "6.6 Proof", teleop)
def copied_identity_releases_nothing(bench: Bench, human: Sender) -> None:
    """A `release` that states the driver's session without its proof is NOT_PROVEN, and the lease stays."""
    bench.need(human.twist_result() == GOOD, "a twist of teleop is not accepted")
    copy = Sender(human.robot, "teleop", acks=False)
    copy.session = human.session
    copy.expect_rejected("release", "NOT_PROVEN", "a release by a copied identity")
    human.expect(GOOD)
    bench.expect(_holder_is(human), "the lease is gone")


@SUITE.must("R-PROOF-10", "6.6 Proof", teleop)
def copied_identity_requests_nothing(bench: Bench, human: Sender) -> None:
    """`arm`, `reset` and `acquire` that state the driver's session without its proof are NOT_PROVEN."""
    human.need_good()
    human.drive()
    bench.need(bench.wait(lambda: human.seq >= 9, 3_000_000), "too few frames")
    copy = Sender(human.robot, "teleop", acks=False)
    copy.session = human.session
    for verb in ("acquire", "reset", "arm"):
        copy.expect_rejected(verb, "NOT_PROVEN", f"{verb} by a copied identity without a proof", proof=None)
        copy.expect_rejected(verb, "NOT_PROVEN", f"{verb} by a copied identity with another proof")


@SUITE.must("R-PROOF-11", "6.6 Proof", ready)
def announced_element_proves_nothing(_bench: Bench, first: Sender) -> None:
    """The element that `next_proof` announces is NOT_PROVEN as a proof: every peer has read it."""
    announced = ProofChain(lambda count: bytes(range(count))).next().proof
    first.expect(GOOD, proof=first.proofs.next().proof, next_proof=announced)
    _expect_while_held("NOT_PROVEN", first, first, proof=announced)


@SUITE.must("R-PROOF-12", "6.6 Proof", ready)
def next_chain_of_the_last_alone(_bench: Bench, first: Sender) -> None:
    """A next chain that the last accepted command did not announce is NOT_PROVEN."""
    following = ProofChain(lambda count: bytes(range(count)))
    first.expect(GOOD, proof=first.proofs.next().proof, next_proof=following.next().proof)
    first.expect(GOOD, what="the next twist, which announces nothing")
    _expect_while_held("NOT_PROVEN", first, first, proof=following.next().proof)


@SUITE.must("R-PROOF-08", "6.7 Digest", ready)
def status_shows_no_session(bench: Bench, first: Sender) -> None:
    """No status contains the driver's session, nor does it after a rejected second driver."""
    Sender(first.robot).twist_result()
    received = bench.newest(STATUS)
    found = received is not None and first.session.encode() in received.message.payload
    bench.expect(not found, "the status contains the session")


# --- tokens ----------------------------------------------------------------------------------------------------------


@SUITE.must("R-LEASE-21", "6.8 Tokens", _with_token)
def token_ends_the_lease(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """The lease ends with the token of the holder."""
    first, withdraw = held
    second = Sender(first.robot)
    bench.need(second.twist_result() == "NOT_HOLDER", "a second driver is not rejected (R-LEASE-02)")
    withdraw()
    bench.rest(_TOKEN_US)
    second.expect(GOOD, what="after the end of the token a second driver")


@SUITE.must("R-LEASE-22", "6.8 Tokens", _with_token)
def session_without_its_token_drives_no_more(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """A session whose token ended never drives again, also when no other drives."""
    first, withdraw = held
    withdraw()
    bench.rest(_TOKEN_US)
    second = Sender(first.robot)
    bench.need(second.twist_result() == GOOD, "the lease does not end with the token (R-LEASE-21)")
    second.fall_silent()
    bench.rest(_LEASE_US * 3 // 2)
    first.expect("NOT_HOLDER", what="1.5 s after the others, a twist of the session whose token ended")


@SUITE.must("R-LEASE-23", "6.8 Tokens", _with_token)
def other_tokens_end_nothing(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """The end of the token of another session does not end the lease."""
    first, _ = held
    second = Sender(first.robot)
    withdraw = second.declare()
    bench.rest(_TOKEN_US)
    first.need_good()
    withdraw()
    bench.rest(_TOKEN_US)
    what = "after the end of a token that is not of the holder, a third driver"
    _expect_while_held("NOT_HOLDER", first, Sender(first.robot), what)


def _result_after_silence(first: Sender, second: Sender) -> str:
    """Return the result of a twist of `second` after 0.45 s of silence of the holder, within its lease."""
    first.twist(first.robot.frame())
    first.fall_silent()
    first.bench.rest(_SUCCESSION_US)
    return _result_while_held(first, second)


@SUITE.must("R-LEASE-24", "6.8 Tokens", _with_token)
def silent_holder_is_succeeded(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """A holder with a token that is silent for 0.45 s yields to another driver with a token."""
    first, _ = held
    second = Sender(first.robot)
    second.declare()
    result = _result_after_silence(first, second)
    bench.expect(result == GOOD, f"after 0.45 s of silence of the holder, a driver with a token: {result}")


@SUITE.must("R-LEASE-25", "6.8 Tokens", _with_token)
def only_a_token_succeeds(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """A holder with a token that is silent for 0.45 s does not yield to a driver without one."""
    first, _ = held
    result = _result_after_silence(first, Sender(first.robot))
    bench.expect(result == "NOT_HOLDER", f"after 0.45 s of silence, a driver without a token: {result}")


@SUITE.must("R-LEASE-26", "6.8 Tokens", _with_token)
def token_is_kept_over_another_driver(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """The lease of a session that drives again after another driver ends with its token, also after many commands."""
    first, withdraw = held
    for _ in range(2):  # its first 64 proofs are over
        for _ in range(40):
            first.proofs.next()
        first.need_good()
    for sender in (Sender(first.robot), first):
        bench.rest(_LEASE_US * 3 // 2)
        sender.need_good()
    withdraw()
    bench.rest(_TOKEN_US)
    third = Sender(first.robot)
    _expect_while_held(GOOD, first, third, "after the end of the token a third driver")


@SUITE.must("R-LEASE-27", "6.8 Tokens", _with_token)
def driver_that_left_takes_no_lease(bench: Bench, held: tuple[Sender, Callable[[], None]]) -> None:
    """A driver whose token has just ended takes no lease with its first command, which its token may overtake."""
    first, _ = held
    first.fall_silent()
    bench.rest(_LEASE_US * 3 // 2)
    second = Sender(first.robot)
    withdraw = second.declare()
    bench.rest(_TOKEN_US)
    withdraw()
    bench.rest(_TOKEN_US)
    second.expect("NOT_HOLDER", what="after the end of its token the first twist of a driver")
    Sender(first.robot).expect(GOOD, what="after that a driver without a token")
