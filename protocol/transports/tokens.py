"""Define the liveliness tokens: which robots and services are present, and which service drives a robot. Pure.

    sightline-token/robot/ROBOT                            a robot
    sightline-token/vision/NAME/WEIGHT/INSTANCE            a vision service that shares robots
    sightline-token/driver/ROBOT/NAME/TOKEN                a session of it that drives a robot, or soon will
    sightline-token/detector/GROUP/WEIGHT/SESSION/ROBOTS   a detector service that shares robots

A token ends some milliseconds after its process, or with its link. `TOKEN` follows from the first proof of the driver
(`protocol/proof.py`). Only the driver can compute it before, so a robot knows the owner of a token.
"""

import re
from typing import Final, NamedTuple

from sightline.protocol import NAME_PATTERN

PREFIX: Final = "sightline-token"
ROBOT_KIND, VISION_KIND, DRIVER_KIND, DETECTOR_KIND = "robot", "vision", "driver", "detector"
ALL_TOKENS: Final = f"{PREFIX}/**"
LEAST_WEIGHT, MOST_WEIGHT = 0.01, 1000.0

# Security limits: robots and vision services whose tokens one peer stores.
MAX_ROBOTS: Final = 10_000
MAX_SERVICES: Final = 256
RECALL_US: Final = 5_000_000
"""Time in which a second watch has reported all earlier tokens, also on a busy machine."""
_WEIGHT: Final = r"\d{1,4}(?:\.\d{1,3})?"
# Exact, because a peer may declare a token with a wildcard, which names no robot and no service.
_KEYS: Final = re.compile(
    rf"{PREFIX}/(?:robot/(?P<robot>{NAME_PATTERN})"
    rf"|vision/(?P<name>{NAME_PATTERN})/(?P<weight>{_WEIGHT})/(?P<instance>[0-9a-f]{{8}})"
    rf"|driver/(?P<driven>{NAME_PATTERN})/(?P<driver>{NAME_PATTERN})/(?P<token>[0-9a-f]{{32}})"
    rf"|detector/(?P<group>[0-9a-f]{{8}})/(?P<share>{_WEIGHT})/(?P<session>[0-9a-f]{{8}})"
    r"/(?P<pattern>[A-Za-z0-9_.+=-]{1,32}))",
    re.ASCII,
)
# The key of a token has no wildcards, so `+` and `=` replace them in a pattern of robots.
_TO_KEY, _FROM_KEY = str.maketrans("*?", "+="), str.maketrans("+=", "*?")


def _weight(weight: float) -> str:
    """Format a weight for a key: three decimals, at most 1000, so seven digits."""
    return f"{weight:.7g}"


class RobotToken(NamedTuple):
    """A robot is present."""

    robot: str

    @property
    def key(self) -> str:
        """Return its key."""
        return f"{PREFIX}/{ROBOT_KIND}/{self.robot}"


class VisionToken(NamedTuple):
    """A vision service is present and shares robots. `weight` is its share, relative to the other services."""

    name: str
    weight: float
    instance: str
    """8 random hex digits of this start, which distinguish two services with one name."""

    @property
    def key(self) -> str:
        """Return its key."""
        return f"{PREFIX}/{VISION_KIND}/{self.name}/{_weight(self.weight)}/{self.instance}"


class DriverToken(NamedTuple):
    """A session of the vision service `name` drives `robot`, or soon will."""

    robot: str
    name: str
    token: str

    @property
    def key(self) -> str:
        """Return its key."""
        return f"{PREFIX}/{DRIVER_KIND}/{self.robot}/{self.name}/{self.token}"


class DetectorToken(NamedTuple):
    """A detector service is present and shares robots with the services of its group."""

    group: str
    """8 hex digits, equal for services that can replace each other."""
    weight: float
    """Its share of the robots, relative to the other services, with at most three decimals."""
    session: str
    """The session in the headers of its answers."""
    robots: str = "*"
    """Pattern of the robots that it serves, with `*` and `?`."""

    @property
    def key(self) -> str:
        """Return its key."""
        robots = self.robots.translate(_TO_KEY)
        return f"{PREFIX}/{DETECTOR_KIND}/{self.group}/{_weight(self.weight)}/{self.session}/{robots}"


Token = RobotToken | VisionToken | DriverToken
AnyToken = Token | DetectorToken


def drivers_of(robot: str) -> str:
    """Return the key expression of the tokens of the drivers of `robot`."""
    return f"{PREFIX}/{DRIVER_KIND}/{robot}/*/*"


def detectors_of(group: str) -> str:
    """Return the key expression of the tokens of the detector services in `group`."""
    return f"{PREFIX}/{DETECTOR_KIND}/{group}/*/*/*"


def parse_token(key: str) -> AnyToken | None:
    """Parse the exact key of a token. Return None for any other text, also for a weight outside its limits."""
    parts = _KEYS.fullmatch(key)
    if parts is None:
        return None
    if parts["robot"]:
        return RobotToken(parts["robot"])
    if parts["driven"]:
        return DriverToken(parts["driven"], parts["driver"], parts["token"])
    weight = float(parts["weight"] or parts["share"])
    if not LEAST_WEIGHT <= weight <= MOST_WEIGHT:
        return None
    if parts["group"]:
        return DetectorToken(parts["group"], weight, parts["session"], parts["pattern"].translate(_FROM_KEY))
    return VisionToken(parts["name"], weight, parts["instance"])


class SecondWatch:
    """Selects the valid tokens of a second watch, after a flood in which some tokens of the first one found no room.

    Zenoh may report a token there after the first watch reported its end. `on_end` and `counts` are thread-safe.
    """

    def __init__(self, most_ends: int) -> None:
        """Create it. `most_ends` is a security limit for the number of stored ends."""
        self._most_ends, self._until_us = most_ends, 0
        self._ended: set[AnyToken] | None = None

    def begin(self, now_us: int) -> None:
        """Note the start of the second watch."""
        self._until_us, self._ended = now_us + RECALL_US, set()

    def end(self) -> None:
        """Ignore all later tokens of the second watch."""
        self._ended = None

    def is_on(self, now_us: int) -> bool:
        """Return True while the second watch reports the earlier tokens."""
        if now_us >= self._until_us:
            self._ended = None
        return self._ended is not None

    def on_end(self, token: AnyToken) -> bool:
        """Note that the first watch reported the end of a token. Returns False without room for it."""
        ended = self._ended
        if ended is None or len(ended) >= self._most_ends:
            return ended is None
        ended.add(token)
        return True

    def counts(self, token: AnyToken) -> bool:
        """Return True if a token of the second watch is still present."""
        ended = self._ended
        return ended is not None and token not in ended
