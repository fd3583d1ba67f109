"""Rows: what a radio does to packets, through the wire between two network namespaces. Shell."""

from functools import partial
from typing import Final

from sightline.operator_side.faults.rig import RobotFixture, Setup
from sightline.evaluation.faults.runner import Case, Injected
from sightline.evaluation.faults.cases import drives_again
from sightline.protocol.clock import monotonic_us
from sightline.sim.network_emulator import LinkShape, LinkShapes

DISTURBED_S: Final = 6.0
CUT: Final = LinkShape(cut=True)
LOSSY: Final = LinkShape(loss=0.2)
FLAP_S: Final = 0.5
FLAPS: Final = 6


def shape(rig: RobotFixture, shapes: LinkShapes) -> int:
    """Put `shapes` in force; returns how many packets were harmed so far."""
    assert rig.wire is not None
    return rig.wire.shape(shapes)


def _cut(rig: RobotFixture, shapes: LinkShapes, seconds: float) -> Injected:
    """Cut for a while: nothing sent after the cut is obeyed until the wire is whole again."""
    before = shape(rig, shapes)
    at_us = monotonic_us()
    rig.watch(seconds)
    harmed, resumed_us = shape(rig, LinkShapes()) - before, monotonic_us()
    return Injected(harmed, at_us, resumed_us, drives_again(rig))


def _worsen(rig: RobotFixture, shapes: LinkShapes) -> Injected:
    """Bad for a while, but not cut: frames that are still young may be driven on."""
    before = shape(rig, shapes)
    at_us = monotonic_us()
    rig.watch(DISTURBED_S)
    return Injected(shape(rig, LinkShapes()) - before, at_us, again=drives_again(rig))


def _flap(rig: RobotFixture) -> Injected:
    before = shape(rig, LinkShapes())
    at_us = monotonic_us()
    for _ in range(FLAPS):
        shape(rig, LinkShapes(ab=CUT, ba=CUT))
        rig.watch(FLAP_S)
        harmed = shape(rig, LinkShapes()) - before
        rig.watch(FLAP_S)
    return Injected(harmed, at_us, again=drives_again(rig))


_WIRED: Final = Setup(wired=True)
_HEAVY: Final = Setup(wired=True, camera="heavy")
_SLOW: Final = LinkShape(delay_ms=300)
_MIXED: Final = LinkShape(delay_ms=10, jitter_ms=5, reorder=0.1, duplicate=0.1)
_THIN: Final = LinkShape(rate_bit_s=1e6)

NETWORK_CASES: Final = (
    Case("wire.cut3", "network: partition 3 s", partial(_cut, shapes=LinkShapes(ab=CUT, ba=CUT), seconds=3.0), _WIRED,
        blind=True, again=True, short=True),
    Case("wire.cut15", "network: partition 15 s", partial(_cut, shapes=LinkShapes(ab=CUT, ba=CUT), seconds=15.0), _WIRED,
        blind=True, again=True),
    Case("wire.no_frames", "network: one direction only, frames lost", partial(_cut, shapes=LinkShapes(ab=CUT), seconds=3.0),
        _WIRED, blind=True, by_frame=True, again=True),
    Case("wire.no_commands", "network: one direction only, commands lost",
        partial(_cut, shapes=LinkShapes(ba=CUT), seconds=3.0), _WIRED, blind=True, again=True),
    Case("wire.delay", "network: 300 ms each way", partial(_worsen, shapes=LinkShapes(ab=_SLOW, ba=_SLOW)), _WIRED,
        stops=False, again=True),
    Case("wire.loss", "network: 20 % loss each way", partial(_worsen, shapes=LinkShapes(ab=LOSSY, ba=LOSSY)), _WIRED,
        stops=False, again=True),
    Case("wire.mixed", "network: 10 % reordered, 10 % duplicated", partial(_worsen, shapes=LinkShapes(ab=_MIXED, ba=_MIXED)),
        _WIRED, stops=False, again=True),
    Case("wire.thin", "network: 1 Mbit/s under a camera of 4 Mbit/s",
        partial(_worsen, shapes=LinkShapes(ab=_THIN, ba=_THIN)), _HEAVY, stops=False, again=True),
    Case("wire.flaps", "network: gone and back every 0.5 s", _flap, _WIRED, stops=False, again=True),
)
