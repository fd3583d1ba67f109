"""The peers that have mutants, honest or with one fault, and the cases that are run against them. Shell.

    with Stage() as stage:
        stage.results("robot", mutant, cases)     # None in place of a mutant: the honest peer

Most run in virtual time, those of JavaScript too; a `-socket` runs its own servers on loopback, in real time.
"""

import functools
import sys
import tempfile
from contextlib import ExitStack, nullcontext
from pathlib import Path

from sightline.conformance.benches import TO_ROBOT, VirtualBench
from sightline.conformance.codec import CASES as CODEC_CASES
from sightline.conformance.codec import END, codec_cases, run_codec
from sightline.conformance.robot import cases as robot_cases
from sightline.conformance.runner import Outcome, run_case
from sightline.conformance.vision import cases as vision_cases
from sightline.protocol.transports.memory import MemoryNetwork
from tests.conformance.mutants import sockets
from tests.conformance.mutants.javascript import JsPeers, changed_copy, virtual_js
from tests.conformance.mutants.operators import OF_SOURCE, Tap, change_function
from tests.conformance.mutants.table import Mutant, read_files
from tests.conformance.robot.broken import (  # noqa: F401  (they fill BROKEN)
    arming,
    credit,
    frames,
    lease,
    motion,
    order,
    requests,
    validation,
)
from tests.conformance.robot.broken.breaking import BROKEN as BROKEN_ROBOTS
from tests.conformance.robot.broken.websocket import DEFECTS
from tests.conformance.robot.reference import KEYED, virtual_robot
from tests.conformance.vision import (  # noqa: F401  (they fill BROKEN)
    broken_answers,
    broken_flow,
    broken_inputs,
    broken_steering,
)
from tests.conformance.vision.broken import BROKEN as BROKEN_VISIONS
from tests.conformance.vision.fixture import KEYS, VirtualVision
from tests.conformance.vision.sockets import SOCKETS
from tests.fixtures.javascript import EXAMPLES, ROOT, node

HAND_WRITTEN = "hand-written"
ADAPTERS = {"codec": "examples/codec_adapter.py", "javascript-codec": "codec_adapter.mjs"}


def _of(cases, real):
    return tuple(case for case in cases if case.real is real)


CASES = {
    "robot": _of(robot_cases.CASES, False),
    "vision": _of(vision_cases.CASES, False),
    "codec": CODEC_CASES,
    "javascript-robot": _of(robot_cases.CASES, False),
    "javascript-vision": _of(vision_cases.CASES, False),
    "javascript-codec": CODEC_CASES,
    "robot-socket": _of(robot_cases.CASES, True),
    "vision-socket": _of(vision_cases.CASES, True),
    "javascript-robot-socket": _of(robot_cases.CASES, True),
    "javascript-vision-socket": _of(vision_cases.CASES, True),
}
"""Peer -> the cases that are run against it."""
REAL_TIME = tuple(peer for peer in CASES if peer.endswith("-socket"))


@functools.cache
def table():
    """Return every mutant, those of the files and the hand-written, and one line for each bad row."""
    ids = {peer: {case.id for case in cases} | set(_vectors(cases)) for peer, cases in CASES.items()}
    mutants, problems = read_files(ids)
    mutants = [_with_ids(one) for one in mutants]
    return (*mutants, *hand_written()), tuple(problems)


def _vectors(cases):
    """Vector -> the id of its case: the numbers of a codec's cases move when a vector is added."""
    titles = ((case.title.split("`"), case.id) for case in cases if case.title.startswith("`vectors/"))
    return {parts[1][len("vectors/") :].removesuffix(".json"): number for parts, number in reversed([*titles])}


def _with_ids(mutant):
    known = _vectors(CASES[mutant.peer])
    return Mutant(**{**vars(mutant), "caught_by": tuple(known.get(one, one) for one in mutant.caught_by)})


def hand_written():
    """Yield the broken peers that are programs of their own: each fails exactly its cases."""
    exact = {"fault": HAND_WRITTEN, "operator": HAND_WRITTEN, "exact": True}
    for name, break_it in BROKEN_ROBOTS.items():
        yield Mutant(break_it.__name__.replace("_", " "), "robot", caught_by=(name, *break_it.also), **exact)
    for name, (wrong, _kind) in BROKEN_VISIONS.items():
        yield Mutant(wrong, "vision", caught_by=(name,), **exact)
    for name, defect in DEFECTS.items():
        yield Mutant(defect, "robot-socket", caught_by=(name,), **exact)
    for name, wrong in SOCKETS.items():
        yield Mutant(wrong, "vision-socket", caught_by=(name,), **exact)
    for name, cases in _codecs().items():
        yield Mutant(name, "codec", HAND_WRITTEN, HAND_WRITTEN, tuple(cases))


def _codecs():
    """Program of `codec_broken` -> its cases: each vector and each cut is answered wrongly by one of the two."""
    accepted, others = [], []
    for one in codec_cases():
        accepts = one.family == "write" or "ok" in next(one.questions()).expected
        (accepted if accepts else others).append(f"C-CODEC-{one.number}")
    return {"rejects_everything": accepted, "takes_everything": others, "stays": [END]}


class Stage:
    """Runs cases against peers. It starts Node once, and stores the changed copies of the modules."""

    def __enter__(self):
        self._ending = ExitStack()
        self._folder = Path(self._ending.enter_context(tempfile.TemporaryDirectory(prefix="sightline-mutants-")))
        self._node = None
        self._copies = {}
        return self

    def __exit__(self, *raised):
        self._ending.close()

    def results(self, peer, mutant, cases):
        """Run cases, each against a fresh peer. Raises OperatorError for a mutant that cannot be made."""
        run = {"codec": self._codec, "javascript-codec": self._codec}.get(peer, self._one_by_one)
        with self._changed(peer, mutant):
            return run(peer, mutant, cases)

    def _changed(self, peer, mutant):
        if mutant is None or mutant.operator not in OF_SOURCE or peer.startswith("javascript"):
            return nullcontext()
        return change_function(**mutant.parameters)

    def _one_by_one(self, peer, mutant, cases):
        return [self._result(peer, mutant, case) for case in cases]

    def _result(self, peer, mutant, case):
        if peer in REAL_TIME:
            with self._on_sockets(peer, mutant) as (bench, prepare):
                return run_case(case, bench, prepare)
        bench, prepare = self._virtual(peer, mutant, case)
        return run_case(case, bench, prepare)

    def _virtual(self, peer, mutant, case):
        side = peer.removeprefix("javascript-")
        written = mutant if mutant is not None and mutant.operator == HAND_WRITTEN else None
        if peer == "vision":
            kind = BROKEN_VISIONS[written.caught_by[0]][1] if written else VirtualVision
            network = MemoryNetwork()
            one = kind(network)
            bench = VirtualBench(network, [one], TO_ROBOT, access=KEYS)
        elif peer == "robot":
            break_it = BROKEN_ROBOTS[written.caught_by[0]] if written else None
            bench, one = virtual_robot(break_it, keys=case.id in KEYED)
        else:
            bench, one = virtual_js(self._javascript(), side, self._modules(mutant))
        if mutant is not None and mutant.message:
            Tap(one, mutant.operator, mutant.message, mutant.when, mutant.parameters)
        return bench, (vision_cases if side == "vision" else robot_cases).prepare

    def _on_sockets(self, peer, mutant):
        if peer == "robot-socket":
            return sockets.small_server(mutant.name if mutant else "")
        if peer == "vision-socket":
            return sockets.played_robot(
                functools.partial(sockets.plain_vision, broken=mutant.caught_by[0] if mutant else "")
            )
        folder = self._modules(mutant)
        if peer == "javascript-robot-socket":
            return sockets.javascript_robot(folder)
        return sockets.played_robot(functools.partial(sockets.javascript_vision, folder=folder))

    def _codec(self, peer, mutant, cases):
        if peer == "javascript-codec":
            return run_codec([node(), str(self._modules(mutant) / ADAPTERS[peer])], cases)
        broken = ["-m", "tests.conformance.codec_broken", mutant.name] if mutant else [str(ROOT / ADAPTERS[peer])]
        return run_codec([sys.executable, *broken], cases)

    def _javascript(self):
        self._node = self._node or self._ending.enter_context(JsPeers())
        return self._node

    def _modules(self, mutant):
        """Return the folder of the JavaScript modules; for a mutant of the source, a copy with its change."""
        if mutant is None or mutant.operator not in OF_SOURCE:
            return EXAMPLES
        if mutant not in self._copies.values():
            folder = self._folder / str(len(self._copies))
            self._copies[folder] = mutant
            changed_copy(folder, *mutant.parameters.values())
        return next(folder for folder, one in self._copies.items() if one == mutant)


def failed(results):
    """Case -> reason, of those that failed."""
    return {one.case.id: one.reason for one in results if one.outcome is Outcome.FAILED}
