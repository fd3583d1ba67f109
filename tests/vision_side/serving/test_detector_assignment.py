"""Which detector service serves a robot: one of all, the next one while the first is silent, and all in a flood."""

from collections import Counter

import pytest

from sightline.protocol.transports.tokens import RECALL_US, DetectorToken
from sightline.vision_side.serving.assignment import ranked
from sightline.vision_side.serving.detector_sharing import (
    LEFT_US,
    MAX_KEPT_TOKENS,
    MAX_ROBOTS,
    MAX_SERVICES,
    SILENT_US,
    UNANSWERED_US,
    Assignment,
    Duty,
    RobotTokens,
)

ROBOTS = [f"r{number}" for number in range(200)]
FRAME_US = 33_333


def token(name, robots="*", weight=1.0):
    """Return the token of a service."""
    return DetectorToken("0a1b2c3d", weight, name, robots)


def names_for(robot, count=4):
    """Return services in the order in which they serve the robot."""
    return ranked(robot, {f"s{number}": 1.0 for number in range(count)})


def service(own, *others, robots="*", deadline_us=0):
    """Return the assignment of one service that knows the others."""
    one = Assignment(token(own, robots), deadline_us)
    set_services(one, *others)
    return one


def set_services(one, *others, now_us=0, robots="*"):
    """Let all present services end, and others appear."""
    for before in tuple(one._tokens):
        one.on_token(before, False)
    for name in others:
        one.on_token(token(name, robots), True)
    return one.update(now_us)


def watch(one, robot, from_us, to_us, answers_of=""):
    """Let frames, and answers of another service, come for a while. Returns the duties, without repetition."""
    duties = []
    for now_us in range(from_us, to_us, FRAME_US):
        if answers_of:
            one.on_answer(robot, answers_of, now_us)
        duty = one.duty(robot, now_us)
        if duty in (Duty.WATCH, Duty.SERVE):
            one.on_frame(robot, now_us)
        if duty not in duties[-1:]:
            duties.append(duty)
    return duties


def test_exactly_one_service_serves_each_robot_and_two_stand_by():
    names = [f"s{number}" for number in range(5)]
    services = [service(own, *names) for own in names]
    for robot in ROBOTS:
        duties = Counter(one.duty(robot, 0) for one in services)
        assert duties == {Duty.SERVE: 1, Duty.STAND_BY: 2, Duty.NOTHING: 2}
        served = next(name for name, one in zip(names, services, strict=True) if one.duty(robot, 0) is Duty.SERVE)
        assert served == ranked(robot, dict.fromkeys(names, 1.0))[0]


def test_next_service_serves_as_soon_as_the_token_of_the_first_ends():
    first, second, third, _ = names_for("r1")
    one = service(second, first, third)
    assert one.duty("r1", 0) is Duty.STAND_BY and not one.on_frame("r1", 0)
    set_services(one, third, now_us=1)
    assert one.duty("r1", 1) is Duty.SERVE and one.on_frame("r1", 1)


def test_service_continues_until_the_one_that_joined_has_answered():
    first, second, *_ = names_for("r1")
    one = service(second)
    assert one.duty("r1", 0) is Duty.SERVE
    set_services(one, first, now_us=1_000)
    assert watch(one, "r1", 1_000, 5_000_000) == [Duty.SERVE], "its token alone serves no robot"
    assert one.on_answer("r1", first, 5_000_000) and not one.on_frame("r1", 5_000_000)
    assert one.duty("r1", 5_000_000) is Duty.STAND_BY


def test_services_for_other_robots_do_not_count():
    one = service("s0", robots="r*")
    set_services(one, *(f"s{number}" for number in range(1, 30)), robots="a*")
    assert all(one.duty(robot, 0) is Duty.SERVE for robot in ROBOTS[:50]) and one.services == 30


def test_service_that_never_answers_is_replaced_and_served_again_when_it_answers():
    first, second, third, _ = names_for("r1")
    one = service(second, first, third)
    assert watch(one, "r1", 0, 10_000_000) == [Duty.STAND_BY, Duty.WATCH, Duty.SERVE]
    assert one.on_answer("r1", first, 10_000_000)
    assert watch(one, "r1", 10_000_000, 20_000_000, answers_of=first) == [Duty.STAND_BY]


def time_to_replace(interval_us, deadline_us=0):
    """Return the time from the last answer of the first service until the second one serves."""
    first, second, *_ = names_for("r1")
    one = service(second, first, deadline_us=deadline_us)
    last_us = range(0, 20_000_000, interval_us)[-1]
    for now_us in range(0, last_us + 1, interval_us):
        assert one.duty("r1", now_us) is Duty.STAND_BY
        one.on_answer("r1", first, now_us)
    for now_us in range(last_us, last_us + 9_000_000, 10_000):
        if one.duty("r1", now_us) is Duty.SERVE:
            return now_us - last_us
        if now_us % interval_us == 0:
            one.on_frame("r1", now_us)
    return None


def test_service_that_freezes_is_replaced_sooner_on_a_fast_stream():
    assert time_to_replace(30_000) == 300_000 + UNANSWERED_US
    assert time_to_replace(50_000) == 500_000 + UNANSWERED_US
    assert SILENT_US < time_to_replace(400_000) <= 2 * SILENT_US, "a slow stream is not sent twice"


def test_service_with_a_long_deadline_is_not_replaced_before_it():
    assert time_to_replace(50_000, deadline_us=500_000) == 500_000 + 1_000_000


def time_to_serve(robot, silent, weight=1.0):
    """Return when a service serves a robot beside so many others that never answer, us."""
    own, others = "ffffffff", [f"{number:08x}" for number in range(silent)]
    one = Assignment(token(own), 100_000)
    for name in others:
        one.on_token(token(name, weight=weight), True)
    one.update(0)
    for now_us in range(0, 30_000_000, 20_000):
        if one.duty(robot, now_us) is Duty.SERVE:
            return now_us
        if one.duty(robot, now_us) is Duty.WATCH:
            one.on_frame(robot, now_us)
    return None


@pytest.mark.parametrize("silent", [1, 2, 3, 5, 9])
def test_each_choice_replaces_those_before_it_after_its_own_number_of_seconds(silent):
    """Any number of tokens that never answer, of any weight, leaves no robot without answers."""
    assert time_to_serve("r1", silent, weight=1000.0) == silent * SILENT_US + UNANSWERED_US


def test_later_choice_receives_nothing_of_a_robot_before_that():
    first, second, third, fourth = names_for("r1")
    one = service(fourth, first, second, third)
    assert watch(one, "r1", 0, 10_000_000) == [Duty.NOTHING, Duty.WATCH, Duty.SERVE]


def test_later_choice_that_receives_an_answer_looks_again_as_long_after_it():
    first, second, third, fourth = names_for("r1")
    one = service(fourth, first, second, third)
    assert one.duty("r1", 0) is Duty.NOTHING
    for last_us in (0, 3_000_000, 6_000_000):
        assert one.duty("r1", last_us + 3 * SILENT_US - 1) is Duty.NOTHING
        assert one.duty("r1", last_us + 3 * SILENT_US) is Duty.WATCH and not one.on_frame("r1", last_us + 3_000_000)
        assert one.on_answer("r1", first, last_us + 3 * SILENT_US)
    one.on_answer("r1", first, 9_033_000)
    assert one.duty("r1", 9_033_000 + 3 * SILENT_US - 1) is Duty.NOTHING, "also after two answers in a row"
    one.on_answer("r1", third, 12_000_000)
    assert one.duty("r1", 12_000_000) is Duty.STAND_BY, "the first two are silent, so one service is before it"


def test_later_choice_receives_nothing_while_a_service_before_it_answers_another_robot():
    names = [f"s{number}" for number in range(6)]
    robot, other = (next(one for one in ROBOTS if ranked(one, dict.fromkeys(names, 1.0)).index("s0") == place)
                    for place in (5, 1))
    one = service("s0", *names[1:])
    first = ranked(other, dict.fromkeys(names, 1.0))[0]
    duties = set()
    for now_us in range(0, 20_000_000, FRAME_US):
        one.on_answer(other, first, now_us)
        duties.add(one.duty(robot, now_us))
    assert duties == {Duty.NOTHING}
    assert one.duty(robot, now_us + 5 * SILENT_US - 1) is Duty.NOTHING
    assert one.duty(robot, now_us + 5 * SILENT_US) is Duty.WATCH
    set_services(one, *(name for name in names[1:] if name != first), now_us=now_us)
    assert first not in one._answered_us


def test_answers_of_the_second_keep_the_third_from_serving():
    """The first one is silent; when the second one ends, the third one does not wait for the first again."""
    first, second, third, _ = names_for("r1")
    one = service(third, first, second)
    assert watch(one, "r1", 0, 10_000_000, answers_of=second) == [Duty.STAND_BY]
    set_services(one, first, now_us=10_000_000)
    assert one.duty("r1", 10_000_000) is Duty.SERVE


def test_silence_without_frames_changes_nothing():
    first, second, *_ = names_for("r1")
    one = service(second, first)
    assert [one.duty("r1", now_us) for now_us in (0, 60_000_000)] == [Duty.STAND_BY, Duty.WATCH]
    one.on_frame("r1", 60_000_000)
    assert one.duty("r1", 70_000_000) is Duty.WATCH, "one frame an hour ago is not a stream"
    one.on_frame("r1", 70_000_000)
    assert one.duty("r1", 70_000_000) is Duty.WATCH
    one.on_answer("r1", first, 70_010_000)
    assert one.duty("r1", 70_020_000) is Duty.STAND_BY


def test_answer_of_an_unknown_service_is_reported_and_changes_nothing():
    first, second, *_ = names_for("r1")
    one = service(first, second)
    assert one.duty("r1", 0) is Duty.SERVE and not one.on_answer("r1", "ffffffff", 1)
    assert one.duty("r1", 1) is Duty.SERVE
    one.forget("r1")
    assert not one.on_frame("r1", 2), "not before its next look"


def test_larger_weight_serves_more_robots():
    one = Assignment(token("s0"))
    one.on_token(token("s1", weight=3.0), True)
    assert one.update(0) and not one.update(1), "a change is reported once"
    assert 30 < sum(one.duty(robot, 2) is Duty.SERVE for robot in ROBOTS) < 70
    one.on_token(token("s1", weight=3.0), False)
    assert one.update(3) and one.services == 1


def test_of_two_tokens_with_one_session_one_counts_until_both_end():
    first, second, *_ = names_for("r1")
    one = service(second, first)
    one.on_token(token(first, robots="x*"), True)
    assert not one.update(0) and one.services == 2
    one.on_token(token(first), False)
    assert not one.update(1) and one.services == 2
    one.on_token(token(first, robots="x*"), False)
    assert one.update(2) and one.services == 1


def flood(one, numbers, is_present=True):
    """Let the tokens of many services appear or end."""
    for number in numbers:
        one.on_token(token(f"{number:08x}"), is_present)


def test_too_many_services_serve_all_robots_until_enough_have_ended():
    first, second, *_ = names_for("r1")
    one = service(second, first)
    assert one.duty("r1", 0) is Duty.STAND_BY and one.is_shared
    flood(one, range(MAX_SERVICES - 1))
    assert one.update(1) and not one.is_shared
    assert one.duty("r1", 1) is Duty.SERVE and one.on_frame("r1", 1), "as without sharing"
    assert one.on_answer("r1", "ffffffff", 1), "an answer of another one is as it should be"
    flood(one, range(MAX_SERVICES - 1), is_present=False)
    assert one.update(2) and one.is_shared and one.services == 2
    assert one.duty("r1", 2) is Duty.STAND_BY and not one.on_frame("r1", 2)


def test_service_that_came_in_a_flood_counts_after_it():
    """Its token does not fit, so the tokens are watched again once there is room."""
    first, second, *_ = names_for("r1")
    one = service(second)
    flood(one, range(MAX_KEPT_TOKENS))
    one.on_token(token(first), True)
    assert one.update(0) and not one.needs_tokens(0) and len(one._tokens) == MAX_KEPT_TOKENS
    flood(one, range(MAX_SERVICES, MAX_KEPT_TOKENS), is_present=False)
    assert one.needs_tokens(0) and not one.needs_tokens(0)
    flood(one, range(MAX_SERVICES), is_present=False)
    one.on_recalled(token(first))
    assert one.update(1) and one.duty("r1", 1) is Duty.STAND_BY and one.services == 2
    assert not one.needs_tokens(RECALL_US)


def after_a_flood():
    """Return a service whose first flood has ended but for one token, and which watches again."""
    one = service("s0")
    flood(one, range(MAX_KEPT_TOKENS + 1))
    flood(one, range(1, MAX_KEPT_TOKENS + 1), is_present=False)
    assert one.needs_tokens(0)
    return one


def test_token_whose_end_is_reported_before_its_beginning_has_ended():
    one, gone, back = after_a_flood(), token("s1"), token("s2")
    for known, is_present in ((gone, False), (back, False), (back, True)):
        one.on_token(known, is_present)
    for known in (gone, back):
        one.on_recalled(known)
    one.update(1)
    assert one._services.keys() == {"s0", "s2", "00000000"}


def test_token_that_is_recalled_too_late_does_not_count():
    one = after_a_flood()
    assert not one.needs_tokens(RECALL_US)
    one.on_recalled(token("s1"))
    one.update(RECALL_US)
    assert one._services.keys() == {"s0", "00000000"}


def test_flood_that_ends_meanwhile_needs_another_watch():
    one = after_a_flood()
    flood(one, range(2 * MAX_KEPT_TOKENS), is_present=False)
    one.on_recalled(token("s1"))
    assert not one._tokens and one.needs_tokens(1)


def test_token_that_is_known_does_not_count_as_left_out():
    one = service("s0")
    flood(one, range(MAX_KEPT_TOKENS))
    flood(one, range(MAX_KEPT_TOKENS))
    flood(one, range(MAX_KEPT_TOKENS), is_present=False)
    assert not one.needs_tokens(0)


def test_robot_is_present_from_its_token_on_and_for_a_while_after_it():
    robots = RobotTokens("r*")
    for name in ("r1", "r2", "a1"):
        robots.on_token(name, True, 0)
    assert robots.present(0) == ["r1", "r2"]
    robots.on_token("r1", False, 1)
    assert robots.present(LEFT_US) == ["r1", "r2"] and robots.present(LEFT_US + 1) == ["r2"]
    robots.on_token("r1", False, LEFT_US + 2)
    assert robots.present(LEFT_US + 2) == ["r2"] and not robots.needs_tokens(LEFT_US + 2), "its end came twice"
    robots.on_token("r2", False, LEFT_US + 2)
    robots.on_token("r2", True, LEFT_US + 3)
    assert robots.present(9 * LEFT_US) == ["r2"], "its link was cut for a moment"


def test_robot_that_is_named_needs_no_token():
    robots = RobotTokens("r1")
    robots.on_token("r1", False, 0)
    robots.on_token("r2", True, 0)
    assert robots.present(9 * LEFT_US) == ["r1"] and not robots.needs_tokens(9 * LEFT_US)


def test_robot_that_came_in_a_flood_of_tokens_is_found_after_it():
    robots = RobotTokens("*")
    for number in range(MAX_ROBOTS):
        robots.on_token(f"f{number}", True, 0)
    robots.on_token("r1", True, 0)
    assert len(robots.present(LEFT_US)) == MAX_ROBOTS and not robots.needs_tokens(LEFT_US)
    robots.on_token("f0", False, 1)
    robots.on_token("f1", True, 1)
    assert robots.present(LEFT_US) and not robots.needs_tokens(LEFT_US)
    present = robots.present(LEFT_US + 1)
    assert len(present) == MAX_ROBOTS - 1 and robots.needs_tokens(LEFT_US + 1)
    again = RobotTokens("*", present, LEFT_US + 1)
    for name in ("r1", "f1"):
        again.on_token(name, True, LEFT_US + 1)
    assert len(again.present(LEFT_US + 1)) == MAX_ROBOTS, "none has left yet"
    assert again.present(2 * LEFT_US + 1) == ["f1", "r1"]


def test_all_tokens_are_watched_again_once_in_a_while_at_most():
    robots = RobotTokens("*", now_us=LEFT_US)
    for number in range(MAX_ROBOTS + 1):
        robots.on_token(f"f{number}", True, LEFT_US)
    robots.on_token("f0", False, 0)
    assert len(robots.present(LEFT_US)) == MAX_ROBOTS - 1
    assert not robots.needs_tokens(2 * LEFT_US - 1) and robots.needs_tokens(2 * LEFT_US)
