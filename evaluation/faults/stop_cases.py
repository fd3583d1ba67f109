"""Rows: a new operator sends STOP while a flood occupies the ports of the robot or of its router. Shell."""

import resource
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Final

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.evidence import INJECTED, MEMORY_MB, REQUESTED, ZERO_MS, measure_stop, wheel_mps
from sightline.evaluation.faults.fixture import RobotFixture, Setup
from sightline.evaluation.faults.load_clients import FEW_HZ, HALF_OPEN, MANY_HZ, READY, SESSIONS, STOPS
from sightline.evaluation.faults.runner import FaultCase, Injected
from sightline.evaluation.processes import children_of
from sightline.protocol.clock import monotonic_us

AT_WORK_S: Final = 3.0
AFTER_S: Final = (2.0, 20.0, 80.0)
"""Times after the end of a flood at which STOP must work, too. The first one is in the short set."""
STOP_ENDS_S: Final = 20.0
READY_S: Final = 30.0
KEPT_MPS: Final = 0.4


def _new_operator(rig: RobotFixture) -> tuple[int, tuple[Check, ...]]:
    """Send STOP by a new operator. Returns the time of its first packet, and the checks of the stop."""
    rig.trigger("operator")
    code = rig.processes.exit_code("operator", STOP_ENDS_S)
    at_us = rig.noted("operator", REQUESTED)[0].t_us
    rig.watch(0.2)
    zero_ms = measure_stop(rig.motors(), at_us).zero_ms
    return at_us, (
        at_most("zero after the first packet", zero_ms, "ms", ZERO_MS), at_most("exit code of stop", code, "", 0)
    )


def _prepare_operator(rig: RobotFixture, **changes: object) -> None:
    rig.start_peer("operator", "stop", **changes)
    rig.processes.wait_line("operator", "stop ready", READY_S)


def _flood(rig: RobotFixture, kind: str, after_s: float | None = None) -> Injected:
    """Send STOP during a flood, or some time after its end."""
    _prepare_operator(rig)
    rig.start_crowd(kind, rig.endpoint)
    rig.processes.wait_line("crowd", READY, READY_S)
    rig.watch(AT_WORK_S)
    if after_s is not None:
        rig.processes.kill("crowd")
        rig.watch(after_s)
    count = len(rig.noted("crowd", INJECTED))
    at_us, checks = _new_operator(rig)
    return Injected(count, at_us, checks=checks)


def _garbage(rig: RobotFixture) -> Injected:
    """Invalid datagrams for 10 s have no effect; a valid one among them stops the robot."""
    _prepare_operator(rig)
    came_us = monotonic_us()
    rig.start_crowd("garbage", rig.endpoint)
    rig.processes.wait_line("crowd", READY, READY_S)
    rig.watch(AT_WORK_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > came_us)
    at_us, checks = _new_operator(rig)
    rig.processes.wait_line("crowd", "datagrams a second", READY_S)
    rate_hz = float(rig.processes.log("crowd").read_text("utf-8").rpartition(READY)[2].split()[0])
    counted = "rejected MALFORMED" in rig.processes.log("robot").read_text("utf-8")
    return Injected(1, at_us, checks=(
        *checks, at_least("speed kept before it", slowest_mps, "m/s", KEPT_MPS), at_least("sent", rate_hz, "1/s", 1000),
        at_least("logged", counted, "", 1),
    ))


def _replay(rig: RobotFixture) -> Injected:
    """Record the datagrams of a STOP, start the robot again without the latch, and replay them."""
    _prepare_operator(rig, recording=rig.folder / STOPS)
    rig.trigger("operator")
    rig.processes.exit_code("operator", STOP_ENDS_S)
    rig.processes.end_one("robot")
    (rig.folder / "state" / "r1.stopped").unlink()  # in place of an operator that resets and arms
    rig.start_robot()
    rig.wait_speed(rig.setup.at_speed_mps)
    since_us = monotonic_us()
    rig.start_crowd("replayed", rig.endpoint)
    rig.processes.wait_line("crowd", READY, READY_S)
    rig.watch(AT_WORK_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > since_us)
    counted = "rejected OTHER_SESSION" in rig.processes.log("robot").read_text("utf-8")
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(1.5)
    checks = at_least("speed kept", slowest_mps, "m/s", KEPT_MPS), at_least("logged", counted, "", 1)
    return Injected(len(rig.noted("crowd", INJECTED)), at_us, checks=checks)


BUSY: Final = 8


def _busy(rig: RobotFixture) -> Injected:
    """Send STOP while more processes than processors want all of them."""
    _prepare_operator(rig)
    busy = [subprocess.Popen([sys.executable, "-P", "-c", "while True: pass"]) for _ in range(BUSY)]
    try:
        rig.watch(AT_WORK_S)
        at_us, checks = _new_operator(rig)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    return Injected(BUSY, at_us, checks=checks)


def _no_descriptors(rig: RobotFixture) -> Injected:
    """Send STOP while no process of the robot may open a file or a socket."""
    _prepare_operator(rig)
    driver = rig.processes.pid("robot")
    for pid in (driver, *children_of(driver)):
        held = max(int(link.name) for link in Path(f"/proc/{pid}/fd").iterdir()) + 1
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (held, held))
    # At once: the camera of the bench opens a file for each image, so that the robot would soon stop by itself.
    at_us, checks = _new_operator(rig)
    return Injected(1, at_us, checks=checks)


_FLOODS: Final = {
    "tls25": ("connect_25", f"{FEW_HZ} connections a second without keys", True),
    "tls_half": ("half_open", f"{HALF_OPEN} half-open connections without keys", True),
    "tcp500": ("connect_500", f"{MANY_HZ} connections a second", False),
    "tcp_half": ("half_open", f"{HALF_OPEN} half-open connections", False),
    "sessions": ("sessions", f"{SESSIONS} more sessions", False),
}
HALF_OPEN_MB: Final = 16.0
"""Zenoh holds about 10 kB for each TLS connection that it has accepted; the descriptors of the process bound them."""
_DEMANDED: Final = f"zero <= {ZERO_MS:g} ms after the first packet; exit code 0"


def _flood_case(name: str, *, routed: bool = False, after_s: float | None = None) -> FaultCase:
    kind, what, secured = _FLOODS[name]
    where = ", behind a router" if routed else ""
    when = "" if after_s is None else f", {after_s:g} s after it"
    ending = ("_router" if routed else "") + ("" if after_s is None else f"_after{after_s:g}")
    return FaultCase(
        f"flood.{name}{ending}", f"flood: {what}{where}; STOP by a new operator{when}",
        partial(_flood, kind=kind, after_s=after_s), Setup(secure=secured, routed=routed), blind=True,
        memory_mb=HALF_OPEN_MB if kind == "half_open" else MEMORY_MB,
        also=_DEMANDED + (f"; memory <= {HALF_OPEN_MB:g} MB" if kind == "half_open" else ""),
        short=ending == "" and name in ("tls25", "tcp500"), alone=True,
    )


STOP_CASES: Final = (
    *(_flood_case(name, routed=routed) for routed in (False, True) for name in _FLOODS),
    *(_flood_case("tls_half", after_s=after_s) for after_s in AFTER_S),
    FaultCase("stop.busy", f"STOP by a new operator: {BUSY} busy processes beside it", _busy, Setup(), blind=True,
              also=_DEMANDED, alone=True),
    FaultCase("stop.no_descriptors", "STOP by a new operator: the robot has no file descriptor left", _no_descriptors,
              Setup(), blind=True, also=_DEMANDED),
    FaultCase("stop.publisher", "STOP by a new operator: twists at 10 kHz and of 1 MB, with malformed attachments",
              partial(_flood, kind="publisher"), Setup(), blind=True, also=_DEMANDED, alone=True),
    FaultCase(
        "stop.garbage", "STOP port: datagrams of 0 to 2000 bytes and for another robot, as fast as possible; then STOP",
        _garbage, Setup(), blind=True, also=f"no effect but a count; {_DEMANDED}", alone=True,
    ),
    FaultCase(
        "stop.replayed", "STOP port: the datagrams of an earlier start, replayed (secured); then vision: SIGKILL",
        _replay, Setup(secure=True), also="ignored and counted; speed kept",
    ),
)
