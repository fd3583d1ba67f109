"""Find listeners by multicast, and robots and peers behind an endpoint. Shell."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from sightline.protocol.channels import KEY_PREFIX, STATUS, parse_key
from sightline.protocol.errors import ConfigError, home_path, install_command
from sightline.protocol.transports.endpoints import check_zenoh_endpoints, parse_zenoh_endpoint
from sightline.protocol.transports.link import LinkRules, Message
from sightline.protocol.transports.security import RoleKeys, load_role_keys
from sightline.protocol.transports.tokens import (
    ALL_TOKENS,
    MAX_ROBOTS,
    MAX_SERVICES,
    AnyToken,
    DetectorToken,
    DriverToken,
    RobotToken,
    Token,
    VisionToken,
)
from sightline.protocol.transports.zenoh.link import watch_tokens
from sightline.protocol.transports.zenoh.presence import (
    QUERY_ROUNDS,
    REPLY_TIMEOUT_S,
    PeerInfo,
    best_round_trips,
    query_presence,
)
from sightline.protocol.transports.zenoh.session import multicast_address, open_session

if TYPE_CHECKING:
    import zenoh

OPERATOR_ROLE: Final = "operator"
VIEWER_ROLE: Final = "viewer"
_BETWEEN_QUERIES_S: Final = 0.05

# Security limits of stored answers and tokens.
MAX_LISTENERS: Final = 64
_MOST: Final[dict[type[AnyToken], int]] = {RobotToken: MAX_ROBOTS, DriverToken: MAX_ROBOTS, VisionToken: MAX_SERVICES}


@dataclass(frozen=True, slots=True)
class Discovered:
    """The newest status of each robot, all peers that answered, and the tokens of services that share robots."""

    statuses: dict[str, Message]
    peers: list[PeerInfo]
    tokens: frozenset[Token] = frozenset()
    left_out: int = 0
    """Number of robots whose token did not fit."""


def discover(connect: Sequence[str], seconds: float, secure: str = "") -> Discovered:
    """Find robots and peers at `connect` within `seconds`. Raises the errors of `open_zenoh`."""
    check_zenoh_endpoints((), connect)
    with ExitStack() as ending:
        session = open_session((), connect, seconds, _own_keys(secure))
        ending.callback(session.close)
        tokens = PresentTokens()
        ending.callback(watch_tokens(session, ALL_TOKENS, tokens.note))
        return Discovered(_statuses(session, ending), _listen(session, seconds), tokens.all(), tokens.left_out)


class PresentTokens:
    """The tokens of robots and of the services that share them, up to a limit."""

    def __init__(self) -> None:
        self._kept: dict[type[AnyToken], set[Token]] = {kind: set() for kind in _MOST}
        self.left_out = 0
        """Number of robots whose token did not fit."""

    def note(self, token: AnyToken, is_present: bool) -> None:
        """Note a token that appeared or ended."""
        if isinstance(token, DetectorToken):
            return
        # Each kind has its own limit, so that a flood of services or drivers hides no robot.
        kept = self._kept[type(token)]
        if is_present and (token in kept or len(kept) < _MOST[type(token)]):
            kept.add(token)
        elif token in kept:
            kept.discard(token)
        elif isinstance(token, RobotToken):
            # Zenoh may report the end of a token whose start it did not report.
            self.left_out = max(0, self.left_out + (1 if is_present else -1))

    def all(self) -> frozenset[Token]:
        """Return the present tokens."""
        return frozenset().union(*self._kept.values())


def _own_keys(folder: str) -> RoleKeys | None:
    """Load the keys of an operator, or of a viewer if the folder has only those. Viewing needs no more."""
    only_viewer = folder and not _has(folder, OPERATOR_ROLE) and _has(folder, VIEWER_ROLE)
    return load_role_keys(folder, VIEWER_ROLE if only_viewer else OPERATOR_ROLE)


def _has(folder: str, role: str) -> bool:
    return (home_path(folder) / f"{role}.key").is_file()


def _listen(session: zenoh.Session, seconds: float) -> list[PeerInfo]:
    ends_s = time.monotonic() + seconds
    peers = _query_rounds(session, ends_s)
    time.sleep(max(0.0, ends_s - time.monotonic()))
    return peers


def _query_rounds(session: zenoh.Session, ends_s: float) -> list[PeerInfo]:
    rounds = []
    for _ in range(QUERY_ROUNDS):
        rounds.append(query_presence(session, max(0.1, min(REPLY_TIMEOUT_S, ends_s - time.monotonic()))))
        time.sleep(_BETWEEN_QUERIES_S)
    return best_round_trips(rounds)


def _statuses(session: zenoh.Session, ending: ExitStack) -> dict[str, Message]:
    """Return the newest status of every robot, updated until `ending`."""
    import zenoh

    found: dict[str, Message] = {}

    def note(sample: zenoh.Sample) -> None:
        key, attachment = str(sample.key_expr), sample.attachment
        parsed = parse_key(key)
        if parsed is None or (parsed[0] not in found and len(found) >= MAX_ROBOTS):
            return
        robot, header = parsed[0], b"" if attachment is None else attachment.to_bytes()
        LinkRules(robot).deliver(STATUS, key, header, sample.payload.to_bytes(),
                                 lambda message: found.update({robot: message}))

    handler = zenoh.handlers.Callback(note, indirect=False)
    ending.callback(session.declare_subscriber(f"{KEY_PREFIX}/*/{STATUS.name}", handler).undeclare)
    return found


def usable_endpoint(locator: str) -> str:
    """Return the endpoint of a listener that answered, or "" for one that this machine cannot use."""
    text = str(locator).partition("?")[0].partition("#")[0]
    try:
        parse_zenoh_endpoint(text)
    except ConfigError:
        return ""
    return "" if "%" in text else text  # the interface number is valid on the other machine only


def find_listeners(seconds: float) -> list[str]:
    """Return one endpoint of each listener that answers within `seconds`, or an empty list without multicast.

    Raises ConfigError if Zenoh is not installed.
    """
    try:
        import zenoh
    except ImportError:
        raise ConfigError(f"Zenoh is not installed: {install_command('zenoh')}") from None
    logging.getLogger("zenoh").addHandler(logging.NullHandler())
    answers: zenoh.handlers.RingChannel[zenoh.Hello] = zenoh.handlers.RingChannel(MAX_LISTENERS)
    config = {"scouting": {"multicast": {"enabled": True, "address": multicast_address()}}}
    try:
        with zenoh.scout(answers, zenoh.WhatAmIMatcher("router"), zenoh.Config.from_json5(json.dumps(config))) as scout:
            time.sleep(seconds)
            hellos = iter(scout.try_recv, None)
            found = {str(hello.zid): [locator for text in hello.locators if (locator := usable_endpoint(text))]
                     for hello in hellos}
    except zenoh.ZError:  # there is no network
        return []
    return sorted(min(usable, key=lambda locator: "[" in locator) for usable in found.values() if usable)
