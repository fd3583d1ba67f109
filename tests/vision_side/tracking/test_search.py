"""The search, image by image: when it begins, which way it turns, and what its budget counts."""

import math

import pytest

from sightline.protocol.messages import Twist
from sightline.vision_side.config import SearchConfig
from sightline.vision_side.tracking.steering import Search

TURNING = (0.0, 0.6)
"""Applied while it turns, m/s and rad/s."""


def turns(search, yaw_rad, dt_s=0.1, applied=TURNING):
    """Return True if the search turns at this heading."""
    return search.step(dt_s, (0.0, 0.0, yaw_rad), applied) is not None


def test_turn_across_the_wrap_of_the_heading_counts_by_its_size():
    """From 3.1 to -3.1 rad the robot turned by 0.083 rad, not by 6.2."""
    search = Search(SearchConfig(after_s=0.0, max_turn_rad=0.2))
    assert turns(search, 3.1)
    assert turns(search, -3.1), "0.083 of 0.2"
    assert turns(search, 3.1), "0.166 of 0.2, and back across"
    assert not turns(search, -3.1), "0.249 of 0.2"


def test_search_begins_after_its_time_without_the_target():
    search = Search(SearchConfig(after_s=0.25))
    assert [turns(search, 0.0, 0.125) for _ in range(4)] == [False, True, True, True]


@pytest.mark.parametrize(
    ("side", "sign"), [(None, 1), (0.3, 1), (1.5, 1), (-0.3, -1), (-2.0, -1), (0.0, 1), (-0.0, -1)]
)
def test_it_turns_on_the_spot_to_the_side_of_the_target_at_its_rate(side, sign):
    search = Search(SearchConfig(after_s=0.0, rate_rad_s=0.7))
    if side is not None:
        search.reset(side)
    assert search.step(0.1, (1.0, 2.0, 0.5), (0.0, 0.0)) == Twist(linear_mps=0.0, angular_rad_s=sign * 0.7)


def test_the_first_heading_counts_as_no_turn():
    search = Search(SearchConfig(after_s=0.0, max_turn_rad=1.0))
    assert turns(search, 2.5)
    search.reset(1.0)
    assert turns(search, -2.5)


def test_turns_to_either_side_add_up_to_the_budget():
    search = Search(SearchConfig(after_s=0.0, max_turn_rad=1.0))
    assert turns(search, 0.0) and turns(search, 0.5) and turns(search, 0.125)
    assert turns(search, 0.005), "0.5, 0.375 and 0.12 are less than a radian"
    assert not turns(search, 0.0)


def test_turn_of_more_than_a_quarter_between_two_images_counts_whole():
    search = Search(SearchConfig(after_s=0.0, max_turn_rad=2.0))
    assert turns(search, 0.0)
    assert not turns(search, 2.0)


@pytest.mark.parametrize(("applied_rad_s", "counts"), [(0.6, True), (-0.6, True), (0.001005, True), (-0.001005, True),
                                                       (0.001, False), (-0.001, False), (0.0, False)])
def test_only_the_time_of_turning_counts(applied_rad_s, counts):
    search = Search(SearchConfig(after_s=0.0, max_turning_s=0.5))
    assert [turns(search, 0.0, 0.125, (0.2, applied_rad_s)) for _ in range(5)] == [True] * 3 + [not counts] * 2


def test_time_at_rest_does_not_count_as_turning():
    search = Search(SearchConfig(after_s=0.0, max_turning_s=0.5))
    for _ in range(60):
        assert turns(search, 0.0, 0.125, (0.0, 0.0))
    assert [turns(search, 0.0, 0.125) for _ in range(4)] == [True] * 3 + [False]


def test_reset_restores_the_whole_budget_and_the_waiting_time():
    search = Search(SearchConfig(after_s=0.25, max_turn_rad=1.0, max_turning_s=1.0))
    for yaw_rad in (0.0, 0.75, 1.5):
        turns(search, yaw_rad, 0.5)
    assert not turns(search, 1.5)
    search.reset(-1.0)
    assert [turns(search, 1.5, 0.125) for _ in range(3)] == [False, True, True]
    search.reset(-1.0)
    assert [turns(search, 1.5, 0.25) for _ in range(4)] == [True] * 3 + [False], "a second of turning"


def test_disabled_search_never_turns():
    search = Search(SearchConfig(enabled=False, after_s=0.0))
    assert not any(turns(search, 0.0) for _ in range(3))


def way(search, yaw_rad, applied=TURNING, dt_s=0.249):
    """Return the side to which it turns, 1 left and -1 right."""
    return math.copysign(1, search.step(dt_s, (0.0, 0.0, yaw_rad), applied).angular_rad_s)


STANDS = (0.0, 0.0)


@pytest.mark.parametrize(("yaw_rad", "turns_back"), [(0.1, True), (-0.1, True), (0.0995, False), (0.0, False)])
def test_robot_that_turned_and_stands_for_a_second_turns_the_other_way(yaw_rad, turns_back):
    search = Search(SearchConfig(after_s=0.0))
    ways = [way(search, 0.0), way(search, yaw_rad), *(way(search, yaw_rad, STANDS) for _ in range(6))]
    assert ways == [1] * 6 + [-1 if turns_back else 1] * 2


@pytest.mark.parametrize(("dt_s", "rests"), [(0.25, 3), (0.2475, 4)])
def test_a_second_at_rest_is_whole(dt_s, rests):
    search = Search(SearchConfig(after_s=0.0))
    assert [way(search, 0.0, dt_s=dt_s), way(search, 0.5, dt_s=dt_s)] == [1, 1]
    ways = [way(search, 0.5, STANDS, dt_s) for _ in range(5)]
    assert ways == [1] * rests + [-1] * (5 - rests)


@pytest.mark.parametrize(("back_rad", "turns_again"), [(0.1, True), (0.0995, False)])
def test_it_turns_back_again_where_the_other_way_is_blocked_too(back_rad, turns_again):
    search = Search(SearchConfig(after_s=0.0))
    ways = [way(search, yaw_rad, applied) for yaw_rad, applied in (
        (0.5, TURNING), (0.0, TURNING), *[(0.0, STANDS)] * 12, (0.0, TURNING), (back_rad, TURNING),
        *[(back_rad, STANDS)] * 6)]
    assert ways == [1] * 6 + [-1] * 14 + [1 if turns_again else -1] * 2, "while it stands, it waits for the turn"


@pytest.mark.parametrize("again", ["it turns", "it sees the target"])
def test_a_short_rest_does_not_turn_it_back(again):
    search = Search(SearchConfig(after_s=0.0))
    way(search, 0.0)
    way(search, 0.5)
    for _ in range(4):
        for _ in range(4):
            assert way(search, 0.5, STANDS) == 1
        if again == "it turns":
            assert way(search, 0.5, (0.0, 0.002)) == 1
        else:
            search.reset(1.0)
            assert [way(search, 0.5), way(search, 0.6)] == [1, 1]
