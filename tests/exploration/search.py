"""Breadth-first search through all states. The first violation found is one of the shortest."""

import array
import multiprocessing
import struct
from collections.abc import Callable, Iterator, KeysView
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, partial

from sightline.protocol.messages import Holder, Verb
from tests.exploration.promises import NOBODY, BrokenError, Promises
from tests.exploration.robot import (
    AUTO,
    CHAINS,
    DRIVERS,
    EARLIER,
    HUMAN,
    KEYS,
    LAST_PROOF,
    NEXT_PROOF,
    OLD_PROOF,
    OPERATOR,
    PLAIN,
    ROBOT,
    ROBOT_FIELDS,
    SECOND,
    SHARING,
    THIEF,
    VISION,
    Image,
    Robot,
)

_NAMES = {VISION: "vision", SECOND: "a second vision service", HUMAN: "teleop", OPERATOR: "an operator"}
_CHUNK = 500  # states that a process expands at once


@dataclass(frozen=True, slots=True)
class Event:
    """Something that may happen in a state."""

    words: str
    happen: Callable[[Robot, Promises], None]
    possible: Callable[[Promises], bool] = lambda _promises: True
    ticks: bool = False


def _tick(words: str, image: Image) -> Event:
    def happen(robot: Robot, promises: Promises) -> None:
        robot.tick(image)
        promises.on_tick(image)

    def possible(promises: Promises) -> bool:
        return not ((image is Image.LAST and promises.last < 0) or (image is Image.PREVIOUS and promises.previous < 0))

    return Event(f"100 ms pass; {words}", happen, possible, ticks=True)


def _twist(
    who: Holder, age: int, words: str = "", *, fresh: bool = True, session: str = ROBOT, off_us: int = 0
) -> Event:
    driver, real = DRIVERS.index(who), session == ROBOT and not off_us

    def happen(robot: Robot, promises: Promises) -> None:
        reason = robot.twist(who, age, int(fresh), session, off_us)
        promises.on_twist(driver, age, reason, fresh=fresh, real=real)

    def possible(promises: Promises) -> bool:
        return promises.images[age] >= 0 and (fresh or promises.seen[driver])

    what = words or f"on the frame of {age * 100} ms ago"
    return Event(f"{_NAMES[who]}: a command {what} arrives", happen, possible)


def _request(who: Holder, verb: Verb, age: int = 0) -> Event:
    driver = DRIVERS.index(who) if who in DRIVERS else NOBODY

    def happen(robot: Robot, promises: Promises) -> None:
        reason = robot.request(who, verb, age)
        promises.on_request(driver, verb, age, reason, robot.core.config.safety.auto_arm)

    def possible(promises: Promises) -> bool:
        return age <= promises.started or age > 20

    when = f" of {age * 100} ms ago" if age else ""
    return Event(f"{_NAMES[who]}: {verb}{when} arrives", happen, possible)


def _proof_twist(driver: int, words: str, proof: str | None, *, proven: bool = True) -> Event:
    """`driver` sends the command, or, where it is `NOBODY`, a peer that must never drive."""
    who = VISION if driver == NOBODY else DRIVERS[driver]

    def happen(robot: Robot, promises: Promises) -> None:
        reason = robot.twist(who, 0, 1, proof=proof)
        promises.on_twist(driver, 0, reason, proven=proven)

    return Event(f"a command {words} arrives", happen, lambda promises: promises.images[0] >= 0)


def _proof_request(driver: int, verb: Verb, words: str, proof: str | None) -> Event:
    """`driver` sends the request, or, where it is `NOBODY`, a peer with a proof that proves nothing."""
    who = VISION if driver == NOBODY else DRIVERS[driver]

    def happen(robot: Robot, promises: Promises) -> None:
        reason = robot.request(who, verb, 0, proof)
        promises.on_request(driver, verb, 0, reason, False)

    return Event(f"{verb} {words} arrives", happen)


def _token(driver: int, is_present: bool) -> Event:
    def happen(robot: Robot, promises: Promises) -> None:
        robot.token(driver, is_present)
        promises.on_token(driver, is_present)

    def possible(promises: Promises) -> bool:
        return bool(promises.tokens >> driver & 1) != is_present

    return Event(f"the token of {_NAMES[DRIVERS[driver]]} {'appears' if is_present else 'ends'}", happen, possible)


def _restart(robot: Robot, promises: Promises) -> None:
    robot.restart()
    promises.on_restart(robot.core.config.safety.auto_arm)


def _write(robot: Robot, promises: Promises) -> None:
    robot.write_latch()
    promises.on_write()


def _fault(robot: Robot, promises: Promises) -> None:
    robot.fault()
    promises.on_fault()


NEW = _tick("a frame with a new image is published", Image.NEW)
IMAGES = (
    _tick("no frame is published", Image.MISSING),
    _tick("a frame with the last image again is published", Image.LAST),
    _tick("a frame with the image before the last again is published", Image.PREVIOUS),
)
FORGED = (
    _twist(VISION, 0, "that arrived before", fresh=False),
    _twist(HUMAN, 0, "that arrived before", fresh=False),
    _twist(VISION, 0, "on a frame that was never issued", off_us=-1),
    _twist(VISION, 0, "on a frame of the future", off_us=1),
    _twist(VISION, 0, "on a frame of an earlier start", session=EARLIER),
)
STOP, DISARM, ARM, RESET = (_request(OPERATOR, verb) for verb in (Verb.STOP, Verb.DISARM, Verb.ARM, Verb.RESET))
LATE = (_request(OPERATOR, Verb.ARM, 2), _request(OPERATOR, Verb.RESET, 2), _request(OPERATOR, Verb.ARM, 21))
LEASE = tuple(_request(who, verb) for who in (HUMAN, VISION) for verb in (Verb.ACQUIRE, Verb.RELEASE))
HUMAN_ARM = _request(HUMAN, Verb.ARM)
RESTART = Event("the driver process is killed and starts again", _restart)
WRITE = Event("the disk stores the latch", _write)
FAULT = Event("the drive fails", _fault)
V, S, H = (_twist(who, 0) for who in DRIVERS[:THIEF])

VISION_PROOFS, HUMAN_PROOFS, THIEF_PROOFS = (CHAINS[driver] for driver in (0, 2, THIEF))
IDENTITY = (
    _proof_twist(0, "of vision, with its next proof,", VISION_PROOFS[NEXT_PROOF]),
    _proof_twist(2, "of teleop, with its next proof,", HUMAN_PROOFS[NEXT_PROOF]),
    _proof_twist(THIEF, "of a thief, with proofs of its own,", THIEF_PROOFS[NEXT_PROOF]),
    _proof_twist(0, "of a thief, with vision's last proof,", VISION_PROOFS[LAST_PROOF], proven=False),
    _proof_twist(NOBODY, "of a thief, without a proof,", None),
    _proof_request(0, Verb.ACQUIRE, "of vision, with its next proof,", VISION_PROOFS[NEXT_PROOF]),
    _proof_request(0, Verb.RELEASE, "of vision, with its next proof,", VISION_PROOFS[NEXT_PROOF]),
    _proof_request(2, Verb.RELEASE, "of teleop, with its next proof,", HUMAN_PROOFS[NEXT_PROOF]),
    _proof_request(THIEF, Verb.ACQUIRE, "of a thief, with proofs of its own,", THIEF_PROOFS[NEXT_PROOF]),
    _proof_request(THIEF, Verb.RELEASE, "of a thief, with proofs of its own,", THIEF_PROOFS[NEXT_PROOF]),
    _proof_request(NOBODY, Verb.RELEASE, "of a thief, with vision's last proof,", VISION_PROOFS[LAST_PROOF]),
    _proof_request(NOBODY, Verb.RELEASE, "of a thief, with an old proof of vision,", VISION_PROOFS[OLD_PROOF]),
    _proof_request(NOBODY, Verb.RELEASE, "of a thief, without a proof,", None),
)

TOKENED = (
    *(_token(driver, is_present) for driver in SHARING for is_present in (True, False)),
    IDENTITY[0],
    _proof_twist(1, "of the second vision service, with its next proof,", CHAINS[1][NEXT_PROOF]),
)

LIFE = (
    NEW, V, NEW, V, ARM, V, NEW, V, NEW, V, NEW, V, NEW, V,  # vision drives at top speed
    H, NEW, H, NEW, H, NEW, H, NEW, H, NEW, LEASE[1], NEW, NEW, NEW,  # teleop takes over and lets go
    V, NEW, V, ARM, V, NEW, V, NEW, V, NEW, V, STOP, WRITE, NEW, NEW, NEW, RESTART, NEW, RESET, WRITE,  # STOP
    NEW, V, NEW, V, ARM, V, NEW, V, NEW, V, NEW, V, *(IMAGES[0],) * 3, *(IMAGES[1],) * 3,  # frames and commands end
)  # fmt: skip
"""A usual life of a robot. It leads to states that are far from each start, so that each is a start too."""


@dataclass(frozen=True, slots=True)
class Part:
    """Events whose interleavings are explored together, in all orders.

    Args:
        events: what may happen in each state.
        modes: configurations to begin with.
        life: events that lead to more states to begin with.
        most: number of states after which it ends.
    """

    events: tuple[Event, ...]
    modes: tuple[int, ...] = (PLAIN, AUTO)
    life: tuple[Event, ...] = ()
    most: int = 100_000


PARTS = {
    "all": Part((
        NEW, *IMAGES, *(_twist(VISION, age) for age in (2, 4, 5)), V, S, H, _twist(HUMAN, 2), *FORGED,
        STOP, DISARM, ARM, RESET, HUMAN_ARM, *LATE, *LEASE, RESTART, WRITE, FAULT,
    ), life=LIFE, most=700_000),
    "loss": Part((NEW, V, S, H, ARM)),
    "lease": Part((NEW, V, S, H, STOP, ARM, RESET, *LEASE), modes=(PLAIN,)),
    "latch": Part((NEW, V, H, STOP, DISARM, ARM, RESET, *LATE, RESTART, WRITE, FAULT)),
    "identity": Part((NEW, *IDENTITY, STOP, ARM, RESET), modes=(KEYS,)),
    "tokens": Part((NEW, *TOKENED, ARM), modes=(KEYS,)),
    "images": Part((NEW, *IMAGES[:2], V, *(_twist(VISION, age) for age in (2, 4, 5)), ARM), modes=(PLAIN,)),
}
"""The first has each event, for a few events from each state of a life. The others have fewer, and go deeper."""


@dataclass(frozen=True, slots=True)
class Found:
    """The result.

    Args:
        states: all of them, packed.
        all_of_them: True if no event leads to another state.
        depth: number of events, from a first state, whose orders were all explored.
        promise: that breaks; empty if none does.
        words: the events that lead there.
    """

    states: KeysView[bytes]
    all_of_them: bool
    depth: int
    promise: str
    words: tuple[str, ...]


class Explorer:
    """Expands packed states of one part."""

    def __init__(self, part: Part) -> None:
        self._part = part
        self._robot, self._promises = Robot(), Promises()
        first = next(self.roots(pack=False))
        self._packed = struct.Struct("<" + "".join("d" if isinstance(value, float) else "b" for value in first))
        self.size = self._packed.size

    def roots(self, *, pack: bool = True) -> Iterator[bytes]:
        """Yield the states after each kind of start."""
        for mode in self._part.modes:
            for stopped in (False, True):
                self._robot.start(mode, int(stopped))
                self._promises.begin(auto=mode == AUTO, stopped=stopped)
                state = self._robot.save() + self._promises.save()
                yield self._packed.pack(*state) if pack else state

    def expand(self, packed: bytes, only: Event | None = None) -> Iterator[tuple[int, bytes | str]]:
        """Yield each event's number with the state that it leads to, or with the promise that breaks."""
        robot, promises, pack = self._robot, self._promises, self._packed.pack
        state = self._packed.unpack(packed)
        robot_part, promised_part = state[:ROBOT_FIELDS], state[ROBOT_FIELDS:]
        robot.load(robot_part)
        promises.load(promised_part)
        for index, event in enumerate(self._part.events):
            if not event.possible(promises) or only not in (None, event):
                continue
            try:
                event.happen(robot, promises)
                promises.check(robot, ticked=event.ticks)
            except BrokenError as broken:
                yield index, str(broken)
                return
            after, promised = robot.save(), promises.save()
            # Most events have no effect in most states. Only another state needs to be replaced.
            if event.ticks or after != robot_part or promised != promised_part:
                yield index, pack(*after, *promised)
                robot.load(robot_part)
                promises.load(promised_part)


@cache
def _explorer(part: str) -> Explorer:
    return Explorer(PARTS[part])


def _expand_all(part: str, states: bytes) -> tuple[bytes, array.array, bytes, tuple[int, int, str] | None]:
    """Return the following states, their parents' places in `states`, their events, and the first violation."""
    following: dict[bytes, None] = {}
    explorer = _explorer(part)
    parents, events, size = array.array("L"), bytearray(), explorer.size
    for place in range(len(states) // size):
        for event, found in explorer.expand(states[place * size : (place + 1) * size]):
            if isinstance(found, str):
                return b"".join(following), parents, bytes(events), (place, event, found)
            if found not in following:
                following[found] = None
                parents.append(place)
                events.append(event)
    return b"".join(following), parents, bytes(events), None


class _Known:
    """The states found so far, each with the state and the event that led to it first."""

    def __init__(self, explorer: Explorer, part: Part) -> None:
        self._part, self._size = part, explorer.size
        self.states: dict[bytes, None] = {}
        self._parents, self._events = array.array("L"), bytearray()
        self.violation: tuple[int, int, str] | None = None
        for root in explorer.roots():
            self._add(root, len(self.states), 0)
        place, state = 0, next(iter(self.states))
        for event in part.life:
            [(number, found)] = explorer.expand(state, event)
            if isinstance(found, str):
                self.violation = place, number, found
                return
            self._add(found, place, number)
            state, place = found, len(self.states) - 1

    def _add(self, state: bytes, parent: int, event: int) -> None:
        self.states[state] = None
        self._parents.append(parent)
        self._events.append(event)

    def add_all(self, following: bytes, first: int, places: array.array, events: bytes) -> Iterator[bytes]:
        """Add the states that follow those from number `first` on, and yield the new ones."""
        size = self._size
        for nth, (place, event) in enumerate(zip(places, events, strict=True)):
            state = following[nth * size : (nth + 1) * size]
            if state not in self.states:
                self._add(state, first + place, event)
                yield state

    def words(self) -> tuple[str, ...]:
        """Return the events that lead to the violation."""
        if self.violation is None:
            return ()
        place, event, _ = self.violation
        words = [self._part.events[event].words]
        while self._parents[place] != place:
            words.append(self._part.events[self._events[place]].words)
            place = self._parents[place]
        return tuple(reversed(words))


def explore(part: str, most: int, jobs: int = 1) -> Found:
    """Explore a part until no new state comes, a promise breaks, or `most` states are found."""
    known = _Known(_explorer(part), PARTS[part])
    depth = begin = 0
    frontier = list(known.states)
    with ExitStack() as ending:
        expand_all = map
        if jobs > 1:
            pool = ProcessPoolExecutor(jobs, multiprocessing.get_context("fork"))
            ending.callback(pool.shutdown, cancel_futures=True)
            expand_all = pool.map
        while frontier and known.violation is None and len(known.states) < most:
            chunks = [frontier[start : start + _CHUNK] for start in range(0, len(frontier), _CHUNK)]
            following = []
            for number, (states, places, happened, violation) in enumerate(
                expand_all(partial(_expand_all, part), map(b"".join, chunks))
            ):
                first = begin + number * _CHUNK
                following += known.add_all(states, first, places, happened)
                if violation is not None:
                    place, event, promise = violation
                    known.violation = first + place, event, promise
                if known.violation is not None or len(known.states) >= most:
                    break
            else:
                depth += bool(following)
            begin += len(frontier)
            frontier = following
    promise = known.violation[2] if known.violation else ""
    return Found(known.states.keys(), not frontier and not promise, depth, promise, known.words())
