"""Waypoints as a person writes them, `X Y X Y ...` or a file of lines, checked one by one. Pure.

A file has one waypoint a line, its numbers separated by blanks or a comma; what follows a `#` is a remark.
"""

import re
from collections.abc import Sequence

from sightline.protocol.errors import ConfigError
from sightline.protocol.mission_messages import MAX_WAYPOINT_M, MAX_WAYPOINTS

Waypoints = tuple[tuple[float, float], ...]
_NUMBER = re.compile(r"[+-]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


def waypoints_of(texts: Sequence[str]) -> Waypoints:
    """The waypoints of `X Y X Y ...`. Raises ConfigError naming the first that is none."""
    numbers = [_number(text, f"waypoint {at // 2 + 1}") for at, text in enumerate(texts)]
    if len(numbers) % 2:
        raise ConfigError(f"waypoint {len(numbers) // 2 + 1}: has an X and no Y; write X Y [X Y ...] in metres")
    return _counted(tuple(zip(numbers[::2], numbers[1::2], strict=True)))


def waypoints_of_file(text: str, name: str) -> Waypoints:
    """The waypoints of a file's `text`. Raises ConfigError naming file and line."""
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        parts = line.partition("#")[0].replace(",", " ").split()
        if not parts:
            continue
        if len(parts) != 2:
            raise ConfigError(f"{name}:{number}: has {len(parts)} numbers; write X Y in metres, one waypoint a line")
        found.append((_number(parts[0], f"{name}:{number}"), _number(parts[1], f"{name}:{number}")))
    return _counted(tuple(found))


def _number(text: str, where: str) -> float:
    if not _NUMBER.fullmatch(text):
        raise ConfigError(f"{where}: {text!r} is no number")
    value = float(text)
    if not abs(value) <= MAX_WAYPOINT_M:
        raise ConfigError(f"{where}: {text} m is out of the world; {-MAX_WAYPOINT_M:g} to {MAX_WAYPOINT_M:g} m")
    return value


def _counted(found: Waypoints) -> Waypoints:
    if not 1 <= len(found) <= MAX_WAYPOINTS:
        raise ConfigError(f"{len(found)} waypoints; give 1 to {MAX_WAYPOINTS}, e.g. sightline goto r1 1.5 1.5")
    return found
