"""Breadth-first search through all states. The first violation found is one of the shortest."""

import array
import multiprocessing
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass

from sightline.protocol.messages import Holder, Verb
from tests.exploration.promises import Broken, Promises
from tests.exploration.robot import CONFIGS, DRIVERS, EARLIER, HUMAN, OPERATOR, ROBOT, ROBOT_FIELDS, SECOND, VISION, Image, Robot

_NAMES = {VISION: "vision", SECOND: "a second vision service", HUMAN: "teleop", OPERATOR: "an operator"}
_CHUNK = 500  # states that a process expands at once
_AUTO = tuple(config.safety.auto_arm for config in CONFIGS)


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
        return not (image is Image.LAST and promises.last < 0 or image is Image.PREVIOUS and promises.previous < 0)

    return Event(f"100 ms pass; {words}", happen, possible, ticks=True)


def _twist(who: Holder, age: int, words: str = "", *, fresh: bool = True, session: str = ROBOT, off_us: int = 0) -> Event:
    driver, real = DRIVERS.index(who), session == ROBOT and not off_us

    def happen(robot: Robot, promises: Promises) -> None:
        reason = robot.twist(who, age, int(fresh), session, off_us)
        promises.on_twist(driver, age, reason, fresh=fresh, real=real)

    def possible(promises: Promises) -> bool:
        return promises.images[age] >= 0 and (fresh or promises.seen[driver])

    what = words or f"on the frame of {age * 100} ms ago"
    return Event(f"{_NAMES[who]}: a command {what} arrives", happen, possible)


def _request(who: Holder, verb: Verb, age: int = 0) -> Event:
    def happen(robot: Robot, promises: Promises) -> None:
        reason = robot.request(who, verb, age)
        promises.on_request(who, verb, age, reason, robot.core.config.safety.auto_arm)

    def possible(promises: Promises) -> bool:
        return age <= promises.started or age > 20

    when = f" of {age * 100} ms ago" if age else ""
    return Event(f"{_NAMES[who]}: {verb}{when} arrives", happen, possible)


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
    _twist(VISION, 0, "on a frame that was never issued", off_us=1),
    _twist(VISION, 0, "on a frame of an earlier start", session=EARLIER),
)
STOP, DISARM, ARM, RESET = (_request(OPERATOR, verb) for verb in (Verb.STOP, Verb.DISARM, Verb.ARM, Verb.RESET))
LATE = (_request(OPERATOR, Verb.ARM, 2), _request(OPERATOR, Verb.RESET, 2), _request(OPERATOR, Verb.ARM, 21))
LEASE = tuple(_request(who, verb) for who in (HUMAN, VISION) for verb in (Verb.ACQUIRE, Verb.RELEASE))
RESTART = (
    Event("the driver process is killed and starts again", _restart),
    Event("the disk stores the latch", _write),
)
FAULT = Event("the drive fails", _fault)


@dataclass(frozen=True, slots=True)
class Part:
    """Events whose interleavings are explored together, in all orders and until no new state comes.

    Args:
        events: what may happen in each state.
        auto_arm: configurations to begin with.
    """

    events: tuple[Event, ...]
    auto_arm: tuple[bool, ...] = (False, True)


PARTS = {
    "loss": Part((NEW, _twist(VISION, 0), _twist(SECOND, 0), _twist(HUMAN, 0), ARM)),
    "lease": Part((
        NEW, _twist(VISION, 0), _twist(SECOND, 0), _twist(HUMAN, 0), STOP, ARM, RESET, *LEASE,
    ), auto_arm=(False,)),
    "latch": Part((
        NEW, _twist(VISION, 0), _twist(HUMAN, 0), STOP, DISARM, ARM, RESET, *LATE, *RESTART, FAULT,
    )),
    "images": Part((
        NEW, *IMAGES[:2], *(_twist(VISION, age) for age in (0, 2, 4, 5)), ARM,
    ), auto_arm=(False,)),
    "all": Part((
        NEW, *IMAGES, *(_twist(VISION, age) for age in (0, 2, 4, 5)), _twist(SECOND, 0), _twist(HUMAN, 0),
        _twist(HUMAN, 2), *FORGED, STOP, DISARM, ARM, RESET, *LATE, *LEASE, *RESTART, FAULT,
    )),
}


@dataclass(frozen=True, slots=True)
class Found:
    """The result: the number of states, whether these are all, and the first violation with the events before it."""

    states: int
    all_of_them: bool
    depth: int
    promise: str = ""
    words: tuple[str, ...] = ()


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
        for auto in self._part.auto_arm:
            for stopped in (False, True):
                self._robot.start(_AUTO.index(auto), int(stopped))
                self._promises.begin(auto=auto, stopped=stopped)
                state = self._robot.save() + self._promises.save()
                yield self._packed.pack(*state) if pack else state

    def expand(self, packed: bytes) -> Iterator[tuple[int, bytes | str]]:
        """Yield each event's number with the state that it leads to, or with the promise that breaks."""
        robot, promises, pack = self._robot, self._promises, self._packed.pack
        state = self._packed.unpack(packed)
        robot_part, promised_part = state[:ROBOT_FIELDS], state[ROBOT_FIELDS:]
        for index, event in enumerate(self._part.events):
            promises.load(promised_part)
            if not event.possible(promises):
                continue
            robot.load(robot_part)
            try:
                event.happen(robot, promises)
                promises.check(robot, ticked=event.ticks)
            except Broken as broken:
                yield index, str(broken)
            else:
                yield index, pack(*robot.save(), *promises.save())


_explorer: Explorer


def _begin(part: str) -> None:
    global _explorer
    _explorer = Explorer(PARTS[part])


def _expand_all(states: bytes) -> tuple[bytes, array.array, bytes, tuple[int, int, str] | None]:
    """Return the following states, their parents' places in `states`, their events, and the first violation."""
    following: dict[bytes, None] = {}
    parents, events, size = array.array("L"), bytearray(), _explorer.size
    for place in range(len(states) // size):
        for event, found in _explorer.expand(states[place * size : (place + 1) * size]):
            if isinstance(found, str):
                return b"".join(following), parents, bytes(events), (place, event, found)
            if found not in following:
                following[found] = None
                parents.append(place)
                events.append(event)
    return b"".join(following), parents, bytes(events), None


def explore(part: str, most: int, jobs: int = 1) -> Found:
    """Explore a part until no new state comes, a promise breaks, or about `most` states are found."""
    _begin(part)
    size, frontier = _explorer.size, list(_explorer.roots())
    known = set(frontier)
    parents, events = array.array("L", range(len(known))), bytearray(len(known))
    depth = begin = 0
    with ExitStack() as ending:
        if jobs > 1:
            spawn = multiprocessing.get_context("fork")
            pool = ending.enter_context(ProcessPoolExecutor(jobs, spawn, initializer=_begin, initargs=(part,)))
        while frontier and len(known) < most:
            chunks = [frontier[start : start + _CHUNK] for start in range(0, len(frontier), _CHUNK)]
            expanded = (pool.map if jobs > 1 else map)(_expand_all, map(b"".join, chunks))
            following = []
            for number, (states, places, happened, violation) in enumerate(expanded):
                first = begin + number * _CHUNK
                for nth, (place, event) in enumerate(zip(places, happened, strict=True)):
                    state = states[nth * size : (nth + 1) * size]
                    if state not in known:
                        known.add(state)
                        following.append(state)
                        parents.append(first + place)
                        events.append(event)
                if violation is not None:
                    place, event, promise = violation
                    words = _words(PARTS[part], parents, events, first + place, event)
                    return Found(len(known), False, depth + 1, promise, words)
            begin += len(frontier)
            frontier = following
            depth += bool(frontier)
    return Found(len(known), not frontier, depth)


def _words(part: Part, parents: array.array, events: bytearray, place: int, event: int) -> tuple[str, ...]:
    words = [part.events[event].words]
    while parents[place] != place:
        words.append(part.events[events[place]].words)
        place = parents[place]
    return tuple(reversed(words))
