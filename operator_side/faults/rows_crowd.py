"""Rows: many who want to watch, some of them badly, while somebody drives; and how punctual the driver stays. Shell."""

import itertools
from collections.abc import Sequence
from functools import partial
from typing import Final

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.load_clients import ADMITTED, HANDSHAKES, READY, SEEN, VIEWERS
from sightline.evaluation.faults.evidence import MotorRow, wheel_mps
from sightline.operator_side.faults.ledger import INJECTED
from sightline.operator_side.faults.rig import READY_S, RobotFixture, Setup
from sightline.evaluation.faults.runner import Case, Injected
from sightline.evaluation.faults.cases import AGAIN_S, BUSY, SETTLED_S, busy_processes
from sightline.evaluation.faults.sampler import Hole
from sightline.protocol.clock import monotonic_us
from sightline.protocol.transports.websocket.server import MAX_CLIENTS
from sightline.robot_side.safety.limits import TICK_US

LOADED_S: Final = 6.0
KEPT_MPS: Final = 0.4
TICK_MS: Final = 40.0
STARVED_S: Final = 24.0
TICKS: Final = 1000
"""Fewer have no 99.9th percentile."""
HONEST_MS: Final = 10.0
"""The simulation stamps what it receives up to so much late while its own physics holds the interpreter."""


def _load(rig: RobotFixture, kind: str, at_least_times: int) -> Injected:
    """They come while the robot is driven and stay; then whoever drives dies."""
    came_us = monotonic_us()
    rig.start_crowd(kind)
    rig.fleet.wait_line("crowd", READY, READY_S)
    rig.watch(LOADED_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > came_us)
    times = len(rig.noted("crowd", INJECTED))
    at_us = monotonic_us()
    rig.fleet.kill("peer")
    rig.watch(SETTLED_S)
    checks = [at_least("came", times, "times", at_least_times), at_least("speed kept", slowest_mps, "m/s", KEPT_MPS)]
    if kind == "viewers":
        checks.append(at_least("admitted", len(rig.noted("crowd", ADMITTED)), "times", MAX_CLIENTS))
        checks.append(at_least("pictures seen", len(rig.noted("crowd", SEEN)), "", MAX_CLIENTS))
    return Injected(times, at_us, checks=tuple(checks))


# --- punctuality -------------------------------------------------------------------------------------------------


def _keep_time(rig: RobotFixture) -> Injected:
    """Drive beside busy processes for long enough to tell a 99.9th percentile; then the driving peer dies."""
    rig.start_peer("person", "operator", fault="lateness")
    rig.fleet.wait_line("person", "person ready", AGAIN_S)
    with busy_processes():
        since_us = monotonic_us()
        rig.watch(STARVED_S)
        rows = [row for row in rig.motors() if row.t_us > since_us]
        rig.trigger("person")
        rig.fleet.wait_line("person", "late by", AGAIN_S)
        at_us = monotonic_us()
        rig.fleet.kill("peer")
        rig.watch(SETTLED_S)
    said = rig.fleet.log("person").read_text("utf-8").rpartition("late by ")[2]
    return Injected(BUSY, at_us, checks=tuple(_tick_checks(rows, rig.holes(), int(said.split()[0]))))


def _tick_checks(rows: Sequence[MotorRow], holes: Sequence[Hole], published_us: int) -> list[Check]:
    gaps_us = undisturbed_gaps_us(rows, holes)
    ticks = sum(gaps_us) // TICK_US
    worst_ms = max(gaps_us, default=0) / 1000
    hidden_ms = max(0.0, worst_ms - TICK_US / 1000 - published_us / 1000)
    return [
        at_least("ticks", ticks, "", TICKS),
        at_most("tick p99.9", permille_us(gaps_us, ticks) / 1000, "ms", TICK_MS),
        at_least("published lateness", published_us / 1000, "ms", 0.0),
        at_most("unpublished lateness", hidden_ms, "ms", HONEST_MS),
    ]


def undisturbed_gaps_us(rows: Sequence[MotorRow], holes: Sequence[Hole]) -> list[int]:
    """Times between two motor commands, without those in which this machine itself stood still."""
    pairs = itertools.pairwise(row.t_us for row in rows)
    return [b - a for a, b in pairs if not any(hole.from_us < b and hole.to_us > a for hole in holes)]


def permille_us(gaps_us: Sequence[int], ticks: int) -> int:
    """The gap that one tick in a thousand exceeds. Commands that arrive make more, shorter gaps; they do not count."""
    return sorted(gaps_us, reverse=True)[ticks // 1000] if gaps_us else 0


_WEB: Final = Setup(web=True)
_DRIVEN: Final = f"speed stays >= {KEPT_MPS:g} m/s while they are there"

CLIENT_CASES: Final = (
    Case("crowd.viewers", f"drivers: {VIEWERS} WebSocket viewers, one never reading; then the driver dies",
        partial(_load, kind="viewers", at_least_times=VIEWERS), _WEB, also=_DRIVEN, alone=True),
    Case("crowd.handshakes", f"drivers: {HANDSHAKES} half-open handshakes; then the driver dies",
        partial(_load, kind="handshakes", at_least_times=HANDSHAKES), _WEB, also=_DRIVEN, alone=True),
    Case("driver.tick", "robot: four busy processes beside it for 24 s; then the driver dies", _keep_time, Setup(),
        also=f"p99.9 of ticks <= {TICK_MS:g} ms, lateness published", alone=True),
)
