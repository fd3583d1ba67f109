"""The assignment of robots to services: the same everywhere, in proportion to the weights, and stable."""

from collections import Counter
from math import ceil
from random import Random

import numpy as np
import pytest

from sightline.vision_side.serving.assignment import MAX_LOAD, _mixed, assign, ranked

GOLDEN = {
    "r1": ("west", "east"), "r2": ("east", "west"), "r3": ("east", "south"), "r4": ("south", "east"),
    "lab-07": ("north", "east"), "A": ("south", "east"),
}  # fmt: skip
WEIGHTS = {"north": 1.0, "east": 1.0, "south": 2.5, "west": 0.25}


def names(count, prefix):
    return [f"{prefix}{number}" for number in range(count)]


def test_golden_vectors():
    """Services of any machine and version must agree: these results never change."""
    assert assign(GOLDEN, WEIGHTS) == GOLDEN
    assert ranked("r1", WEIGHTS) == ["west", "east", "south", "north"]


def test_numbers_are_mixed_as_by_splitmix64():
    """The output of SplitMix64 with the seed 1234567 is that of its reference implementation."""
    states = [(1_234_567 + step * 0x9E3779B97F4A7C15) % 2**64 for step in range(1, 6)]
    assert _mixed(np.array(states, dtype=np.uint64)).tolist() == [
        6457827717110365317, 3203168211198807973, 9817491932198370423, 4593380528125082431, 16408922859458223821,
    ]  # fmt: skip


@pytest.mark.parametrize(("robots", "services", "most"), [(320, 40, 10), (840, 40, 27), (10, 1, 10), (3, 5, 1)])
def test_most_robots_of_a_service_are_a_quarter_more_than_its_share(robots, services, most):
    load = Counter(owner for owner, _ in assign(names(robots, "r"), dict.fromkeys(names(services, "v"), 1.0)).values())
    assert max(load.values()) == most


@pytest.mark.parametrize("seed", range(10))
def test_the_order_of_robots_and_services_changes_nothing(seed):
    chance = Random(seed)
    robots, weights = names(40, "r"), {name: chance.uniform(0.1, 5) for name in names(7, "v")}
    expected = assign(robots, weights)
    chance.shuffle(robots)
    shuffled = list(weights.items())
    chance.shuffle(shuffled)
    assert assign(robots, dict(shuffled)) == expected


@pytest.mark.parametrize("seed", range(10))
def test_the_load_is_bounded_by_the_weights_and_each_robot_has_two_services(seed):
    chance = Random(seed)
    robots = names(chance.randrange(1, 300), "robot-")
    weights = {name: chance.choice((0.01, 0.5, 1.0, 3.0, 1000.0)) for name in names(chance.randrange(2, 15), "v")}
    found = assign(robots, weights)
    load, total = Counter(owner for owner, _ in found.values()), sum(weights.values())
    assert set(found) == set(robots)
    assert all(load[name] <= ceil(MAX_LOAD * len(robots) * weight / total) for name, weight in weights.items())
    assert all(owner != standby and {owner, standby} <= set(weights) for owner, standby in found.values())


@pytest.mark.parametrize("seed", range(5))
def test_the_standby_takes_over_when_the_owner_leaves_and_few_others_move(seed):
    robots, weights = names(300, f"robot{seed}-"), dict.fromkeys(names(10, "v"), 1.0)
    before = assign(robots, weights)
    gone = Random(seed).choice(list(weights))
    after = assign(robots, {name: weight for name, weight in weights.items() if name != gone})
    own = [robot for robot in robots if before[robot][0] == gone]
    moved = [robot for robot in robots if before[robot][0] != after[robot][0]]
    assert sum(after[robot][0] == before[robot][1] for robot in own) >= 0.9 * len(own)
    assert len(moved) <= 1.3 * len(own) + 3


def test_a_service_that_comes_takes_robots_only_for_itself():
    robots, weights = names(300, "r"), dict.fromkeys(names(9, "v"), 1.0)
    before, after = assign(robots, weights), assign(robots, {**weights, "new": 1.0})
    moved = [robot for robot in robots if before[robot][0] != after[robot][0]]
    assert sum(after[robot][0] == "new" for robot in moved) / len(moved) >= 0.9
    assert 300 / 10 * 0.5 <= len(moved) <= 300 / 10 * 1.5


def test_without_robots_or_services_there_is_nothing_and_one_service_has_no_standby():
    assert assign([], WEIGHTS) == {} and assign(["r1"], {}) == {}
    assert assign(["r1", "r2"], {"a": 0.01}) == {"r1": ("a", ""), "r2": ("a", "")}
