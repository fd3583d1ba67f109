"""Assign robots to vision services: weighted rendezvous hashing with bounded load. Pure.

Every service computes the same assignment from the same tokens, so the services need no coordinator. A robot moves in
three cases: its service leaves, a new service is its better choice, or the load limit requires it.

Sources: Thaler and Ravishankar, "Using name-based mappings to increase hit rates" (1998); the weights as in
Schindelhauer and Schomaker, "Weighted distributed hash tables" (2005); the bound as in Mirrokni, Thorup and
Zadimoghaddam, "Consistent hashing with bounded loads" (2018).
"""

from collections.abc import Collection, Mapping
from hashlib import blake2b
from math import ceil
from typing import Final

import numpy as np
from numpy.typing import NDArray

MAX_LOAD: Final = 1.25
"""Upper limit of a service's robots, relative to the share of its weight."""


def ranked(robot: str, weights: Mapping[str, float]) -> list[str]:
    """Return all services, the best choice of `robot` first, without regard to their load."""
    names = sorted(weights)
    (scores,) = _scores([robot], names, weights)
    return [names[index] for index in np.argsort(-scores)]


def assign(robots: Collection[str], weights: Mapping[str, float], choices: int = 2) -> dict[str, tuple[str, ...]]:
    """Return the first choices of each robot: the owner and the standby, or more.

    Args:
        robots: ids of the robots.
        weights: name of each service -> its weight, above 0.
        choices: number of choices, 1 or more.

    Returns:
        robot -> (owner, standby, ...), with "" for each choice beyond the services. Empty without services.
    """
    names, all_robots = sorted(weights), sorted(robots)
    if not names:
        return {}
    total = sum(weights[name] for name in names)
    room = [ceil(MAX_LOAD * len(all_robots) * weights[name] / total) for name in names]
    order = np.argsort(-_scores(all_robots, names, weights)).tolist()
    found: dict[str, tuple[str, ...]] = {}
    for row, robot in enumerate(all_robots):
        owner = next(one for one in order[row] if room[one] > 0)
        room[owner] -= 1
        others = [names[one] for one in order[row][:choices] if one != owner]
        found[robot] = names[owner], *others[:choices - 1], *[""] * (choices - 1 - len(others))
    return found


def _scores(robots: list[str], names: list[str], weights: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the score of each robot (row) for each service (column): -weight / ln(u), u a uniform hash of the pair."""
    mixed = _mixed(_hashes(robots)[:, None] ^ _hashes(names)[None, :])
    # 53 bits, in the open interval from 0 to 1.
    uniform = ((mixed >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53
    return np.array([weights[name] for name in names]) / -np.log(uniform)


def _hashes(names: list[str]) -> NDArray[np.uint64]:
    digests = b"".join(blake2b(name.encode(), digest_size=8).digest() for name in names)
    return np.frombuffer(digests, dtype="<u8").astype(np.uint64)


def _mixed(values: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Mix the bits of each number, modulo 2^64. Source: the finalizer of SplitMix64 (Steele, Lea and Flood, 2014)."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))
