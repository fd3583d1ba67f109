"""Which robots one service takes and leaves: each rule and each bound of `Sharing`, without other services."""

import pytest

from sightline.protocol.errors import RejectReason
from sightline.protocol.messages import LeaseHolder, State, Status, StreamStatus
from sightline.protocol.transports.tokens import DriverToken, RobotToken, VisionToken
from sightline.vision_side.serving.assignment import assign, ranked
from sightline.vision_side.serving.sharing import Sharing, SharingPart

NONE, STANDBY, CLAIM, DRIVE = SharingPart
MS = 1_000
OWN = VisionToken("a", 1.0, "0000000a")
OTHERS = [VisionToken(name, 1.0, f"0000000{name}") for name in "bcde"]
HUMAN = LeaseHolder(source="teleop", digest="11111111")
VISION = LeaseHolder(source="vision", digest="11111111")


def driver(robot, number=1, name="b"):
    return DriverToken(robot, name, f"{number:032x}")


def robot_whose(*order):
    """Return a robot whose first choices are these services, of `a` to `e`."""
    weights = dict.fromkeys("abcde", 1.0)
    return next(name for name in (f"r{number}" for number in range(2_000))
                if [*ranked(name, weights)][: len(order)] == list(order)
                and assign([name], weights)[name] == tuple(ranked(name, weights)[:2]))


def service(robot, *drivers, at_us=0, others=OTHERS):
    """Return service `a` with others, a robot and its drivers of before, after its first decision."""
    sharing = Sharing(OWN)
    for token in (*others, RobotToken(robot), *drivers):
        sharing.on_token(token, True, at_us - 1_200 * MS * (token in drivers))
    sharing.step(at_us)
    return sharing


def part(sharing):
    (robot,) = sharing.robots.values()
    return robot.part


def see(sharing, at_us, commands=0, *, mine=False, state=State.ACTIVE, holder=None, accepted=0, refused=None, **stream):
    """Pass a status after `commands` of this session; return whether that needs a new one."""
    status = Status(state=state, reason="", holder=holder, accepted=accepted, refused=refused or {},
                    stream=StreamStatus(**stream))
    (robot,) = sharing.robots
    sharing.on_status(robot, status, is_mine=mine, sent=commands, now_us=at_us)
    return sharing.needs_session(robot, at_us)


# --- the own link ----------------------------------------------------------------------------------------------------


def test_nothing_changes_while_the_own_link_is_down_and_what_does_not_return_in_time_has_ended():
    mine, driven, gone = robot_whose("a", "b"), robot_whose("b", "a"), robot_whose("c", "a")
    sharing = service(mine, driver(driven))
    for token in (RobotToken(driven), RobotToken(gone)):
        sharing.on_token(token, True, 0)
    sharing.step(0)
    before = {robot: one.part for robot, one in sharing.robots.items()}
    assert before == {mine: DRIVE, driven: STANDBY, gone: STANDBY}
    sharing.on_link(False, 10 * MS)
    for token in (*OTHERS, driver(driven), *map(RobotToken, before)):
        sharing.on_token(token, False, 10 * MS)
    assert sharing.step(9_000 * MS) == {}
    sharing.on_link(True, 10_000 * MS)
    for token in (*OTHERS[:3], RobotToken(mine), RobotToken(driven)):
        sharing.on_token(token, True, 10_100 * MS)
    assert sharing.step(10_300 * MS - 1) == {} and len(sharing.services()) == 5
    assert len(sharing.robots[driven].drivers) == 1
    sharing.step(10_300 * MS)
    assert set(sharing.services()) == set("abcd") and not sharing.robots[driven].drivers
    assert sharing.robots[mine].part is DRIVE and gone in sharing.robots
    sharing.step(12_000 * MS - 1)
    assert gone in sharing.robots
    sharing.step(12_000 * MS)
    assert set(sharing.robots) == {mine, driven}
    sharing.on_token(OTHERS[0], False, 13_000 * MS)
    assert set(sharing.services()) == set("acd"), "an end counts at once again"


def test_token_that_appears_while_the_own_link_counts_as_down_is_there():
    sharing = service("r1")
    sharing.on_link(False, 0)
    sharing.on_token(RobotToken("r2"), True, 0)
    sharing.on_link(True, 0)
    sharing.step(9_000 * MS)
    assert set(sharing.robots) == {"r1", "r2"}


def test_time_without_a_driver_counts_from_the_return_of_the_own_link():
    sharing = service(robot_whose("b", "a"))
    sharing.on_link(False, 100 * MS)
    sharing.on_link(True, 5_000 * MS)
    assert sharing.step(6_500 * MS - 1) == {} != sharing.step(6_500 * MS)


@pytest.mark.parametrize(("seen_ms", "after_ms"), [(100, 480), (400, 780)])
def test_standby_gives_a_driver_time_after_the_own_link_returned(seen_ms, after_ms):
    """The robot may return later than this service, and shows an older silence."""
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for ms in range(0, 400, 100):
        see(sharing, ms * MS, accepted=ms, sent=ms)
    sharing.on_link(False, 500 * MS)
    sharing.on_link(True, 3_000 * MS)
    for ms in range(seen_ms, 3_000, 10):
        see(sharing, (3_000 + ms) * MS, accepted=300, sent=300 + (ms > seen_ms))
        sharing.step((3_000 + ms) * MS)
        if part(sharing) is not STANDBY:
            break
    assert ms == pytest.approx(after_ms, abs=20)


def test_driver_is_not_without_the_lease_while_the_own_link_is_down():
    robot = robot_whose("a", "b")
    sharing = service(robot)
    see(sharing, 0, commands=5, mine=True, holder=VISION)
    sharing.on_link(False, 100 * MS)
    sharing.on_link(True, 3_000 * MS)
    assert not see(sharing, 3_100 * MS, commands=0)
    assert not see(sharing, 3_200 * MS, commands=2)
    assert not see(sharing, 3_300 * MS, commands=3)
    assert not see(sharing, 3_399 * MS, commands=4)
    assert see(sharing, 3_400 * MS, commands=5)


# --- claims -----------------------------------------------------------------------------------------------------------


def test_an_owner_claims_at_once_and_drives_when_the_former_driver_leaves():
    robot = robot_whose("a", "b")
    sharing = service(robot, driver(robot))
    assert part(sharing) is CLAIM
    assert sharing.step(10) == {}
    sharing.on_token(driver(robot), False, 20)
    assert sharing.step(20) == {robot: DRIVE}


def test_an_owner_is_about_to_drive_in_the_first_second_of_its_claim():
    robot = robot_whose("a", "b")
    assert not service(robot_whose("b", "a")).is_about_to_drive(robot_whose("b", "a"), 0), "a standby"
    sharing = service(robot, driver(robot), at_us=5_000)
    assert not sharing.is_about_to_drive("unknown", 5_000)
    assert [sharing.is_about_to_drive(robot, 5_000 + us) for us in (0, 1_000 * MS - 1, 1_000 * MS)] == [
        True, True, False]
    sharing.on_token(driver(robot), False, 6_000)
    sharing.step(6_000)
    assert not sharing.is_about_to_drive(robot, 6_000), "it drives"


def test_an_owner_of_a_robot_without_driver_drives_in_one_step():
    sharing = Sharing(OWN)
    sharing.on_token(RobotToken("r1"), True, 0)
    assert sharing.step(0) == {"r1": DRIVE} and sharing.step(1) == {}


@pytest.mark.parametrize("later_ms", [-1, 0, 20, 290])
def test_a_service_that_starts_claims_from_a_driver_1_2_s_after_its_token(later_ms):
    """The token of a driver may come before or after that of the robot."""
    sharing, claims_us = Sharing(OWN), (5_001 + max(0, later_ms) + 1_200) * MS
    sharing.on_link(True, 5_000 * MS)
    tokens = [(5_001, RobotToken("r1")), (5_001 + later_ms, driver("r1"))]
    for ms, token in sorted(tokens):
        sharing.on_token(token, True, ms * MS)
    assert sharing.step(5_001 * MS) == {"r1": STANDBY}
    sharing.on_token(driver("r1"), True, 6_000 * MS)  # it is known
    assert sharing.step(claims_us - 1) == {}
    assert sharing.step(claims_us) == {"r1": CLAIM}


def test_a_service_that_starts_drives_a_robot_without_a_driver_after_the_time_in_which_tokens_come():
    sharing = Sharing(OWN)
    sharing.on_link(True, 5_000 * MS)
    sharing.on_token(RobotToken("r1"), True, 5_001 * MS)
    assert sharing.step(5_001 * MS) == {"r1": STANDBY}
    assert sharing.step(5_300 * MS - 1) == {}
    assert sharing.step(5_300 * MS) == {"r1": DRIVE}


@pytest.mark.parametrize("is_beside", [False, True])
def test_an_owner_without_the_lease_leaves_the_robot_to_a_driver_that_keeps_it(is_beside):
    """A driver with a mission stays, and two that answer share the credit of the robot."""
    robot = robot_whose("a", "b")
    sharing, parts = service(robot), []
    sharing.on_token(driver(robot), is_beside, 10 * MS)
    for ms in range(0, 30_000, 100):
        see(sharing, ms * MS, ms * (part(sharing) is DRIVE), accepted=ms)
        sharing.step(ms * MS)
        parts.append(part(sharing))
    assert parts[:3] == [DRIVE] * 3
    # It claims the robot again, and waits.
    assert parts[3:] == ([STANDBY] * 10 + [CLAIM] * 287 if is_beside else [DRIVE] * 297)
    assert sharing.robots[robot].tries == (2 if is_beside else 9)
    sharing.on_token(driver(robot), False, 30_000 * MS)
    sharing.step(30_000 * MS)
    assert part(sharing) is DRIVE, "at once"


def test_an_owner_that_had_the_lease_stays_beside_another_driver_and_gives_up_only_after_its_next_begin():
    robot = robot_whose("a", "b")
    sharing, parts = service(robot), []
    see(sharing, 100 * MS, 1, mine=True)
    sharing.on_token(driver(robot), True, 110 * MS)
    for ms in range(200, 3_000, 100):
        see(sharing, ms * MS, ms // 30, accepted=ms)
        sharing.step(ms * MS)
        parts.append(part(sharing))
    assert set(parts) == {DRIVE}
    sharing.robots[robot].is_busy = True  # a mission ends here, so that another one may drive
    sharing.step(3_000 * MS)
    assert part(sharing) is STANDBY
    sharing.on_token(driver(robot), False, 9_000 * MS)
    sharing.robots[robot].is_busy = False
    sharing.step(9_000 * MS)
    assert part(sharing) is DRIVE
    sharing.on_token(driver(robot, 2), True, 9_010 * MS)
    for ms in range(9_100, 9_500, 100):
        see(sharing, ms * MS, ms // 30, accepted=ms)
        sharing.step(ms * MS)
    assert part(sharing) is STANDBY


@pytest.mark.parametrize(("at_us", "waits"), [(2_299_999, True), (2_300_000, False)])
def test_time_without_frames_ends_after_2_3_s(at_us, waits):
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for us in (0, at_us):
        see(sharing, us, sent=1)
    assert (sharing.robots[robot].active_us == at_us) is waits


def test_one_frame_without_an_answer_does_not_show_a_driver_at_work():
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for ms in (0, 100):
        see(sharing, ms * MS, sent=1 + ms // 100, credit_timeouts=ms // 100)
    assert sharing.robots[robot].active_us == 0


@pytest.mark.parametrize(("order", "after_ms"), [("ba", 1_500), ("bca", 2_000), ("bcda", 2_500), ("bcdea", 2_500)])
@pytest.mark.parametrize("begin_ms", [0, 7_000])
def test_choice_claims_a_robot_without_a_driver_after_its_turn(order, after_ms, begin_ms):
    sharing, before = service(robot_whose(*order), at_us=begin_ms * MS), STANDBY if len(order) < 4 else NONE
    for us in (*range(0, after_ms * MS, 50 * MS), after_ms * MS - 1):
        sharing.step(begin_ms * MS + us)
        assert part(sharing) is before
    sharing.step((begin_ms + after_ms) * MS)
    assert part(sharing) is DRIVE


@pytest.mark.parametrize("order", ["ba", "bca"])
def test_choice_waits_while_a_driver_is_there_and_its_turn_counts_from_the_end_of_the_last(order):
    robot = robot_whose(*order)
    first, second = driver(robot, 1, "e"), driver(robot, 2, "e")
    sharing = service(robot, first, second)
    assert sharing.step(5_000 * MS) == {}
    sharing.on_token(first, False, 6_000 * MS)
    assert sharing.step(9_000 * MS) == {}
    sharing.on_token(second, False, 9_000 * MS)
    after_ms = 1_500 if order == "ba" else 2_000
    assert sharing.step((9_000 + after_ms) * MS - 1) == {}
    assert sharing.step((9_000 + after_ms) * MS) == {robot: DRIVE}


def test_a_later_choice_takes_no_part_before_it_claims():
    robot = robot_whose("b", "c", "d", "a")
    sharing = service(robot, driver(robot, 1, "e"))
    assert part(sharing) is NONE
    see(sharing, 2_000 * MS)
    see(sharing, 4_900 * MS)
    assert sharing.step(4_900 * MS) == {}, "only a standby may succeed a silent driver"
    sharing.on_token(OTHERS[1], False, 4_900 * MS)
    assert sharing.step(4_900 * MS) == {robot: STANDBY}, "and what it saw before does not count"


# --- a silent driver --------------------------------------------------------------------------------------------------


def silent_after_ms(changed):
    """Pass `changed(ms)` to a standby after the statuses of a driver at work; return when it drives, None if never.

    The robot sends one more frame, which has no answer.
    """
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    see(sharing, 1_600 * MS, sent=4, accepted=4)
    see(sharing, 1_700 * MS, sent=5, accepted=5)
    for ms in range(10, 2_000, 10):
        see(sharing, (1_700 + ms) * MS, **{"sent": 6, "credit_timeouts": 1, "accepted": 5, **changed(ms)})
        if sharing.step((1_700 + ms) * MS):
            return ms
    return None


def test_standby_drives_380_ms_after_the_last_sign_of_the_driver():
    assert silent_after_ms(lambda ms: {}) == 380
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    see(sharing, 2_000 * MS, accepted=5)
    for us in (2_130 * MS, 2_260 * MS, 2_380 * MS - 1):
        see(sharing, us, accepted=5, sent=1)
    assert sharing.step(3_000 * MS) == {}, "the newest status decides, not the clock"
    see(sharing, 2_380 * MS, accepted=5, sent=1)
    assert sharing.step(3_000 * MS) == {robot: DRIVE}


@pytest.mark.parametrize("accepted", [0, 1, 2])
def test_first_status_shows_a_driver_at_work(accepted):
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    see(sharing, 2_000 * MS, accepted=accepted)
    assert sharing.step(2_000 * MS) == {}


@pytest.mark.parametrize(("frames", "succeeds"), [(1, True), (2, False)])
def test_first_answers_count_above_the_frame_that_may_be_on_its_way(frames, succeeds):
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for ms, sent in ((2_000, 0), (2_130, 1), (2_260, 1), (2_380, frames)):
        see(sharing, ms * MS, sent=sent)
    assert bool(sharing.step(2_380 * MS)) is succeeds


@pytest.mark.parametrize("changed", [
    lambda ms: {"accepted": 5 + ms},
    lambda ms: {"refused": {"STALE": ms}},
    lambda ms: {"refused": {"STALE": ms, "NOT_HOLDER": 9}},
    lambda ms: {"accepted": 5 + ms, "refused": {"STALE": ms}},
    lambda ms: {"holder": HUMAN},
    lambda ms: {"state": State.STOPPED},
    lambda ms: {"state": State.FAULT},
    lambda ms: {"camera_fault": "unplugged"},
    lambda ms: {"sent": 5 + ms},
    lambda ms: {"sent": 5 + ms, "window": 3},
], ids=["accepted", "rejected", "rejected beside others", "some of each", "human", "stopped", "fault", "camera",
        "answered", "window"])
def test_standby_leaves_a_driver_that_works_or_may_not(changed):
    assert silent_after_ms(changed) is None


@pytest.mark.parametrize("changed", [
    lambda ms: {"refused": {"NOT_HOLDER": ms}},
    lambda ms: {"holder": VISION},
    lambda ms: {"state": State.HOLD},
    lambda ms: {"sent": 5 + ms, "credit_timeouts": ms},
    lambda ms: {"sent": 6 if ms < 100 else 7, "window": 3},
], ids=["commands of others", "held by vision", "hold", "no answers", "frames on their way"])
def test_standby_succeeds_a_driver_without_a_sign_of_work(changed):
    assert silent_after_ms(changed) == 380


def test_answers_count_above_the_frames_that_may_be_on_their_way():
    # Four are answered before, and three may be on their way.
    assert silent_after_ms(lambda ms: {"sent": 7, "window": 3}) == 380
    for before in (1, 2):  # answers that never came; the last one was due at 110 ms
        assert silent_after_ms(lambda ms, before=before: {
            "sent": 7 + before + (ms >= 100) + (ms >= 110), "credit_timeouts": before + (ms >= 110), "window": 3,
        }) == 480


@pytest.mark.parametrize("begin_ms", [0, 7_000])
def test_a_driver_of_a_robot_that_sends_no_frame_is_silent_after_its_first_2_3_s(begin_ms):
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot), at_us=begin_ms * MS)
    drives = []
    for ms in range(0, 5_000, 10):
        see(sharing, (begin_ms + ms) * MS, sent=7)
        drives += [ms] if sharing.step((begin_ms + ms) * MS) else []
    assert drives == [2_300 + 370], "the last status in which it waited came at 2,290 ms"


def test_what_was_seen_of_a_robot_before_a_part_ended_does_not_count():
    robot = robot_whose("b", "c", "d", "a")
    sharing = service(robot)
    assert sharing.step(2_500 * MS) == {robot: DRIVE}
    see(sharing, 2_500 * MS, sent=1, accepted=1)
    see(sharing, 2_550 * MS, sent=2, accepted=1)
    sharing.on_token(driver(robot, 1, "c"), True, 2_600 * MS)
    assert sharing.step(2_600 * MS) == {robot: STANDBY}
    see(sharing, 2_700 * MS, sent=2, accepted=1, holder=VISION)
    assert sharing.step(2_700 * MS) == {robot: NONE}
    see(sharing, 9_000 * MS, sent=2, accepted=1)
    for token in OTHERS[:3]:
        sharing.on_token(token, False, 9_000 * MS)
    assert sharing.step(9_000 * MS) == {robot: CLAIM}
    see(sharing, 9_500 * MS, sent=2, accepted=1)
    assert sharing.step(9_500 * MS) == {}, "the other driver may wait for its first frame"
    for ms in range(9_600, 12_100, 100):
        see(sharing, ms * MS, sent=2, accepted=1)
        assert sharing.step(ms * MS) == {}
    see(sharing, 12_100 * MS, sent=2, accepted=1)
    assert sharing.step(12_100 * MS) == {robot: DRIVE}


def test_silence_from_the_time_as_driver_does_not_count_for_a_standby():
    robot = robot_whose("b", "a")
    sharing = service(robot)
    sharing.step(1_500 * MS)
    for count, ms in enumerate(range(3_000, 3_600, 100)):
        see(sharing, ms * MS, sent=1 + count, credit_timeouts=count, accepted=1)
    sharing.on_token(driver(robot), True, 3_600 * MS)
    assert sharing.step(3_600 * MS) == {robot: STANDBY}
    see(sharing, 3_650 * MS, sent=7, credit_timeouts=6, accepted=1)
    assert sharing.step(3_650 * MS) == {}


def test_first_frame_ends_the_wait_for_it():
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    drives = []
    for ms in range(0, 4_000, 10):
        see(sharing, ms * MS, sent=7 + (ms >= 500))
        drives += [ms] if sharing.step(ms * MS) else []
    assert drives == [500 - 10 + 380]


@pytest.mark.parametrize(("pause_ms", "drives"), [(500, []), (1_900, []), (2_400, []), (3_000, [2_290 + 380])])
@pytest.mark.parametrize("unanswered", [0, 1])
def test_a_driver_without_frames_to_answer_is_not_silent(pause_ms, drives, unanswered):
    """A camera may pause, e.g. for its exposure, and a robot may send a frame every half second."""
    robot = robot_whose("b", "a")
    sharing, found = service(robot, driver(robot)), []
    for ms in range(0, 2_000, 50):
        see(sharing, ms * MS, sent=ms // 50 + unanswered, accepted=ms // 50)
    for ms in range(1_960, 1_960 + pause_ms, 10):
        see(sharing, ms * MS, sent=39 + unanswered, accepted=39)
        found += [ms - 1_950] if sharing.step(ms * MS) else []
    assert found == drives


def test_a_driver_that_was_silent_counts_again_with_a_new_token():
    robot = robot_whose("a", "b")
    sharing = service(robot, driver(robot))
    sharing.robots[robot].ignored.add(driver(robot))
    assert sharing.step(1) == {robot: DRIVE}
    sharing.on_token(driver(robot), False, 2)
    sharing.on_token(driver(robot), True, 3)
    assert sharing.robots[robot].others == {driver(robot)}
    sharing.robots[robot].ignored.add(driver(robot))
    sharing.on_token(driver(robot), True, 4)
    assert sharing.robots[robot].others == set(), "only its end makes it new"


# --- leaving ----------------------------------------------------------------------------------------------------------


def test_owner_drives_on_beside_a_worse_choice_and_standby_leaves_for_a_better_one():
    robot = robot_whose("b", "a", "c")
    sharing = service(robot, at_us=0)
    assert sharing.step(1_500 * MS) == {robot: DRIVE}
    sharing.on_token(driver(robot, 1, "c"), True, 1_600 * MS)
    assert sharing.step(1_600 * MS) == {}
    sharing.on_token(driver(robot, 2, "b"), True, 1_700 * MS)
    assert sharing.step(1_700 * MS) == {robot: STANDBY}


def left(*order):
    """Return a service after it left for the driver `b`, at 4 s, and its robot."""
    robot = robot_whose(*order)
    sharing = service(robot)
    assert sharing.step(2_500 * MS) == {robot: DRIVE}
    sharing.on_token(driver(robot), True, 4_000 * MS)
    assert sharing.step(4_000 * MS) == {robot: STANDBY}
    return sharing, robot


@pytest.mark.parametrize(("shown", "works"), [
    ({"holder": VISION, "mine": True}, False), ({"holder": HUMAN}, False), ({"sent": 11, "window": 1}, False),
    ({"accepted": 1}, False), ({"refused": {"STALE": 9}}, False), ({"holder": VISION}, True),
    ({"sent": 12, "window": 1}, True),
], ids=["own lease", "human", "frame on its way", "own command", "rejected", "lease", "answers"])
def test_a_fourth_choice_that_left_stands_by_until_the_other_driver_works(shown, works):
    sharing, robot = left("b", "c", "d", "a")
    see(sharing, 4_010 * MS, sent=10, window=1)
    assert sharing.step(4_010 * MS) == {}, "frames of before are its own"
    see(sharing, 4_100 * MS, **{"sent": 10, **shown})
    assert sharing.step(4_100 * MS) == ({robot: NONE} if works else {})


def test_a_fourth_choice_without_the_lease_stands_by_after_its_claim():
    robot = robot_whose("b", "c", "d", "a")
    sharing = service(robot)
    sharing.step(2_500 * MS)
    sharing.on_token(driver(robot, 2, "e"), True, 2_500 * MS)
    for ms in (2_500, 2_600, 2_700, 2_800):
        see(sharing, ms * MS, ms)
    assert sharing.step(2_800 * MS) == {robot: STANDBY}


@pytest.mark.parametrize(("later_ms", "waits"), [(0, 2), (300, 5)])
def test_a_claim_is_repeated_once_if_a_driver_that_appeared_later_may_ignore_it_as_silent(later_ms, waits):
    robot = robot_whose("a", "b")
    sharing, parts = service(robot, driver(robot), at_us=5_000 * MS), []
    for ms in range(0, 9_000, 100):
        if ms == later_ms:
            sharing.on_token(driver(robot, 2), True, (5_000 + ms) * MS)
        see(sharing, (5_000 + ms) * MS, accepted=ms)
        sharing.step((5_000 + ms) * MS)
        parts.append(part(sharing))
    assert parts == [CLAIM] * 10 + [STANDBY] * waits + [CLAIM] * (80 - waits)


def test_a_service_that_hung_withdraws_its_token_between_two_claims():
    robot = robot_whose("a", "b")
    sharing = service(robot, driver(robot))
    sharing.on_token(driver(robot, 2), True, 10 * MS)
    assert sharing.step(8_000 * MS) == {robot: STANDBY}
    assert sharing.step(8_000 * MS) == {robot: CLAIM}


def test_no_robot_without_a_driver_needs_the_order_of_all_services(monkeypatch):
    """The order takes a millisecond with many services, and a thousand robots may lose their drivers together."""
    computed = []
    monkeypatch.setattr(f"{Sharing.__module__}.ranked", lambda *given: computed.append(given) or ranked(*given))
    for order, after_ms in (("a", 0), ("ba", 1_500), ("bca", 2_000), ("bcda", 2_500), ("bcdea", 2_500)):
        sharing = service(robot_whose(*order))
        sharing.step(after_ms * MS - 1)
        sharing.step(after_ms * MS)
        assert part(sharing) is DRIVE
    mine = Sharing(OWN)
    mine.on_link(True, 9_000 * MS)  # the robot has no driver for long, and this service its first turn
    mine.on_token(RobotToken("r1"), True, 0)
    assert mine.step(9_300 * MS) == {"r1": DRIVE} and not computed


@pytest.mark.parametrize("order", ["bca", "bcda", "bcdea"])
@pytest.mark.parametrize("others", [0, 2])
def test_a_choice_that_left_succeeds_a_claimer_that_is_silent_as_the_standby_does(order, others):
    sharing, robot = left(*order)
    for number in range(others):
        sharing.on_token(driver(robot, 7 + number, "e"), True, 4_010 * MS)
    drives = []
    for ms in range(4_010, 4_600, 10):
        see(sharing, ms * MS, sent=10 + (ms > 4_020))
        drives += [ms - 4_020] if sharing.step(ms * MS) else []
    assert drives == [380] and part(sharing) is DRIVE


@pytest.mark.parametrize(("driver_ms", "after_ms"), [(-9_000, 1_380), (200, 1_380), (380, 1_380), (500, 1_500)])
def test_second_standby_drives_after_1_s_by_the_newest_status(driver_ms, after_ms):
    robot = robot_whose("b", "c", "a")
    sharing = service(robot, driver(robot), at_us=9_000 * MS)
    for us in (9_900 * MS, 10_000 * MS):
        see(sharing, us, sent=5, accepted=us // MS)
    sharing.robots[robot].driver_us = (10_000 + driver_ms) * MS
    for us in (*range(10_100 * MS, (10_000 + after_ms) * MS, 100 * MS), (10_000 + after_ms) * MS - 1):
        see(sharing, us, sent=6, accepted=10_000)
        assert sharing.step(us) == {}
    see(sharing, (10_000 + after_ms) * MS, sent=6, accepted=10_000)
    assert sharing.step((10_000 + after_ms) * MS) == {robot: DRIVE}


@pytest.mark.parametrize(("driver_ms", "after_ms"), [(-9_000, 1_380), (200, 1_380), (380, 1_380), (500, 1_500)])
def test_second_standby_drives_1_s_after_the_silence_or_a_new_driver(driver_ms, after_ms):
    robot = robot_whose("b", "c", "a")
    sharing, drives = service(robot, driver(robot), at_us=9_000 * MS), []
    see(sharing, 9_990 * MS, sent=5, accepted=4)
    see(sharing, 10_000 * MS, sent=5, accepted=5)
    for ms in range(10, 2_000, 10):
        if ms == max(10, driver_ms):
            sharing.on_token(driver(robot, 2, "c"), True, (10_000 + driver_ms) * MS)
        see(sharing, (10_000 + ms) * MS, sent=6, accepted=5)
        drives += [ms] if sharing.step((10_000 + ms) * MS) else []
    assert drives == [after_ms] and part(sharing) is DRIVE


def test_a_claim_is_withdrawn_for_a_better_one():
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot, 1, "d"))
    sharing.on_token(OTHERS[0], False, 10)
    assert sharing.step(10) == {robot: CLAIM}
    sharing.on_token(OTHERS[0], True, 20)
    sharing.on_token(driver(robot, 2, "b"), True, 20)
    assert sharing.step(20) == {robot: STANDBY}


def test_a_claim_holds_beside_a_better_choice_that_was_silent():
    robot = robot_whose("b", "a", "d")
    sharing = service(robot, driver(robot), driver(robot, 1, "d"), others=OTHERS[1:])
    sharing.robots[robot].ignored.add(driver(robot))
    assert part(sharing) is CLAIM
    sharing.on_token(OTHERS[0], True, 900 * MS)
    assert sharing.step(900 * MS) == {}


def test_a_service_claims_a_robot_that_has_a_driver_at_most_once_a_second():
    robot = robot_whose("b", "a")
    sharing = service(robot, others=OTHERS[1:])
    assert part(sharing) is DRIVE
    sharing.on_token(OTHERS[0], True, 100 * MS)
    sharing.on_token(driver(robot), True, 100 * MS)
    assert sharing.step(100 * MS) == {robot: STANDBY}
    sharing.on_token(OTHERS[0], False, 200 * MS)
    sharing.robots[robot].driver_us = -1_200 * MS
    assert sharing.step(1_000 * MS - 1) == {}
    assert sharing.step(1_000 * MS) == {robot: CLAIM}


def test_a_robot_without_a_driver_waits_for_no_limit():
    robot = robot_whose("b", "a")
    sharing = service(robot, others=OTHERS[1:])
    sharing.on_token(OTHERS[0], True, 100 * MS)
    sharing.on_token(driver(robot), True, 100 * MS)
    assert sharing.step(100 * MS) == {robot: STANDBY}
    sharing.on_token(OTHERS[0], False, 200 * MS)
    sharing.on_token(driver(robot), False, 200 * MS)
    assert sharing.step(200 * MS) == {robot: DRIVE}


def test_a_mission_keeps_its_robot_while_the_lease_is_here():
    robot = robot_whose("b", "a")
    sharing = service(robot)
    sharing.step(1_500 * MS)
    sharing.robots[robot].is_busy = True
    sharing.on_token(driver(robot), True, 1_600 * MS)
    for commands, ms in enumerate((1_600, 1_700, 1_799), 1):
        see(sharing, ms * MS, commands)
        assert sharing.step(ms * MS) == {}
    see(sharing, 1_800 * MS, 4)
    assert sharing.step(1_800 * MS) == {robot: STANDBY}, "300 ms without the lease"


def test_a_silent_driver_counts_again_when_it_has_the_lease():
    robot = robot_whose("b", "a")
    sharing = service(robot)
    sharing.step(1_500 * MS)
    token = driver(robot)
    sharing.on_token(token, True, 1_500 * MS)
    sharing.robots[robot].ignored.add(token)
    for commands, us in enumerate((1_600 * MS, 1_700 * MS, 1_800 * MS - 1), 1):
        see(sharing, us, commands)
        assert sharing.step(us) == {}
    see(sharing, 1_800 * MS, 4)
    assert sharing.step(1_800 * MS) == {robot: STANDBY}


@pytest.mark.parametrize("gap_ms", [200, 500, 3_000])
def test_time_without_statuses_shows_no_silence_of_a_driver(gap_ms):
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for ms in (1_900, 2_000, 2_000 + gap_ms, 2_100 + gap_ms, 2_200 + gap_ms):
        see(sharing, ms * MS, accepted=5 + (ms >= 2_000), sent=int(ms > 2_000))
        assert sharing.step(ms * MS) == {}
    see(sharing, (2_230 + gap_ms) * MS - 1, accepted=6, sent=1)
    assert sharing.step((2_230 + gap_ms) * MS - 1) == {}
    see(sharing, (2_230 + gap_ms) * MS, accepted=6, sent=1)
    assert sharing.step((2_230 + gap_ms) * MS) == {robot: DRIVE}, "150 ms of the gap count"


@pytest.mark.parametrize("reason", RejectReason)
def test_rejections_that_drivers_alone_cause_show_one_at_work(reason):
    works = reason in ("STALE", "OUT_OF_ORDER", "OTHER_SESSION", "UNKNOWN_FRAME", "FROM_FUTURE", "DISARMED")
    assert silent_after_ms(lambda ms: {"refused": {reason: ms}}) == (None if works else 380)


def test_answers_are_more_than_the_frame_on_its_way_from_the_first_status_on():
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for sent, ms in ((2, 2_000), (3, 2_100), (3, 2_200), (3, 2_300)):
        see(sharing, ms * MS, sent=sent)
    see(sharing, 2_380 * MS, sent=3)
    assert sharing.step(2_380 * MS) == {robot: DRIVE}


def test_commands_of_a_new_session_count_from_zero():
    sharing = driven()
    see(sharing, 1_000 * MS, 500, mine=True)
    for commands, ms in ((501, 1_100), (502, 1_200)):
        assert not see(sharing, ms * MS, commands)
    assert see(sharing, 1_300 * MS, 503)
    for ms in range(1_400, 3_300, 100):
        assert not see(sharing, ms * MS, 47, holder=HUMAN)
    assert see(sharing, 3_310 * MS, 48, holder=HUMAN)


def test_answers_count_from_zero_after_a_restart_of_the_robot():
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    for number in range(40):
        see(sharing, (2_000 + 100 * number) * MS, sent=3 * (number % 20) + 1)
        assert sharing.step((2_000 + 100 * number) * MS) == {}


@pytest.mark.parametrize("gap_ms", [200, 500, 3_000])
def test_time_without_statuses_does_not_count_as_time_without_the_lease(gap_ms):
    sharing = driven()
    see(sharing, 2_000 * MS, 1, mine=True)
    for commands, us in enumerate((2_000 * MS, 2_100 * MS, 2_150 * MS - 1), 2):
        assert not see(sharing, us + gap_ms * MS, commands)
    assert see(sharing, (2_150 + gap_ms) * MS, 9)


def test_a_service_that_leaves_gives_its_robot_to_the_first_that_claims_it():
    robot = robot_whose("a", "b")
    sharing = service(robot)
    sharing.leave()
    assert sharing.services() == dict.fromkeys("bcde", 1.0)
    assert sharing.step(10) == {}, "it drives until another one claims"
    sharing.on_token(driver(robot, 1, "d"), True, 20)
    assert sharing.step(20) == {robot: NONE}
    sharing.on_token(driver(robot, 1, "d"), False, 30)
    assert sharing.step(9_000 * MS) == {}, "and claims nothing"


def test_of_two_services_with_one_name_the_lower_instance_counts():
    robot = robot_whose("a", "b")
    for instance, is_twin in (("00000009", True), ("0000000b", False)):
        sharing = Sharing(VisionToken("a", 2.0, "0000000a"))
        sharing.on_token(VisionToken("a", 3.0, instance), True, 0)
        sharing.on_token(RobotToken(robot), True, 0)
        assert sharing.has_twin is is_twin
        assert sharing.services() == {"a": 3.0 if is_twin else 2.0}
        assert sharing.step(0) == ({} if is_twin else {robot: DRIVE})
    sharing = Sharing(OWN)
    sharing.on_token(VisionToken("b", 1.0, "00000001"), True, 0)
    sharing.on_token(OWN._replace(weight=9.0), True, 0)
    assert not sharing.has_twin


@pytest.mark.parametrize(("twins", "after_ms"), [(1, 1_500), (2, 2_000), (9, 2_500)])
def test_a_twin_claims_a_robot_without_a_driver_after_its_namesake_and_leaves_it_to_that(twins, after_ms):
    robot = robot_whose("a", "b")
    sharing = service(robot, others=[*OTHERS, *(OWN._replace(instance=f"0000000{number}") for number in range(twins))])
    for us in (0, after_ms * MS - 1):
        assert sharing.step(us) == {} and part(sharing) is NONE
    assert sharing.step(after_ms * MS) == {robot: DRIVE}
    sharing.on_token(driver(robot, 1, "b"), True, 3_600 * MS)
    assert sharing.step(3_600 * MS) == {}
    sharing.on_token(driver(robot, 2, "a"), True, 3_700 * MS)
    assert sharing.step(3_700 * MS) == {robot: STANDBY}


def test_a_service_that_ends_leaves_its_robots():
    robot = robot_whose("b", "a")
    sharing = service(robot)
    sharing.on_token(OTHERS[0], False, 5)
    assert sharing.services() == dict.fromkeys("acde", 1.0)
    assert sharing.step(5) == {robot: DRIVE}


# --- robots -----------------------------------------------------------------------------------------------------------


def test_robots_join_once_and_leave_with_what_was_known_of_them():
    sharing = Sharing(OWN)
    sharing.on_token(RobotToken("r1"), False, 0)
    assert sharing.robots == {} and sharing.step(0) == {}
    for changed in ({"r1": DRIVE}, {}):
        sharing.on_token(RobotToken("r1"), True, 0)
        assert sharing.step(0) == changed and part(sharing) is DRIVE
    sharing.on_token(RobotToken("r1"), False, 1)
    sharing.on_token(RobotToken("r1"), False, 1)
    sharing.on_status("r1", Status(state=State.HOLD, reason=""), is_mine=False, sent=0, now_us=1)
    assert sharing.robots == {} and sharing.step(1) == {}


def test_a_robot_that_leaves_moves_another_to_keep_the_load():
    services, names = {"a": 1.0, "b": 1.0}, [f"r{number}" for number in range(7)]
    before, after = assign(names, services), assign({*names} - {"r1"}, services)
    assert (before["r6"], after["r6"]) == (("b", "a"), ("a", "b"))
    sharing = Sharing(OWN)
    for token in (OTHERS[0], *map(RobotToken, names)):
        sharing.on_token(token, True, 0)
    for name in names:
        sharing.on_token(driver(name), before[name][0] == "b", -1_200 * MS)
    assert sharing.step(0)["r6"] is STANDBY
    sharing.on_token(RobotToken("r1"), False, 1)
    assert sharing.step(1) == {"r6": CLAIM}


def test_a_robot_that_joins_later_is_driven():
    sharing = Sharing(OWN)
    assert sharing.step(0) == {}
    sharing.on_token(RobotToken("r1"), True, 1)
    assert sharing.step(1) == {"r1": DRIVE}


def test_a_named_robot_needs_no_token_and_stays():
    assert Sharing(OWN, named=("old",)).step(0) == {"old": DRIVE}
    assert [Sharing(OWN, named=("old",)).is_named(robot) for robot in ("old", "new")] == [True, False]
    robot = robot_whose("b", "a")
    sharing = Sharing(OWN, named=(robot,))
    for token in OTHERS:
        sharing.on_token(token, True, 0)
    assert sharing.step(0) == {robot: STANDBY}
    assert sharing.step(1_500 * MS - 1) == {}
    assert sharing.step(1_500 * MS) == {robot: DRIVE}
    sharing.on_token(RobotToken(robot), True, 1_600 * MS)
    sharing.on_token(RobotToken(robot), False, 1_700 * MS)
    assert part(sharing) is DRIVE


def test_drivers_count_from_before_their_robot_and_end_without_it():
    sharing = Sharing(OWN)
    token = driver("r1")
    sharing.on_token(token, True, 0)
    sharing.on_token(RobotToken("r1"), True, 0)
    assert sharing.step(1_200 * MS) == {"r1": CLAIM}
    sharing.on_token(RobotToken("r1"), False, 1)
    sharing.on_token(RobotToken("r1"), True, 2)
    assert sharing.robots["r1"].drivers == {token}, "its driver is still there"
    sharing.on_token(RobotToken("r1"), False, 3)
    sharing.on_token(driver("r1", 2), True, 4)
    sharing.on_token(token, False, 4)
    sharing.on_token(RobotToken("r1"), True, 5)
    assert sharing.robots["r1"].drivers == {driver("r1", 2)}
    sharing.on_token(RobotToken("r1"), False, 6)
    sharing.on_token(driver("r1", 2), False, 7)
    assert sharing._drivers == {}


def test_own_tokens_do_not_count_as_other_drivers():
    sharing, own = Sharing(OWN), driver("r1", 1, "a")
    sharing.on_token(OWN, True, 0)
    sharing.on_token(RobotToken("r1"), True, 0)
    sharing.add_own(own)
    for is_present in (True, False, True):  # a link that comes back declares it once more
        sharing.on_token(own, is_present, 0)
    assert sharing.robots["r1"].drivers == set() and sharing.services() == {"a": 1.0}


# --- new sessions -----------------------------------------------------------------------------------------------------


def driven(at_us=0):
    sharing = service(robot_whose("a", "b"), at_us=at_us)
    assert part(sharing) is DRIVE
    return sharing


def test_a_driver_without_the_lease_takes_a_new_session_after_300_ms_of_commands():
    sharing = driven()
    see(sharing, 1_000 * MS, 1, mine=True)
    assert not see(sharing, 1_100 * MS, 2)
    assert not see(sharing, 1_200 * MS, 3)
    assert not see(sharing, 1_300 * MS - 1, 4)
    assert see(sharing, 1_300 * MS, 5)
    assert not see(sharing, 1_300 * MS, 6), "it has begun"


@pytest.mark.parametrize("changed", [
    {"mine": True}, {"state": State.STOPPED}, {"state": State.FAULT}, {"holder": HUMAN}, {"camera_fault": "unplugged"},
], ids=["held", "stopped", "fault", "human", "camera"])
def test_time_without_the_lease_counts_from_the_last_reason_to_have_none(changed):
    sharing = driven()
    see(sharing, 1_000 * MS, 1, **changed)
    see(sharing, 1_150 * MS, 2)
    assert not see(sharing, 1_300 * MS - 1, 3)
    assert see(sharing, 1_300 * MS, 4)


def beside(is_beside):
    """Return a service that drives, perhaps beside another driver, which may have the lease."""
    sharing = driven()
    (robot,) = sharing.robots
    sharing.on_token(driver(robot), is_beside, 0)
    return sharing


@pytest.mark.parametrize(("is_beside", "after_ms"), [(True, 1_000), (False, 300)])
def test_no_new_session_while_no_command_leaves_or_soon_after_the_claim(is_beside, after_ms):
    sharing = beside(is_beside)
    assert not any(see(sharing, ms * MS, 7) for ms in range(0, 5_000, 100))
    sharing = beside(is_beside)
    assert next(ms for ms in range(0, 9_000, 50) if see(sharing, ms * MS, ms // 30)) == after_ms


@pytest.mark.parametrize(("count", "needed"), [(47, False), (48, True)])
def test_a_new_session_after_48_commands_without_the_lease(count, needed):
    sharing = driven()
    see(sharing, 1_000 * MS, count - 1, holder=HUMAN)
    assert see(sharing, 1_010 * MS, count) is needed
    sharing = driven()
    see(sharing, 1_000 * MS, 500, mine=True)
    assert see(sharing, 1_010 * MS, 500 + count) is needed
    assert see(driven(), 1_010 * MS, count, state=State.STOPPED) is needed, "later, no token is its own"
    assert not see(driven(), 1_010 * MS, 90, mine=True), "it has the lease"


@pytest.mark.parametrize(("is_beside", "first_ms"), [(True, 1_000), (False, 300)])
def test_waits_for_new_sessions_double_to_4_s_and_end_with_the_lease(is_beside, first_ms):
    sharing, begun_ms = beside(is_beside), []
    for ms in range(0, 20_000, 50):
        begun_ms += [ms] if see(sharing, ms * MS, ms // 30) else []
    assert begun_ms == [first_ms + wait_ms for wait_ms in (0, 2_000, 6_000, 10_000, 14_000, 18_000)]
    assert not see(sharing, 20_000 * MS, 1, mine=True)
    begun_ms = [ms for ms in range(23_000, 28_000, 50) if see(sharing, ms * MS, ms)]
    assert begun_ms == [23_000, 24_000, 26_000]


def test_commands_count_from_the_begin_of_a_session():
    for count, needed in ((0, False), (1, True)):
        sharing = driven()
        assert see(sharing, 1_000 * MS, 40)
        for ms in range(1_100, 2_800, 100):
            see(sharing, ms * MS, 0, holder=HUMAN)
        see(sharing, 2_800 * MS, count)
        see(sharing, 2_940 * MS, count + 1)
        assert see(sharing, 3_050 * MS, 5) is needed, "the first status of a new session showed no command of it"
        sharing = driven()
        assert (see(sharing, 900 * MS, count) or see(sharing, 1_000 * MS, 5)) is needed


def test_standby_needs_no_session():
    robot = robot_whose("b", "a")
    sharing = service(robot, driver(robot))
    assert not any(see(sharing, ms * MS, ms) for ms in range(0, 5_000, 100))


def test_choices_are_computed_again_only_after_a_token(monkeypatch):
    computed = []
    monkeypatch.setattr(f"{Sharing.__module__}.assign", lambda *given: computed.append(given) or assign(*given))
    sharing = service("r1")
    for now_us in range(5):
        sharing.step(now_us)
    assert len(computed) == 1
    sharing.on_token(RobotToken("r2"), True, 5)
    sharing.step(5)
    assert len(computed) == 2


# --- limits -----------------------------------------------------------------------------------------------------------


def test_tokens_beyond_the_limits_do_not_count():
    sharing = Sharing(OWN)
    for number in range(10_002):
        sharing.on_token(RobotToken(f"r{number}"), True, 0)
        sharing.on_token(VisionToken(f"v{number}", 1.0, "00000001"), True, 0)
        sharing.on_token(driver("r1", number), True, 0)
    assert len(sharing.robots) == 10_000 and len(sharing.services()) == 1 + 256
    assert len(sharing.robots["r1"].drivers) == 16
    sharing = Sharing(OWN)
    for number in range(10_002):
        sharing.on_token(driver(f"x{number}"), True, 0)
    assert len(sharing._drivers) == 10_000


@pytest.mark.parametrize(("fakes", "real"), [
    ([VisionToken(f"v{number}", 1.0, "00000001") for number in range(256)], OTHERS[0]),
    ([RobotToken(f"z{number}") for number in range(9_999)], RobotToken("r2")),
    ([driver(f"z{number}") for number in range(9_999)], driver("r2")),
    ([driver("r1", number) for number in range(16)], driver("r1", 99)),
], ids=["services", "robots", "driven robots", "drivers"])
def test_tokens_that_did_not_count_are_needed_once_when_there_is_room(fakes, real):
    sharing = Sharing(OWN)
    for token in (RobotToken("r1"), *fakes):
        sharing.on_token(token, True, 0)
    assert not sharing.needs_tokens()
    for _ in range(3):
        sharing.on_token(real, True, 1)
        assert not sharing.needs_tokens()
    sharing.on_token(fakes[0], False, 2)
    assert sharing.needs_tokens() and not sharing.needs_tokens()
    sharing.on_token(real, True, 3)
    assert not sharing.needs_tokens()
    known = {*sharing._services, *map(RobotToken, sharing.robots)}.union(*sharing._drivers.values())
    assert real in known


def test_drivers_of_known_robots_count_and_end_when_there_is_no_room_for_more_robots():
    sharing = Sharing(OWN)
    for number in range(10_000):
        sharing.on_token(driver(f"z{number}"), True, 0)
    sharing.on_token(driver("z5", 2), True, 1)
    assert len(sharing._drivers["z5"]) == 2
    sharing.on_token(driver("z5"), False, 2)
    assert sharing._drivers["z5"] == {driver("z5", 2)}


def test_newest_20_000_own_tokens_are_known():
    sharing = Sharing(OWN)
    for number in range(20_001):
        sharing.add_own(driver("r1", number, "a"))
    assert len(sharing._own_drivers) == 20_000 and driver("r1", 0, "a") not in sharing._own_drivers
