"""Cases on guests, on invalid messages, and on peers that connect and disconnect. Pure."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Final

from sightline.conformance.case import Bench, Suite
from sightline.conformance.robot.fixture import (
    CRAWL,
    DRIVEN,
    GOOD,
    Robot,
    Sender,
    armed,
    as_json,
    is_arm_granted,
    ready,
    vision,
    watcher,
)
from sightline.protocol.channels import FRAME, REQUEST, STATUS, TWIST, key_for
from sightline.protocol.messages import LeaseHolder, Stamp, State, Status

SUITE: Final = Suite("R")
_GUEST_MPS: Final = 0.2
_GUEST_RAD_S: Final = 1.0
_GUEST_M: Final = 0.3
"""Distance on one twist after the first status that shows it: 0.25 m, and a stop from 0.2 m/s."""
_GUEST_EVERY_US: Final = 50_000
_HOLDS_US: Final = 600_000
"""From a guest's last twist until a `status` shows HOLD, with room for a slow machine."""
_BRAKES_US: Final = 400_000
_HELD_US: Final = 1_000_000
"""A lease lasts so long after the last good command."""


def _bare(bench: Bench, text: bytes = CRAWL) -> None:
    bench.publish(TWIST, b"", text, "guest")


def _guest(bench: Bench) -> Sender:
    """Return a watcher at a robot that accepts guests."""
    watcher = Sender(Robot(bench), bench.access.watcher)
    result = watcher.result_of(lambda: _bare(bench))
    bench.need(result == GOOD, f"guests are not received here: {result}")
    return watcher


@SUITE.must("R-DIAL-01", "4.6 Guests")
def guests(bench: Bench) -> None:
    """A twist of `guest` without header is validated, or rejected as UNKNOWN_SOURCE where guests are switched off."""
    bench.need(not bench.access.is_guarded, "where keys are required no guest is accepted")
    watcher = Sender(Robot(bench), bench.access.watcher)
    result = watcher.result_of(lambda: _bare(bench))
    bench.expect(result in (GOOD, "UNKNOWN_SOURCE"), f"it was {result}")


@SUITE.must("R-DIAL-03", "6.1 Lease", _guest)
def guests_yield(bench: Bench, watcher: Sender) -> None:
    """`vision` takes the lease from a guest."""
    result = Sender(watcher.robot).twist_result()
    bench.need(result in (GOOD, "NOT_HOLDER"), f"a twist of vision is {result} (R-CAUS-01)")
    bench.expect(result == GOOD, f"a twist of vision is {result}")


@SUITE.must("R-DIAL-04", "4.6 Guests")
def guests_with_header(bench: Bench) -> None:
    """A guest's twist with a header is validated by it."""
    _guest(bench)
    foreign = Sender(Robot(bench)).twist_result(echo_session="fffffff0")
    bench.need(foreign == "OTHER_SESSION", f"another session is {foreign} (R-CAUS-06)")
    sender = Sender(Robot(bench), "guest")
    sender.expect("OTHER_SESSION", echo_session="fffffff0", what="one that cites another session")


@dataclass(slots=True)
class _Guest:
    """A guest that sends its twists in turn."""

    watcher: Sender
    twists: tuple[bytes, ...] = (CRAWL, b"0.1100|0.0000")
    sent: int = 0

    def send(self) -> None:
        """Send the next twist, and continue every 50 ms."""
        bench = self.watcher.bench
        if self.twists:
            _bare(bench, self.twists[self.sent % len(self.twists)])
        self.sent += 1
        bench.after(_GUEST_EVERY_US, self.send)

    def expect_held(self, most_us: int, text: bytes) -> None:
        """Fail the case unless a robot that receives only this twist holds in time, with its wheels at zero."""
        self.twists = (text,)
        robot, bench = self.watcher.robot, self.watcher.bench
        bench.rest(most_us + _BRAKES_US)
        applied, what = robot.next_status(2).applied, f"after {most_us / 1e6:g} s of {text.decode()}"
        bench.expect(applied == (0.0, 0.0), f"{what} it still drives, at {applied}")


def _sending_guest(bench: Bench) -> _Guest:
    """Return a guest that sends changing twists. The robot is not armed."""
    guest = _Guest(_guest(bench))
    guest.send()
    bench.rest(700_000)
    return guest


def _drives(guest: _Guest) -> bool:
    """Arm the robot for a guest. Returns True if the robot follows it."""
    robot = guest.watcher.robot
    is_arm_granted(guest.watcher)
    return robot.becomes(*DRIVEN, within_us=1_500_000)


def _driving_guest(bench: Bench) -> _Guest:
    """Return a guest that drives the robot with changing twists."""
    guest = _sending_guest(bench)
    bench.need(_drives(guest), "guests do not drive here (R-DIAL-09)")
    turns = guest.watcher.robot.reaches(lambda status: status.applied[0] > 0.05, 1_000_000)
    bench.need(turns, "its `status` shows no motion (R-STAT-08)")
    return guest


@SUITE.must("R-DIAL-09", "6.4 Arming", _sending_guest)
def guests_are_armed(bench: Bench, guest: _Guest) -> None:
    """A guest that sends good twists can be armed, and drives."""
    bench.expect(_drives(guest), f"it is {guest.watcher.robot.status().state}: {guest.watcher.robot.status().reason}")


def _expect_crawl(robot: Robot, drive: Callable[[tuple[bytes, ...]], None]) -> None:
    """Fail the case unless the guest whose twists `drive` sets drives and turns within its limits."""
    # A robot may stop a guest that repeats one twist, also twists that differ only above the limit.
    fast, turning = (b"3.0|0.0", b"3.0|0.3"), (b"0.0|9.0", b"0.1|9.0")
    for texts, axis, most in ((fast, 0, _GUEST_MPS), (turning, 1, _GUEST_RAD_S)):
        drive(texts)
        robot.bench.rest(1_000_000)
        applied = robot.next_status(2).applied[axis]
        robot.bench.expect(applied > 0.05, f"{texts[0].decode()} does not drive it: {robot.status().applied}")
        robot.bench.expect(applied <= most + 0.01, f"{applied} {('m/s', 'rad/s')[axis]}")


@SUITE.must("R-DIAL-02", "4.6 Guests", _driving_guest)
def guests_crawl(_bench: Bench, guest: _Guest) -> None:
    """A guest's twist is limited to 0.2 m/s and 1 rad/s."""
    _expect_crawl(guest.watcher.robot, partial(setattr, guest, "twists"))


@SUITE.must("R-DIAL-10", "4.6 Guests", _guest)
def guests_with_header_crawl(bench: Bench, watcher: Sender) -> None:
    """A guest's twist with a header is limited to 0.2 m/s and 1 rad/s too."""
    bench.rest(1_200_000)  # until the lease of the guest without header has ended
    guest = armed(bench, "guest")
    _expect_crawl(watcher.robot, lambda texts: guest.drive(texts[0]))


@SUITE.must("R-DIAL-05", "4.6 Guests", _driving_guest)
def guests_are_silent_soon(bench: Bench, guest: _Guest) -> None:
    """A guest's twist lives 250 ms; then the robot holds."""
    guest.twists, robot = (), guest.watcher.robot
    held = robot.reaches(lambda status: status.state is State.HOLD, _HOLDS_US)
    bench.expect(held, f"{_HOLDS_US / 1e6:g} s of silence left it {robot.status().state}")
    state = robot.next_status(2).state
    bench.expect(state is State.HOLD, f"then it is {state}")


@SUITE.must("R-DIAL-07", "4.6 Guests", _driving_guest)
def guests_repeat_briefly(bench: Bench, guest: _Guest) -> None:
    """A robot that receives the same guest's twist for 2 s or 0.25 m holds, and drives on once the twist changes."""
    guest.expect_held(2_000_000, b"0.0600|0.0000")
    guest.twists = (b"0.2000|0.0000",)
    again = guest.watcher.robot.reaches(lambda status: status.applied[0] > 0.05, 1_000_000)
    bench.expect(again, "another twist does not drive it on")
    mark, robot = bench.mark(), guest.watcher.robot
    bench.rest(2_000_000)
    read = ((one.at_us, one.payload(Status)) for one in bench.received(STATUS, mark))
    reported = [(at_us, status.applied[0]) for at_us, status in read if status]
    driven_m = sum((after[0] - before[0]) / 1e6 * before[1] for before, after in pairwise(reported))
    bench.expect(driven_m <= _GUEST_M, f"by one twist it drove {driven_m:.2f} m, and is at {robot.status().applied}")


@SUITE.must("R-DIAL-08", "4.6 Guests", _driving_guest)
def guests_have_no_frame_age(bench: Bench, guest: _Guest) -> None:
    """While a guest without header drives, `status` has no `frame_age_us`."""
    age_us = guest.watcher.robot.next_status().frame_age_us
    bench.expect(age_us is None, f"frame_age_us is {age_us}")


@SUITE.must("R-DIAL-06", "4.6 Guests", _guest)
def guests_are_one(bench: Bench, watcher: Sender) -> None:
    """All who send without a header are one driver, `guest` of session 00000000."""
    _bare(bench)
    reported = watcher.robot.reaches(lambda status: status.holder is not None, 500_000)
    bench.need(reported, "`status` names no holder (R-LEASE-01)")
    holder = watcher.robot.status().holder
    bench.expect(holder == LeaseHolder.of("guest", "00000000"), f"holder is {holder}")


# --- roles and keys --------------------------------------------------------------------------------------------------


def _dropped(sender: Sender, *keys: str) -> None:
    bench = sender.bench
    for key in (one.format(robot=bench.robot) for one in keys):
        frame = sender.robot.frame()
        sender.seq += 1
        header = as_json(sender.header(frame))
        result = sender.result_of(lambda key=key, header=header: bench.put(key, header, CRAWL))  # type: ignore[misc]
        bench.expect(result != GOOD, f"a twist under {key} was accepted")


def _oversize(sender: Sender, extra: bytes, text: bytes) -> None:
    bench, frame = sender.bench, sender.robot.frame()
    sender.seq += 1
    header = b"{" + extra + as_json(sender.header(frame))[1:]
    result = sender.result_of(lambda: bench.put(key_for(bench.robot, TWIST, sender.source), header, text))
    bench.expect(GOOD not in result, "it was accepted")
    sender.expect(GOOD, what="after it an ordinary twist")


# --- invalid messages and floods -----------------------------------------------------------------------------------


def _survives(sender: Sender, *messages: tuple[bytes, bytes]) -> None:
    """Check that the robot still publishes and validates after each (header, payload) as a twist and as a request."""
    bench = sender.bench
    for header, payload in messages:
        for channel in (TWIST, REQUEST):
            bench.publish(channel, header, payload, sender.source)
            bench.rest(30_000)
    mark = bench.mark()
    bench.expect_within(lambda: len(bench.received(STATUS, mark)) >= 3, 1_500_000, "after it the robot is silent")
    bench.rest(sender.robot.link_us())
    sender.expect(GOOD, what="after it an ordinary twist")


SUITE.must_all(watcher, {
    "R-HOST-01": ("5.1 Order", "A twist of a role that may not drive is rejected as UNKNOWN_SOURCE.",
                  lambda it: it.expect("UNKNOWN_SOURCE")),
})
SUITE.must_all(ready, {
    "R-HOST-02": ("1.3 Keys", "A twist under a wildcard key is dropped.",
                  lambda it: _dropped(it, "sightline/{robot}/twist/*", "sightline/**")),
    "R-HOST-03": ("1.3 Keys", "A twist for another robot, or under a key with more parts, is dropped.",
                  lambda it: _dropped(it, "sightline/other/twist/vision", "sightline/{robot}/twist/vision/more")),
    "R-HOST-04": ("1.4 Sizes", "A twist of more than 64 bytes is not applied, though its number is one.",
                  lambda it: _oversize(it, b"", b"0.1" + b"0" * 80 + b"|0")),
    "R-HOST-05": ("1.4 Sizes", "A header of more than 512 bytes is not applied, though all its fields are right.",
                  lambda it: _oversize(it, b'"note":"' + b"x" * 600 + b'",', CRAWL)),
    "R-HOST-06": ("13.2 Bounds", "Bytes that are not protocol at all end nothing.",
                  lambda it: _survives(it, (bytes(range(200, 256)), bytes(range(60))), (b"\0" * 40, b"\xff" * 60),
                                       (b"{", b"{"), (b'"', b"|"))),
    "R-HOST-07": ("13.2 Bounds", "A header nested as deep as its size allows ends nothing.",
                  lambda it: _survives(it, (b"[" * 512, b"1|1"), (b'{"a":' * 90 + b"1" + b"}" * 30, b"1|1"))),
    "R-HOST-08": ("2.3 Text", "Text that is not Unicode ends nothing.",
                  lambda it: _survives(it, (b'{"v":1,"source":"\\ud800"}', b"1|1"),
                                       (b'{"session":"\\udfff\\u0000"}', b'{"verb":"\\ud800"}'))),
})


@SUITE.must("R-HOST-09", "13.2 Bounds", armed)
def flood(bench: Bench, driver: Sender) -> None:
    """A flood of 500 rejected twists a second keeps neither status nor the driver back."""
    cited = driver.robot.frame()
    before, mark, sent = driver.robot.next_status(), bench.mark(), driver.seq
    hostile = Sender(driver.robot, acks=False)
    for number in range(750):
        bench.after(number * 2_000, lambda: hostile.twist(cited, b"9|9|9"))
    bench.rest(1_500_000)
    came = len(bench.received(STATUS, mark))
    bench.expect(came >= 8, f"{came} status in 1.5 s")
    accepted, wanted = driver.robot.next_status().accepted - before.accepted, driver.seq - sent
    bench.expect(accepted >= 0.7 * wanted, f"{accepted} of the driver's {wanted} twists were accepted")


@SUITE.must("R-HOST-10", "13.2 Bounds", Robot)
def many_peers(bench: Bench, robot: Robot) -> None:
    """A hundred sessions that send twists leave the lease where it was."""
    driver, second = Sender(robot), Sender(robot)
    driver.need_good()
    bench.need(second.twist_result() == "NOT_HOLDER", "a second driver is not rejected (R-LEASE-02)")
    driver.drive()
    for number in range(100):
        frame = robot.frame()
        driver.bench.publish(
            TWIST, as_json({**driver.header(frame), "session": f"{number:08x}"}), CRAWL, driver.source
        )
    driver.drive(None)
    robot.next_status(2)
    second.expect("NOT_HOLDER", what="then the twist of a second driver")


# --- connecting and disconnecting ----------------------------------------------------------------------------------


def _away(bench: Bench, for_us: int) -> None:
    bench.leave()
    bench.rest(for_us)
    bench.join()


@SUITE.must("R-RECO-01", "1.2 Messages", vision)
def serves_again(bench: Bench, sender: Sender) -> None:
    """A client that connects again gets status and frames again."""
    sender.robot.frame()
    _away(bench, 500_000)
    mark = bench.mark()
    bench.expect_within(lambda: bench.received(STATUS, mark), 5_000_000, "no status after a reconnect")
    bench.expect_within(lambda: bench.received(FRAME, mark), 5_000_000, "no frame after a reconnect")


@SUITE.must("R-RECO-02", "2.5 Session and sequence", vision)
def session_goes_on(bench: Bench, sender: Sender) -> None:
    """Over a reconnect of the peer the robot's session is the same and its `seq` goes on."""
    sender.robot.frame()
    before = sender.robot.stamp()
    _away(bench, 500_000)
    mark = bench.mark()
    bench.need(bench.wait(lambda: bench.received(STATUS, mark), 5_000_000), "no status again (R-RECO-01)")
    after = bench.received(STATUS, mark)[0].header(Stamp)
    bench.need(after, "a status that cannot be read (R-FRAM-09)")
    assert after is not None
    bench.expect(after.session == before.session, f"session {after.session}, before {before.session}")
    bench.expect(after.seq > before.seq, f"seq {after.seq}, before {before.seq}")


@SUITE.must("R-RECO-03", "5.4 Silence", armed)
def stays_still(bench: Bench, driver: Sender) -> None:
    """A driver that is cut off stops the robot, and its coming back moves nothing until it sends again."""
    driver.fall_silent()
    _away(bench, 1_500_000)
    mark = bench.mark()
    bench.need(bench.wait(lambda: bench.received(STATUS, mark), 5_000_000), "no status again (R-RECO-01)")
    back_us = driver.robot.clock_us()
    moving = driver.robot.reaches(lambda status: status.applied != (0.0, 0.0), 700_000)
    bench.expect(not moving, f"it moves: {driver.robot.status().applied}, {driver.robot.status().state}")
    driver.robot.expect_unmoved("after a driver was cut off", back_us)


@SUITE.must("R-RECO-04", "6.1 Lease", ready)
def lease_is_not_the_connection(bench: Bench, sender: Sender) -> None:
    """The lease is not the connection: within its second it holds though the driver was cut off."""
    second = Sender(sender.robot)
    bench.need(second.twist_result() == "NOT_HOLDER", "a second driver is not rejected (R-LEASE-02)")
    began_us = bench.now_us
    sender.need_good()
    _away(bench, 100_000)
    result = second.twist_result()
    in_time = result != GOOD or bench.now_us - began_us < _HELD_US
    bench.need(in_time, "the lease had ended when the kit was connected again; its link is too slow")
    bench.expect(result == "NOT_HOLDER", f"then a twist of another: {result}")
