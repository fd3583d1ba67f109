"""A case and the bench that it runs on: messages, time, expectations. Pure.

    SUITE = Suite("R")

    @SUITE.must("R-CAUS-02", "5.1 Order", ready)
    def unknown_frame(bench: Bench, sender: Sender) -> None:
        '''A twist that cites a frame never issued is rejected as UNKNOWN_FRAME.'''
        sender.expect("UNKNOWN_FRAME", echo_seq=MAX_INTEGER)

    SUITE.must_all(ready, {
        "R-SEQ-07": ("5.1 Order", "A `seq` below the last ...", lambda sender: sender.expect("OUT_OF_ORDER", seq=0)),
    })

The id is side, group and number; the first docstring line is the title; the clause is a heading of the specification.
`begin` brings the peer to the start of the case and returns the case's second argument. Similar cases are table rows.
A case returns when the peer conforms and raises `ConformanceError` (through `bench.expect`) when it does not. It
raises `NotApplicableError` (through `bench.need`) when a requirement is missing: that has a separate case, or is
a choice.
"""

import heapq
import itertools
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from typing import Any, Final, TypeVar, cast

from sightline.conformance.measured import WheelRow
from sightline.protocol.channels import SOURCES_OF_ROLE, Channel
from sightline.protocol.codec import decode, encode
from sightline.protocol.errors import WireError
from sightline.protocol.messages import WireModel
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.security import certificate_role

GROUPS: Final = {
    "FRAM": "framing",
    "HEAD": "headers",
    "GRAM": "grammar",
    "CAUS": "causality",
    "SEQ": "sequence",
    "LIM": "limits",
    "LEASE": "lease",
    "PROOF": "proof of identity",
    "ARM": "arming",
    "STOP": "stop",
    "SIL": "silence",
    "REQ": "requests",
    "STAT": "status",
    "FLOW": "flow",
    "DIAL": "legacy clients",
    "HOST": "hostile input",
    "RECO": "reconnect",
    "SOCK": "websocket",
    "STEER": "steering",
    "REP": "reports",
    "CODEC": "codec",
}
"""Code in an id -> name of the group, as in `--group`."""


NOT_DRIVING: Final = "it does not answer plain frames with twists"
"""Reason why a case that needs twists of a vision service is not applicable. `passed` counts it as untested."""


class Level(StrEnum):
    """The level of a case, in the words of RFC 2119."""

    MUST = "MUST"
    SHOULD = "SHOULD"


class ConformanceError(Exception):
    """The peer does not conform. The text reports the expected and the observed behavior."""


class NotApplicableError(Exception):
    """A requirement of the case is missing. The text names it."""


@dataclass(frozen=True, slots=True)
class Case:
    """One point of the specification and the function that tests it."""

    id: str
    level: Level
    clause: str
    title: str
    run: "Callable[[Bench], None]"
    real: bool = False
    """True if it needs real sockets, so that it cannot run in virtual time."""

    @property
    def group(self) -> str:
        """Return the name of the group."""
        return GROUPS[self.id.split("-")[1]]


Run = Callable[..., None]
Adding = Callable[[Run], Run]
Subject = TypeVar("Subject")


class Suite:
    """The cases of one file. `side` is the first letter of their ids: R robot, V vision, C codec."""

    def __init__(self, side: str) -> None:
        self.side = side
        self.cases: list[Case] = []

    def must(self, number: str, clause: str, begin: "Begin | None" = None, *, real: bool = False) -> Adding:
        """Add a case that every peer must pass, as a decorator of `run(bench, begin(bench))` or `run(bench)`."""
        return self._adding(number, Level.MUST, clause, begin, real)

    def should(self, number: str, clause: str, begin: "Begin | None" = None, *, real: bool = False) -> Adding:
        """Add a case that a peer may fail for a good reason, as a decorator."""
        return self._adding(number, Level.SHOULD, clause, begin, real)

    def must_all(
        self, begin: "Callable[[Bench], Subject]", rows: Mapping[str, tuple[str, str, Callable[[Subject], None]]],
        *, level: Level = Level.MUST, real: bool = False,
    ) -> None:
        """Add a case for each row: id -> clause, title, and a function of the result of `begin`."""
        for number, (clause, title, check) in rows.items():
            self.add(Case(number, level, clause, title, _joined(begin, check), real))

    def add(self, case: Case) -> None:
        """Add a case without a decorator, e.g. from a table. Raises ValueError for an invalid or duplicate id."""
        parts = case.id.split("-")
        if len(parts) != 3 or parts[0] != self.side or parts[1] not in GROUPS or not parts[2].isdigit():
            raise ValueError(f"{case.id}: write {self.side}-GROUP-NN with a group of {', '.join(GROUPS)}")
        if any(other.id == case.id for other in self.cases):
            raise ValueError(f"{case.id} is there twice")
        self.cases.append(case)

    def _adding(self, number: str, level: Level, clause: str, begin: "Begin | None", real: bool) -> Adding:
        def add(run: Run) -> Run:
            whole = run if begin is None else lambda bench: run(bench, begin(bench))
            self.add(Case(number, level, clause, (run.__doc__ or "").split("\n")[0], whole, real))
            return run

        return add


def _joined(begin: "Callable[[Bench], Subject]", check: Callable[[Subject], None]) -> "Callable[[Bench], None]":
    return lambda bench: check(begin(bench))


def itself(bench: "Bench") -> "Bench":
    """Begin rows that need only the bench."""
    return bench


Begin = Callable[["Bench"], Any]


# The interface of a case: messages, time and expectations. Pure; `benches.py` implements it:
# `VirtualBench` runs a peer in virtual time without sleeping, `LiveBench` a real one over the network. A case is
# written in blocking style. Only `wait` and `rest` let time pass, and callbacks (`on`, `after`) run inside them, never
# in parallel.


_SHOWN_MESSAGES: Final = 3
_SHOWN_BYTES: Final = 48
_SHOWN_TEXT: Final = 200
KEPT_MESSAGES: Final = 600
"""Per channel; 20 s of frames at 30 fps, longer than any case lasts."""

Model = TypeVar("Model", bound=WireModel)


@dataclass(frozen=True, slots=True)
class Access:
    """The credentials of the kit: a token for each role, and a folder of keys. Both are empty for an open peer."""

    tokens: Mapping[str, str] = field(default_factory=dict)
    folder: str = ""

    @property
    def is_guarded(self) -> bool:
        """Return True if tokens or certificates separate the roles."""
        return bool(self.tokens or self.folder)

    @property
    def watcher(self) -> str:
        """Return a role that may request and may not drive; with keys, a viewer may send nothing at all."""
        return "operator" if self.is_guarded else "viewer"

    def may_request(self, source: str) -> bool:
        """Return True if the peer accepts requests of `source`."""
        return not self.is_guarded or source in SOURCES_OF_ROLE["operator"]

    def token_of(self, source: str) -> str:
        """Return the token of `source`, or "" without tokens."""
        return self.tokens.get(certificate_role(source), "")


@dataclass(frozen=True, slots=True)
class Received:
    """A message from the peer: arrival time on the kit's clock, and its number among all received messages."""

    number: int
    at_us: int
    message: Message

    def header(self, model: type[Model]) -> Model | None:
        """Return the header as `model`; None for an invalid one, which another case tests."""
        return cast(Model | None, _decoded(model, self.message.header))

    def payload(self, model: type[Model]) -> Model | None:
        """Return the payload as `model`; None for an invalid one."""
        return cast(Model | None, _decoded(model, self.message.payload))


@lru_cache(maxsize=4 * KEPT_MESSAGES)
def _decoded(model: type[WireModel], data: bytes) -> WireModel | None:
    """Decode once what a case reads again at each step of time."""
    try:
        return decode(model, data, len(data))
    except WireError:
        return None


class Bench(ABC):
    """One peer under test. `robot` is the id of the tested robot, or of the one that the kit plays."""

    def __init__(self, robot: str, endpoint: str = "", legacy: str = "", access: Access | None = None) -> None:
        """Store the addresses (`endpoint` of the peer, `legacy` of its legacy protocol) and `access`, keys and tokens.

        These three are for cases with separate sockets.
        """
        self.robot, self.endpoint, self.legacy, self.access = robot, endpoint, legacy, access or Access()
        self.motor_rows: Callable[[], Sequence[WheelRow]] = tuple
        """Returns the rows of the robot's motor log so far; empty without a log."""
        self.played: dict[str, object] = {}
        """Peers that the kit plays, by the digest of their session. A robot shows only the digest of a driver."""
        self.link_us: int | None = None
        """Delay of a reply over the link beyond that of a fast link. None: not measured yet."""
        self._log: dict[str, deque[Received]] = {}
        self._reactions: list[tuple[Channel, Callable[[Received], None]]] = []
        self._timers: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count(1)
        self._newest_number = 0
        self._sent: deque[str] = deque(maxlen=_SHOWN_MESSAGES)

    # --- to be implemented ---------------------------------------------------------------------------------------

    @property
    @abstractmethod
    def now_us(self) -> int:
        """Return the kit's clock, monotonic. Never compare it with a robot's `t_us`."""

    @property
    @abstractmethod
    def dropped_here(self) -> Counter[str]:
        """Count the peer's messages that the kit's link rejected, by reason: OVERSIZE, INEXACT_KEY ..."""

    @abstractmethod
    def send(self, channel: Channel, header: bytes, payload: bytes, source: str) -> None:
        """Publish bytes within the channel's bounds."""

    @abstractmethod
    def put(self, key: str, header: bytes, payload: bytes) -> None:
        """Publish anything under any key, as a third party could. Raises NotApplicableError if that is impossible."""

    @abstractmethod
    def declare_token(self, token: str) -> Callable[[], None]:
        """Declare the token of a driver; it ends with the returned function.

        Raises NotApplicableError if links have no tokens, or if the robot declares none.
        """

    @abstractmethod
    def leave(self) -> None:
        """Close the kit's connection. Until `join` nothing is received and nothing can be sent."""

    @abstractmethod
    def join(self) -> None:
        """Connect again, as a new connection."""

    @abstractmethod
    def _pass_time(self, until_us: int) -> None:
        """Let time pass, at most until `until_us`, and pass messages that arrive to `_hear`."""

    # --- messages ------------------------------------------------------------------------------------------------

    def publish(
        self, channel: Channel, header: WireModel | bytes, payload: WireModel | bytes = b"", source: str = ""
    ) -> None:
        """Send a message. `source` is the role in the key, for channels towards the robot."""
        self._sent.append(_shown("sent", channel, _bytes(header), _bytes(payload)))
        self.send(channel, _bytes(header), _bytes(payload), source)

    def mark(self) -> int:
        """Return the position in the received messages, for `received`."""
        return self._newest_number

    def number(self) -> int:
        """Return a number that this bench has not returned before."""
        return next(self._numbers)

    def received(self, channel: Channel, since: int = 0) -> list[Received]:
        """Return the messages on `channel` after the mark `since`, oldest first."""
        newer: list[Received] = []
        for one in reversed(self._log.get(channel.name, ())):
            if one.number <= since:
                break
            newer.append(one)
        return newer[::-1]

    def newest(self, channel: Channel) -> Received | None:
        """Return the newest message of `channel`."""
        log = self._log.get(channel.name)
        return log[-1] if log else None

    def on(self, channel: Channel, react: Callable[[Received], None]) -> None:
        """Call `react` for every later message of `channel`, inside `wait` and `rest`."""
        self._reactions.append((channel, react))

    def forget(self) -> None:
        """Drop the log, the reactions and the timers between two cases."""
        self._log.clear()
        self._sent.clear()
        self._reactions.clear()
        self._timers.clear()

    def _receive(self, message: Message) -> None:
        self._newest_number = next(self._numbers)
        one = Received(self._newest_number, self.now_us, message)
        self._log.setdefault(message.channel.name, deque(maxlen=KEPT_MESSAGES)).append(one)
        for channel, react in tuple(self._reactions):
            if channel is message.channel:
                react(one)

    def evidence(self) -> tuple[str, ...]:
        """Format the last sent messages, and the last message of each received channel, as bytes and text."""
        newest = sorted((log[-1] for log in self._log.values() if log), key=lambda one: one.number)
        parts = ((one.message.channel, one.message.header, one.message.payload) for one in newest)
        return (*self._sent, *(_shown("received", *part) for part in parts))

    def restore(self) -> None:
        """Connect again if the last case ended without a connection. Raises LinkError."""
        return

    # --- time ----------------------------------------------------------------------------------------------------

    def after(self, delay_us: int, call: Callable[[], None]) -> None:
        """Call once after `delay_us`, inside `wait` and `rest`."""
        heapq.heappush(self._timers, (self.now_us + delay_us, next(self._numbers), call))

    def wait(self, until: Callable[[], object], within_us: int) -> bool:
        """Let time pass until `until()` is true, at most `within_us`. Returns its last value."""
        deadline_us = self.now_us + within_us
        while not until():
            if self.now_us >= deadline_us:
                return False
            next_us = min(deadline_us, self._timers[0][0]) if self._timers else deadline_us
            self._pass_time(max(next_us, self.now_us))
            self._ring()
        return True

    def rest(self, for_us: int) -> None:
        """Let time pass for `for_us`."""
        self.wait(lambda: False, for_us)

    def _ring(self) -> None:
        now_us = self.now_us
        while self._timers and self._timers[0][0] <= now_us:
            heapq.heappop(self._timers)[2]()

    # --- results ------------------------------------------------------------------------------------------------

    def expect(self, condition: object, reason: str) -> None:
        """Fail the case with `reason` unless `condition` is true."""
        if not condition:
            raise ConformanceError(reason)

    def expect_within(self, until: Callable[[], object], within_us: int, reason: str) -> None:
        """Fail the case unless `until()` becomes true in time."""
        self.expect(self.wait(until, within_us), f"{reason} (waited {within_us / 1e6:g} s)")

    def need(self, condition: object, reason: str) -> None:
        """Leave the case as not applicable unless `condition` is true."""
        if not condition:
            raise NotApplicableError(reason)


def _bytes(part: WireModel | bytes) -> bytes:
    return part if isinstance(part, bytes) else encode(part)


def _shown(verb: str, channel: Channel, header: bytes, payload: bytes) -> str:
    """Format one message, bounded: the header as text, the payload as text and hex."""
    text = payload[:_SHOWN_BYTES].decode("ascii", "replace")
    return (f"{verb} {channel.name}: header {header[:_SHOWN_TEXT].decode('ascii', 'replace')}, payload {text!a} = "
            f"{payload[:_SHOWN_BYTES].hex()} ({len(payload)} bytes)")
