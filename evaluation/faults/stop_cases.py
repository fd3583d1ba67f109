"""Rows: a new operator sends STOP while a flood occupies the ports of the robot or of its router. Shell."""

import resource
import signal
import subprocess
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Final

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.devices import MODE
from sightline.evaluation.faults.evidence import INJECTED, MEMORY_MB, ZERO_MS, SentCommand, measure_stop, wheel_mps
from sightline.evaluation.faults.fixture import (
    KEPT_MPS,
    ROBOT,
    STOP_ENDS_S,
    RobotFixture,
    Setup,
    busy_processes,
    moving_stop,
)
from sightline.evaluation.faults.load_clients import (
    ANSWERED,
    FEW_HZ,
    HALF_OPEN,
    MANY_HZ,
    PUBLISHED_EACH,
    PUBLISHED_HZ,
    READY,
    SESSIONS,
    STOPS,
)
from sightline.evaluation.faults.peer import LEGACY_LIBRARIES
from sightline.evaluation.faults.runner import FaultCase, Injected
from sightline.evaluation.processes import SIGHTLINE, children_of
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import LinkError
from sightline.robot_side.safety.limits import SafetyConfig

AT_WORK_S: Final = 3.0
AFTER_S: Final = (2.0, 20.0, 80.0)
"""Times after the end of a flood at which STOP must work, too."""
READY_S: Final = 30.0
_HALF_OPEN: Final = ("half_open", "handshake")
_REPORTED: Final = ("connect_25", *_HALF_OPEN)
"""Floods that exceed the limits of one address. The others stay below, in number and in rate. Connections to plain TCP
that end within a millisecond leave nothing to count, so `connect_500` is reported on WebSocket only."""


def _flood(rig: RobotFixture, kind: str, after_s: float | None = None) -> Injected:
    """Send STOP during a flood, or some time after it."""
    rig.prepare_operator()
    rig.start_load(kind, rig.web_endpoint or rig.endpoint)
    rig.processes.wait_line("crowd", READY, READY_S)
    rig.watch(AT_WORK_S)
    if after_s is not None:
        rig.processes.kill("crowd")
        rig.watch(after_s)
    count = len(rig.noted("crowd", INJECTED))
    at_us, checks = rig.stop_by_operator(moving=True)
    return Injected(count, at_us, checks=(
        *checks, at_least("came", count, "times", _CAME.get(kind, 1)), *_load_checks(rig, kind)))


_CAME: Final = {
    "connect_25": 0.8 * FEW_HZ * AT_WORK_S, "connect_500": 0.8 * MANY_HZ * AT_WORK_S, "sessions": SESSIONS,
    **dict.fromkeys(_HALF_OPEN, HALF_OPEN),
}
"""Connections or sessions within `AT_WORK_S`. A machine that is too busy for them cannot run the row."""
PUBLISHED_LEAST_HZ: Final = 0.9 * PUBLISHED_HZ


def _load_checks(rig: RobotFixture, kind: str) -> Iterator[Check]:
    """Check that the flood was as strong as its row states, and that the log has one line about it."""
    if kind == "publisher":
        yield at_least("published", _rate_hz(rig.noted("crowd", INJECTED)), "1/s", PUBLISHED_LEAST_HZ)
    if kind == "handshake":
        yield at_least("handshakes answered", len(rig.noted("crowd", ANSWERED)), "", 1)
    if kind in _REPORTED or (kind == "connect_500" and rig.web_endpoint):
        log = rig.processes.log("router" if rig.setup.routed else "robot").read_text("utf-8")
        yield at_least("reported", "connections from" in log, "", 1)
        yield at_most("lines of the flood", log.count("connections from"), "", 1)


def _rate_hz(noted: Sequence[SentCommand]) -> float:
    """Return the rate that the publisher reached from its first to its last event."""
    return (len(noted) - 1) * PUBLISHED_EACH / (noted[-1].t_us - noted[0].t_us) * 1e6 if len(noted) > 1 else 0.0


def _garbage(rig: RobotFixture) -> Injected:
    """Send invalid datagrams for 10 s without effect. A valid one among them stops the robot."""
    rig.prepare_operator()
    came_us = monotonic_us()
    rig.start_load("garbage", rig.endpoint)
    rig.processes.wait_line("crowd", READY, READY_S)
    rig.watch(AT_WORK_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > came_us)
    at_us, checks = rig.stop_by_operator(moving=True)
    rig.processes.wait_line("crowd", "datagrams a second", READY_S)
    rate_hz = float(rig.processes.log("crowd").read_text("utf-8").rpartition(READY)[2].split()[0])
    log = rig.processes.log("router" if rig.setup.routed else "robot").read_text("utf-8")
    counted = sum(reason in log for reason in ("MALFORMED", "OTHER_ROBOT", "WRONG_KEY"))
    return Injected(1, at_us, checks=(
        *checks, at_least("speed kept before it", slowest_mps, "m/s", KEPT_MPS), at_least("sent", rate_hz, "1/s", 1000),
        at_least("reasons logged", counted, "", 3),
    ), from_us=came_us)


def _replay(rig: RobotFixture) -> Injected:
    """Record the datagrams of a STOP, start the robot again without the latch, and replay them."""
    rig.prepare_operator(recording=rig.folder / STOPS)
    rig.trigger("operator")
    rig.processes.exit_code("operator", STOP_ENDS_S)
    rig.processes.end_one("robot")
    (rig.folder / "state" / "r1.stopped").unlink()  # in place of an operator's reset and arm
    rig.start_robot()
    rig.wait_speed(rig.setup.at_speed_mps)
    since_us = monotonic_us()
    rig.start_load("replayed", rig.endpoint)
    rig.processes.wait_line("crowd", READY, READY_S)
    rig.watch(AT_WORK_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > since_us)
    log = rig.processes.log("robot").read_text("utf-8")
    counted = sum(reason in log for reason in ("OTHER_SESSION", "OTHER_ROBOT"))
    (rig.folder / "operator.events").unlink()
    rig.prepare_operator()
    at_us, checks = rig.stop_by_operator(moving=True)
    checks += at_least("speed kept", slowest_mps, "m/s", KEPT_MPS), at_least("reasons logged", counted, "", 2)
    return Injected(len(rig.noted("crowd", INJECTED)), at_us, checks=checks, from_us=since_us)


TYPED_FALLS_MS: Final = 200.0
TYPED_ZERO_MS: Final = {0.5: 550.0, 0.2: 350.0}
"""Time from the start of the command until the wheels stand, for each speed before it. The ramp takes most of it."""
TYPED_CPU_S: Final = 0.2


def _typed(rig: RobotFixture) -> Injected:
    """Run `sightline stop`, and count from the start of its process, as from the Enter key."""
    before, at_us = resource.getrusage(resource.RUSAGE_CHILDREN), monotonic_us()
    code = subprocess.run(
        [*SIGHTLINE, "stop", ROBOT, "--connect", rig.endpoint],
        check=False, capture_output=True, timeout=STOP_ENDS_S,
    ).returncode
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    rig.watch(ZERO_MS / 1000)
    falls_ms = measure_stop(rig.motors(), at_us).falls_ms
    return Injected(1, at_us, checks=(
        *moving_stop(rig.motors(), at_us, rig.setup.at_speed_mps, "the start of the command",
                     TYPED_ZERO_MS[rig.setup.linear_mps]),
        at_most("speed falls after the start of the command", falls_ms, "ms", TYPED_FALLS_MS),
        at_most("CPU time of the command", cpu_s, "s", TYPED_CPU_S), at_most("exit code of stop", code, "", 0),
    ))


BUSY: Final = 8


def _busy(rig: RobotFixture) -> Injected:
    """Send STOP while more processes than processors are busy."""
    rig.prepare_operator()
    with busy_processes(BUSY):
        rig.watch(AT_WORK_S)
        at_us, checks = rig.stop_by_operator(moving=True)
    return Injected(BUSY, at_us, checks=checks)


def _no_descriptors(rig: RobotFixture) -> Injected:
    """Send STOP while no process of the robot can open a file or a socket."""
    rig.prepare_operator()
    (rig.folder / MODE).unlink()  # otherwise the camera of the bench would open a file for each image
    guardian = rig.processes.pid("robot")
    for pid in (guardian, *children_of(guardian), *children_of(rig.processes.driver("robot"))):
        held = max(int(link.name) for link in Path(f"/proc/{pid}/fd").iterdir()) + 1
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (held, held))
    rig.watch(ZERO_MS / 1000)  # a robot that lost its images would stand by now
    at_us, checks = rig.stop_by_operator(moving=True)
    return Injected(1, at_us, checks=checks)


_GUEST: Final = SafetyConfig()
_BRAKING_M, _BRAKING_MS = 0.05, 700.0
"""A guest brakes from 0.2 m/s, slower than the speed for which the bounds of a stop hold."""


def _repeat_as_guest(rig: RobotFixture, name: str) -> tuple[Check, ...]:
    """Let a guest repeat its command on one image for longer than permitted. Then it dies."""
    at_us = rig.trigger(name)
    rig.watch(_GUEST.guest_unchanged_ms / 1000 + 2.0)
    stop = measure_stop(rig.motors(), at_us)
    rig.processes.kill(name)
    return (
        at_most(f"zero on one image ({name})", stop.zero_ms, "ms", _GUEST.guest_unchanged_ms + _BRAKING_MS),
        at_most(f"distance on one image ({name})", stop.distance_m, "m", _GUEST.guest_unchanged_m + _BRAKING_M),
    )


def _guests(rig: RobotFixture) -> Injected:
    """Let guests answer one image for seconds: one drives ahead, one turns. STOP arrives while the next one drives."""
    checks = list(_repeat_as_guest(rig, "peer"))
    rig.start_peer("turning", "guest", linear_mps=0.0, angular_rad_s=1.0)
    rig.wait_speed(_TURNING_MPS)
    checks += _repeat_as_guest(rig, "turning")
    count = rig.injected("peer") + rig.injected("turning")
    rig.prepare_operator()
    rig.start_peer("third", "guest", linear_mps=0.2, angular_rad_s=0.0)
    rig.wait_speed(rig.setup.at_speed_mps)
    at_us, stopped = rig.stop_by_operator(moving=True)
    rig.watch(AT_WORK_S)
    return Injected(count, at_us, checks=(*checks, *stopped))


def _end_vision(rig: RobotFixture) -> Injected:
    """Press Ctrl-C at the vision service of a legacy robot."""
    at_us = monotonic_us()
    rig.processes.signal("vision", signal.SIGINT)
    code = rig.processes.exit_code("vision", STOP_ENDS_S)
    rig.watch(1.0)
    return Injected(1, at_us, checks=(at_most("exit code of vision", code, "", 0),))


DISARM_ZERO_MS: Final = 1000.0
"""`disarm` starts first; the zero command follows immediately."""


def _disarm_legacy(rig: RobotFixture) -> Injected:
    """Disarm a legacy robot, and then send STOP."""
    rig.prepare_operator()
    began_us = monotonic_us()
    rig.processes.start("disarm", ["disarm", "--connect", rig.endpoint])
    code, at_us = rig.processes.exit_code("disarm", STOP_ENDS_S), monotonic_us()
    rig.watch(0.5)
    rows = rig.motors()
    _, stopped = rig.stop_by_operator(moving=False)
    return Injected(1, at_us, checks=(
        at_most("exit code of disarm", code, "", 0), at_most("speed after disarm", wheel_mps(rows[-1]), "m/s", 0.0),
        *moving_stop(rows, began_us, rig.setup.kept_mps, "the start of disarm", DISARM_ZERO_MS), *stopped,
    ), from_us=began_us)


def _stop_legacy(rig: RobotFixture) -> Injected:
    """Send STOP to a legacy robot."""
    rig.prepare_operator()
    at_us, stopped = rig.stop_by_operator(moving=True)
    return Injected(1, at_us, checks=stopped)


CUT_ITS_POWER: Final = "cut its power by hand"


def _stop_offline(rig: RobotFixture) -> Injected:
    """Run `sightline stop` while the legacy robot applies nothing, as without Wi-Fi. It cannot stop, and no line may
    claim that it did.
    """
    began_us = monotonic_us()
    rig.processes.signal("robot", signal.SIGSTOP)
    rig.processes.start("stop", ["stop", ROBOT, "--connect", rig.endpoint])
    code = rig.processes.exit_code("stop", STOP_ENDS_S)
    printed = rig.processes.log("stop").read_text("utf-8")
    # Until here it keeps its speed. No general rule may count that, whenever its last command reached the motors.
    return Injected(1, monotonic_us(), checks=(
        at_least("speed that the robot keeps", wheel_mps(rig.motors()[-1]), "m/s", rig.setup.kept_mps),
        at_least(f"exit code {LinkError.exit_code}", code == LinkError.exit_code, "", 1),
        at_least("line to cut its power", CUT_ITS_POWER in printed, "", 1),
        at_most("line that it stopped", "stopped" in printed.lower(), "", 0),
    ), from_us=began_us)


_FORMATS: Final = {
    "bar": "", "dashed": "?dashed", "swapped": "?dashed&swapped", "nonnegative": "?dashed&nonnegative",
    "boxes": "?boxes",
}
_LEGACY: Final = (
    ("ctrl_c", "Ctrl-C at vision", _end_vision, "exit code 0"),
    ("disarm", "disarm; then STOP", _disarm_legacy,
     f"zero <= {DISARM_ZERO_MS:g} ms after the start of disarm; exit codes 0"),
    ("stop", "STOP by a new operator", _stop_legacy, "exit code 0"),
)
LEGACY_CASES: Final = (
    *(
        FaultCase(f"legacy.{action}_{form}", f"legacy robot ({library}), texts {form}: {what}", inject,
                  Setup("vision", library, legacy=query), blind=True, stops=action != "disarm", also=demanded,
                  alone=action == "disarm")
        for row, (action, what, inject, demanded) in enumerate(_LEGACY)
        for column, (form, query) in enumerate(_FORMATS.items())
        for library in [tuple(LEGACY_LIBRARIES)[(row + column) % len(LEGACY_LIBRARIES)]]
    ),
    FaultCase("legacy.stop_offline", "legacy robot out of reach: the command `sightline stop`", _stop_offline,
              Setup("vision", "SimpleWebSocketServer", legacy=""), blind=True, stops=False,
              also=f"exit code {LinkError.exit_code}, the line \"{CUT_ITS_POWER}\", never \"stopped\""),
)


_TURNING_MPS: Final = 0.07
"""Speed of the wheels at 1 rad/s."""
_FLOODS: Final = {
    "tls25": ("connect_25", f"{FEW_HZ} connections a second without keys", True),
    "tls_half": ("half_open", f"{HALF_OPEN} half-open connections without keys", True),
    "tls_hello": ("handshake", f"{HALF_OPEN} TLS handshakes that stall after their first message, without keys", True),
    "tcp500": ("connect_500", f"{MANY_HZ} connections a second", False),
    "tcp_half": ("half_open", f"{HALF_OPEN} half-open connections", False),
    "sessions": ("sessions", f"{SESSIONS} more sessions", False),
    "web500": ("connect_500", f"{MANY_HZ} WebSocket connections a second", False),
}
HALF_OPEN_MB: Final = 16.0
"""Zenoh holds about 10 kB for each accepted TLS connection; the descriptors of the process bound them."""
_DEMANDED: Final = f"zero <= {ZERO_MS:g} ms after the first packet; exit code 0"


def _flood_case(name: str, *, routed: bool = False, after_s: float | None = None) -> FaultCase:
    kind, what, secured = _FLOODS[name]
    where = ", behind a router" if routed else ""
    when = "" if after_s is None else f", {after_s:g} s after it"
    ending = ("_router" if routed else "") + ("" if after_s is None else f"_after{after_s:g}")
    return FaultCase(
        f"flood.{name}{ending}", f"flood: {what}{where}; STOP by a new operator{when}",
        partial(_flood, kind=kind, after_s=after_s), Setup(secure=secured, routed=routed, web=name == "web500"),
        blind=True, memory_mb=HALF_OPEN_MB if kind in _HALF_OPEN else MEMORY_MB,
        also=_DEMANDED + (f"; memory <= {HALF_OPEN_MB:g} MB" if kind in _HALF_OPEN else ""),
        short=ending == "" and name in ("tls25", "tcp500"), alone=True,
    )


STOP_CASES: Final = (
    *(_flood_case(name, routed=routed, after_s=after_s) for after_s in (None, *AFTER_S) for routed in (False, True)
      for name in _FLOODS if not (routed and name == "web500")),
    FaultCase("guest.one_image", "guests: one command on one image for 4 s, ahead and turning; then STOP", _guests,
              Setup("guest", guests=True), blind=True, also=f"zero <= {_GUEST.guest_unchanged_ms / 1000:g} s and "
              f"{_GUEST.guest_unchanged_m:g} m, plus braking; {_DEMANDED}"),
    *LEGACY_CASES,
    *(
        FaultCase(f"stop.typed{ending}", f"STOP: the command `sightline stop` at {linear_mps:g} m/s, counted from its "
                  "start", _typed, Setup(linear_mps=linear_mps), blind=True, alone=True,
                  also=f"falls <= {TYPED_FALLS_MS:g} ms and zero <= {TYPED_ZERO_MS[linear_mps]:g} ms after its start; "
                  f"CPU time <= {TYPED_CPU_S:g} s")
        for ending, linear_mps in (("", 0.5), ("_slow", 0.2))
    ),
    FaultCase("stop.busy", f"STOP by a new operator: {BUSY} busy processes beside it", _busy, Setup(), blind=True,
              also=_DEMANDED, alone=True),
    FaultCase("stop.no_descriptors", "STOP by a new operator: the robot has no file descriptor left", _no_descriptors,
              Setup(), blind=True, also=_DEMANDED),
    FaultCase("stop.publisher", "STOP by a new operator: twists at 10 kHz and of 1 MB, with malformed attachments",
              partial(_flood, kind="publisher"), Setup(), blind=True, alone=True,
              also=f"at least {PUBLISHED_LEAST_HZ:g} twists a second; {_DEMANDED}"),
    *(
        FaultCase(
            f"stop.garbage{ending}", f"STOP port{where}: datagrams of 0 to 2000 bytes, for another robot and with a "
            "wrong HMAC, as fast as possible for 10 s (secured); then STOP", _garbage,
            Setup(secure=True, routed=bool(ending)), blind=True, also=f"no effect but a count; {_DEMANDED}", alone=True,
        )
        for ending, where in (("", ""), ("_router", " of a router"))
    ),
    FaultCase(
        "stop.replayed", "STOP port: datagrams of an earlier start and of another robot, replayed (secured); then STOP",
        _replay, Setup(secure=True), blind=True, also=f"ignored and counted; speed kept; {_DEMANDED}",
    ),
)
