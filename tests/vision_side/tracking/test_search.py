"""The search, image by image: when it begins, which way it turns, and what its budget counts."""

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
