"""Every case of the fault bench: processes, network, commands, clients, operators. Shell."""

import itertools
import os
import resource
import signal
import socket
import time
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Final

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.devices import DRIVE_ERROR, LOOP
from sightline.evaluation.faults.drivers import ATTACKED_S, COMMAND_CASES, SETTLED_S, VISION
from sightline.evaluation.faults.evidence import INJECTED, REQUESTED, MotorRow, wheel_mps
from sightline.evaluation.faults.fixture import AT_SPEED_S, KEPT_MPS, ROBOT, RobotFixture, Setup, busy_processes
from sightline.evaluation.faults.load_clients import ADMITTED, HANDSHAKES, READY, SEEN, VIEWERS
from sightline.evaluation.faults.runner import FaultCase, Injected
from sightline.evaluation.faults.sampler import Hole
from sightline.evaluation.faults.stop_cases import STOP_CASES
from sightline.evaluation.processes import children_of, is_running
from sightline.operator_side.config.errors import no_such_name
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.websocket.server import MAX_CLIENTS
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.robot_side.safety.limits import TICK_US
from sightline.sim.network_emulator import LinkShape, LinkShapes
from sightline.vision_side.config import TrackConfig

STOPPED_S: Final = 3.0
AGAIN_MPS: Final = 0.2
BETWEEN_S: Final = 0.05
AGAIN_S: Final = 20.0
LEFT_OVER_US: Final = 500_000
"""Time in which a driver may still answer old frames after the network process died. A new process takes longer."""
BUSY: Final = 4
FREE_MS: Final = 2000.0


def drives_again(rig: RobotFixture) -> bool:
    """Wait until the robot drives again, and a little longer."""
    rig.wait_speed(AGAIN_MPS, AGAIN_S)
    rig.watch(0.5)
    return True


def _kill_vision(rig: RobotFixture) -> Injected:
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(SETTLED_S)
    return Injected(1, at_us)


def _pause_vision(rig: RobotFixture) -> Injected:
    at_us = monotonic_us()
    rig.processes.signal("peer", signal.SIGSTOP)
    rig.watch(STOPPED_S)
    resumed_us = monotonic_us()
    rig.processes.signal("peer", signal.SIGCONT)
    return Injected(1, at_us, resumed_us, drives_again(rig))


def _spoil_detector(rig: RobotFixture, seconds: float = SETTLED_S) -> Injected:
    at_us = rig.trigger()
    rig.watch(seconds)
    return Injected(rig.injected(), at_us)


def _restart_vision(rig: RobotFixture) -> Injected:
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(SETTLED_S)
    resumed_us = monotonic_us()
    rig.start_peer("second", "vision")
    return Injected(1, at_us, resumed_us, drives_again(rig))


def _hurt(rig: RobotFixture, part: str, number: signal.Signals) -> Injected:
    """Send the network or driver process a signal that ends or stops it. Its parent starts a new one.

    The new network process sends frames immediately, so the robot may drive from the first command on.
    """
    pid = partial(getattr(rig.processes, part), "robot")
    before, at_us = pid(), monotonic_us()
    os.kill(before, number)
    rig.until(lambda: pid() not in (0, before), AGAIN_S, f"a new {part} process")
    rig.watch(SETTLED_S)
    if part == "driver":  # a new driver process never arms itself
        rig.processes.start("arm", ["arm", "--connect", rig.endpoint, "--wait", str(AGAIN_S)])
    again = drives_again(rig)
    first_us = min((one.t_us for one in rig.sent() if one.t_us > at_us + LEFT_OVER_US), default=None)
    return Injected(1, at_us, first_us, again)


def _hold_gil(rig: RobotFixture) -> Injected:
    rig.camera_mode("gil")
    rig.until(lambda: rig.injected("camera") > 0, 5.0, "the interpreter's lock being held")
    at_us = rig.noted("camera", "injected")[0].t_us
    resumed_us = at_us + 1_000_000
    rig.camera_mode("")
    rig.watch(SETTLED_S)
    return Injected(rig.injected("camera"), at_us, resumed_us, drives_again(rig))


def _kill_guardian(rig: RobotFixture) -> Injected:
    driver, at_us = rig.processes.driver("robot"), monotonic_us()
    rig.processes.signal("robot", signal.SIGKILL)
    rig.watch(SETTLED_S)
    is_left = is_running(driver)
    rig.probe_motors()  # so that the log has lines while the wheels roll out
    return Injected(1, at_us, checks=(at_most("driver processes left", is_left, "", 0),))


def _kill_driver_and_guardian(rig: RobotFixture) -> Injected:
    driver, at_us = rig.processes.driver("robot"), monotonic_us()
    os.kill(driver, signal.SIGKILL)
    time.sleep(BETWEEN_S)
    rig.processes.signal("robot", signal.SIGKILL)
    rig.until(lambda: wheel_mps(rig.motors()[-1]) == 0.0, SETTLED_S, "zero, set by the guardian")
    rig.probe_motors()  # immediately: the log has lines for commands only, and the wheels still roll
    rig.watch(SETTLED_S)
    return Injected(2, at_us)


def _kill_guardian_and_driver(rig: RobotFixture) -> Injected:
    """Kill guardian and driver. No process covers this; then the command that systemd runs sets the motors to zero."""
    driver = rig.processes.driver("robot")
    rig.processes.signal("robot", signal.SIGKILL)
    time.sleep(BETWEEN_S)
    os.kill(driver, signal.SIGKILL)
    rig.watch(STOPPED_S)
    kept_mps, at_us = wheel_mps(rig.motors()[-1]), monotonic_us()
    rig.processes.start("zero", ["robot", "--config", str(rig.folder / "robot.toml"), "--zero-motors"])
    code = rig.processes.exit_code("zero", AGAIN_S)
    rig.watch(SETTLED_S)
    return Injected(2, at_us, checks=(
        at_least("speed kept without them", kept_mps, "m/s", AGAIN_MPS), at_most("exit code", code, "", 0),
        at_most("last speed set", wheel_mps(rig.motors()[-1]), "m/s", 0.0),
    ))


def _starve(rig: RobotFixture) -> Injected:
    with busy_processes(BUSY):
        rig.watch(SETTLED_S)
        injected = _kill_vision(rig)
    return Injected(BUSY, injected.at_us)


def _end_robot(rig: RobotFixture, number: signal.Signals) -> Injected:
    started_s, at_us = time.monotonic(), monotonic_us()
    rig.processes.signal("robot", number)
    code = rig.processes.exit_code("robot", FREE_MS / 1000)
    free_ms = (time.monotonic() - started_s) * 1000 if code is not None and _is_free(rig.endpoint) else None
    last_mps = rig.probe_motors()
    checks = (
        at_most("port free after", free_ms, "ms", FREE_MS),
        at_most("last speed set", last_mps, "m/s", 0.0),
        at_most("exit code", code, "", 0),
    )
    return Injected(1, at_us, checks=checks)


def _is_free(endpoint: str) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", int(endpoint.rpartition(":")[2])))
        except OSError:
            return False
    return True


_SCRIPT: Final = Setup()
_ENDED: Final = "zero is the last speed set, exit code 0, port free <= 2 s"

PROCESS_CASES: Final = (
    FaultCase("vision.kill", "vision: SIGKILL", _kill_vision, VISION, short=True),
    FaultCase("vision.pause", "vision: SIGSTOP 3 s, then SIGCONT", _pause_vision, VISION, again=True),
    FaultCase("vision.raises", "vision: the detector raises", _spoil_detector, Setup("vision", "raises")),
    FaultCase("vision.hangs", "vision: the detector hangs", _spoil_detector, Setup("vision", "hangs"), short=True),
    FaultCase("vision.slow", "vision: the detector takes 330 ms", partial(_spoil_detector, seconds=2 * STOPPED_S),
              Setup("vision", "slow"), stops=False),
    FaultCase("vision.restart", "vision: killed and started again", _restart_vision, VISION, again=True),
    FaultCase("network.kill", "network process: SIGKILL", partial(_hurt, part="network", number=signal.SIGKILL),
              _SCRIPT, blind=True, again=True, short=True),
    FaultCase("network.pause", "network process: SIGSTOP", partial(_hurt, part="network", number=signal.SIGSTOP),
              _SCRIPT, blind=True, again=True),
    FaultCase(
        "network.gil", "network process: C code holds the interpreter 1 s", _hold_gil, _SCRIPT, blind=True, again=True,
        short=True
    ),
    FaultCase(
        "driver.starved", "robot: four busy processes beside it; then vision: SIGKILL", _starve, _SCRIPT, alone=True
    ),
    *(
        FaultCase(f"guardian.{name}", f"driver process: {what}", partial(_hurt, part="driver", number=number),
                  _SCRIPT, blind=True, again=True, short=name == "driver_kill", alone=name == "driver_loop")
        for name, what, number in (
            ("driver_kill", "SIGKILL", signal.SIGKILL), ("driver_pause", "SIGSTOP", signal.SIGSTOP),
            ("driver_segfault", "segmentation fault", signal.SIGSEGV),
            ("driver_loop", "endless loop on the core of the guardian", LOOP),
        )
    ),
    FaultCase("guardian.kill", "guardian: SIGKILL", _kill_guardian, _SCRIPT, blind=True, also="driver process ends"),
    FaultCase("guardian.driver_first", "driver process, 50 ms later guardian: SIGKILL", _kill_driver_and_guardian,
              _SCRIPT, blind=True),
    FaultCase(
        "guardian.guardian_first", "guardian, 50 ms later driver process: SIGKILL; 3 s later `--zero-motors`",
        _kill_guardian_and_driver, _SCRIPT, stops=False,
        also="not covered: the wheels keep their speed until `--zero-motors`, which systemd runs, sets zero"
    ),
    *(
        FaultCase(
            f"end.{number.name.lower()}",
            f"robot: {number.name} while moving",
            partial(_end_robot, number=number),
            _SCRIPT,
            blind=True,
            also=_ENDED,
            short=number is signal.SIGTERM,
        )
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    ),
)


# Rows: radio effects on packets, through the wire between two network namespaces. Shell.

DISTURBED_S: Final = 6.0
CUT: Final = LinkShape(cut=True)
LOSSY: Final = LinkShape(loss=0.2)
FLAP_S: Final = 0.5
FLAPS: Final = 6


def shape(rig: RobotFixture, shapes: LinkShapes) -> int:
    """Apply `shapes`. Returns how many packets were harmed so far."""
    assert rig.wire is not None
    return rig.wire.shape(shapes)


def _cut(rig: RobotFixture, shapes: LinkShapes, seconds: float) -> Injected:
    """Cut the wire for a while. No command from after the cut is applied until the wire is restored."""
    before = shape(rig, shapes)
    at_us = monotonic_us()
    rig.watch(seconds)
    harmed, resumed_us = shape(rig, LinkShapes()) - before, monotonic_us()
    return Injected(harmed, at_us, resumed_us, drives_again(rig))


def _worsen(rig: RobotFixture, both: LinkShape, harms: Sequence[str]) -> Injected:
    """Degrade the wire for a while without a cut. The robot may drive on young frames.

    Each of the `harms` must occur in each direction.
    """
    assert rig.wire is not None
    shape(rig, LinkShapes(ab=both, ba=both))
    at_us, before = monotonic_us(), rig.wire.counts
    rig.watch(DISTURBED_S)
    shape(rig, LinkShapes())
    count = min(counts[harm] - before[leg][harm] for leg, counts in rig.wire.counts.items() for harm in harms)
    return Injected(count, at_us, again=drives_again(rig))


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
    FaultCase(
        "wire.cut3", "network: partition 3 s", partial(_cut, shapes=LinkShapes(ab=CUT, ba=CUT), seconds=3.0), _WIRED,
        blind=True, again=True, short=True
    ),
    FaultCase(
        "wire.cut15", "network: partition 15 s", partial(_cut, shapes=LinkShapes(ab=CUT, ba=CUT), seconds=15.0), _WIRED,
        blind=True, again=True
    ),
    FaultCase(
        "wire.no_frames", "network: one direction only, frames lost", partial(_cut, shapes=LinkShapes(ab=CUT),
        seconds=3.0), _WIRED, blind=True, by_frame=True, again=True
    ),
    FaultCase(
        "wire.no_commands", "network: one direction only, commands lost", partial(_cut, shapes=LinkShapes(ba=CUT),
        seconds=3.0), _WIRED, blind=True, again=True
    ),
    FaultCase(
        "wire.delay", "network: 300 ms each way", partial(_worsen, both=_SLOW, harms=("delayed",)), _WIRED,
        stops=False, again=True
    ),
    FaultCase(
        "wire.loss", "network: 20 % loss each way", partial(_worsen, both=LOSSY, harms=("lost",)), _WIRED,
        stops=False, again=True
    ),
    FaultCase(
        "wire.mixed", "network: 10 % reordered, 10 % duplicated", partial(_worsen, both=_MIXED,
        harms=("reordered", "duplicated")), _WIRED, stops=False, again=True
    ),
    FaultCase(
        "wire.thin", "network: 1 Mbit/s under a camera of 4 Mbit/s", partial(_worsen, both=_THIN,
        harms=("delayed",)), _HEAVY, stops=False, again=True
    ),
    FaultCase("wire.flaps", "network: gone and back every 0.5 s", _flap, _WIRED, stops=False, again=True),
)


# Rows: many viewers, some of them faulty, while a driver drives; and the timing of the driver process. Shell.

LOADED_S: Final = 6.0
TICK_MS: Final = 40.0
STARVED_S: Final = 24.0
TICKS: Final = 1000
"""Fewer ticks have no 99.9th percentile."""
HONEST_MS: Final = 10.0
"""Largest delay of the simulation's stamps, while its physics holds the interpreter."""


def _load(rig: RobotFixture, kind: str, at_least_times: int) -> Injected:
    """Let the clients connect while the robot drives, and stay. Then the driver dies."""
    came_us = monotonic_us()
    rig.start_load(kind)
    rig.processes.wait_line("crowd", READY)
    rig.watch(LOADED_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > came_us)
    times = len(rig.noted("crowd", INJECTED))
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(SETTLED_S)
    checks = [at_least("came", times, "times", at_least_times), at_least("speed kept", slowest_mps, "m/s", KEPT_MPS)]
    if kind == "viewers":
        checks.append(at_least("admitted", len(rig.noted("crowd", ADMITTED)), "times", MAX_CLIENTS))
        checks.append(at_least("pictures seen", len(rig.noted("crowd", SEEN)), "", MAX_CLIENTS))
    return Injected(times, at_us, checks=tuple(checks), from_us=came_us)


# --- punctuality -------------------------------------------------------------------------------------------------


def _keep_time(rig: RobotFixture) -> Injected:
    """Drive next to busy processes long enough for a 99.9th percentile. Then the driving peer dies."""
    rig.start_peer("person", "operator", fault="lateness")
    rig.processes.wait_line("person", "person ready", AGAIN_S)
    with busy_processes(BUSY):
        since_us = monotonic_us()
        rig.watch(STARVED_S)
        rows = [row for row in rig.motors() if row.t_us > since_us]
        rig.trigger("person")
        rig.processes.wait_line("person", "late by", AGAIN_S)
        at_us = monotonic_us()
        rig.processes.kill("peer")
        rig.watch(SETTLED_S)
    late = rig.processes.log("person").read_text("utf-8").rpartition("late by ")[2]
    return Injected(BUSY, at_us, checks=tuple(_tick_checks(rows, rig.holes(), int(late.split()[0]))))


def _tick_checks(rows: Sequence[MotorRow], holes: Sequence[Hole], published_us: int) -> list[Check]:
    gaps_us = undisturbed_gaps_us(rows, holes)
    ticks = sum(gaps_us) // TICK_US
    worst_ms = max(gaps_us, default=0) / 1000
    hidden_ms = max(0.0, worst_ms - TICK_US / 1000 - published_us / 1000)
    return [
        at_least("ticks", ticks, "", TICKS),
        at_most("tick p99.9", permille_us(gaps_us, ticks) / 1000, "ms", TICK_MS),
        at_most("unpublished lateness", hidden_ms, "ms", HONEST_MS),
    ]


def undisturbed_gaps_us(rows: Sequence[MotorRow], holes: Sequence[Hole]) -> list[int]:
    """Return the times between two motor commands, without those in which this machine stalled."""
    pairs = itertools.pairwise(row.t_us for row in rows)
    return [b - a for a, b in pairs if not any(hole.from_us < b and hole.to_us > a for hole in holes)]


def permille_us(gaps_us: Sequence[int], ticks: int) -> int:
    """Return the gap that one tick in a thousand exceeds. Commands add only shorter gaps, which do not count."""
    return sorted(gaps_us, reverse=True)[ticks // 1000] if gaps_us else 0


_WEB: Final = Setup(web=True)
_DRIVEN: Final = f"speed stays >= {KEPT_MPS:g} m/s while they are there"

CLIENT_CASES: Final = (
    FaultCase("crowd.viewers", f"drivers: {VIEWERS} WebSocket viewers, one never reading; then the driver dies",
        partial(_load, kind="viewers", at_least_times=VIEWERS), _WEB, also=_DRIVEN, alone=True),
    FaultCase("crowd.handshakes", f"drivers: {HANDSHAKES} half-open handshakes; then the driver dies",
        partial(_load, kind="handshakes", at_least_times=HANDSHAKES), _WEB, also=_DRIVEN, alone=True),
    FaultCase("driver.tick", "robot: four busy processes beside it for 24 s; then the driver dies", _keep_time, Setup(),
        also=f"p99.9 of ticks <= {TICK_MS:g} ms, lateness published", alone=True),
)


# Rows: the camera fails; STOP in every situation; wall clocks that are wrong. Shell.

BAD_S: Final = 3.0
LOSSY_STOP_ZERO_MS: Final = 2000.0
"""A lost packet is sent again after 200 ms at the earliest, and the next loss doubles that."""
COASTED_MS: Final = TrackConfig().coast_s * 1000 + 700.0
DAY_S: Final = 86_400
RESTARTED_S: Final = 3.5
"""2 s without an image, and a busy machine."""
TICKS_OF_A_SECOND: Final = 50
DEMO_S: Final = 2.0
DEMO_ENDS_S: Final = 2.0


# --- the camera --------------------------------------------------------------------------------------------------


def _spoil_camera(rig: RobotFixture, mode: str) -> Injected:
    at_us = rig.camera_mode(mode)
    rig.watch(BAD_S)
    times, resumed_us = rig.injected("camera"), rig.camera_mode("")
    return Injected(times, at_us, resumed_us, drives_again(rig))


def _lose_camera(rig: RobotFixture, mode: str) -> Injected:
    """Stop the images until the camera's process was restarted and `status` names it."""
    before = rig.processes.network("robot")
    at_us = rig.camera_mode(mode)
    rig.until(lambda: rig.processes.network("robot") not in (0, before), AGAIN_S, "a new network process")
    since_s = (monotonic_us() - at_us) / 1e6
    rig.until(lambda: rig.logged(f"robot {ROBOT}: on") > 1, AGAIN_S, "a new endpoint")
    named = rig.status()["stream"]["camera_fault"]
    times, resumed_us = rig.injected("camera"), rig.camera_mode("")
    again = drives_again(rig)
    checks = at_most("started again after", since_s, "s", RESTARTED_S), at_least("named in status", bool(named), "", 1)
    return Injected(times, at_us, resumed_us, again, checks)


def _fail_drive(rig: RobotFixture) -> Injected:
    """Let the drive plug-in raise at each tick: zero immediately, and FAULT until an operator resets it."""
    at_us = rig.fail_drive("wheels")
    rig.watch(BAD_S)
    status, times = rig.status(), rig.injected("drive")
    return Injected(times, at_us, checks=(
        at_least("counted in status", status["faults"].get("drive", 0), "", TICKS_OF_A_SECOND),
        at_least("state FAULT", status["state"] == "FAULT", "", 1),
        *_one_traceback(rig, f"error drive raised ArithmeticError: {DRIVE_ERROR}\nTraceback "),
    ))


def _reject_speeds(rig: RobotFixture) -> Injected:
    """Let the drive reject all speeds, also zero: the guardian stops the wheels, and a new driver process waits."""
    at_us = rig.fail_drive("set")
    rig.watch(BAD_S)
    ends = rig.logged("killed: its drive took no speeds")
    checks = at_least("ended by the guardian", ends, "", 1), at_most("no more", ends, "", 1)
    return Injected(rig.injected("drive"), at_us, checks=checks)


def _one_traceback(rig: RobotFixture, text: str) -> tuple[Check, Check]:
    count = rig.logged(text)
    return at_least("tracebacks", count, "", 1), at_most("no more", count, "", 1)


def _fill_disk(rig: RobotFixture) -> Injected:
    """Let all file writes of the robot's processes fail. It drives on, and stops when vision dies."""
    guardian = rig.processes.pid("robot")
    for pid in (guardian, *_descendants(guardian)):
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, 0))
    since_us = monotonic_us()
    rig.watch(BAD_S)
    slowest_mps = min(wheel_mps(row) for row in rig.motors() if row.t_us > since_us)
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(SETTLED_S)
    return Injected(
        1, at_us, checks=(at_least("speed kept", slowest_mps, "m/s", KEPT_MPS),), from_us=since_us)


def _kill_demo(rig: RobotFixture) -> Injected:
    """Kill a demo next to the robot while it drives. The processes that it started must end by themselves."""
    folder = rig.folder / "demo"
    rig.processes.start("demo", ["demo", "--seconds", "600", "--out", str(folder)])
    vision = folder / "vision.log"
    rig.until(lambda: vision.exists() and "target seen" in vision.read_text("utf-8"), AT_SPEED_S, "a demo that drives")
    rig.watch(DEMO_S)
    started = list(_descendants(rig.processes.pid("demo")))
    at_us = monotonic_us()
    rig.processes.kill("demo")
    rig.watch(DEMO_ENDS_S)
    left = sum(map(is_running, started))
    return Injected(len(started), at_us, checks=(at_most("processes after 2 s", left, "", 0),))


def _descendants(pid: int) -> Iterator[int]:
    for child in children_of(pid):
        yield child
        yield from _descendants(child)


def _blacken(rig: RobotFixture) -> Injected:
    """Send black images on young frames: vision may coast and then turn to search, but not drive on."""
    at_us = rig.camera_mode("black")
    rig.watch(BAD_S)
    forward = [row.t_us for row in rig.motors() if row.t_us > at_us and abs(_forward_mps(row)) > 0.02]
    times = rig.injected("camera")
    rig.camera_mode("")
    coasted = at_most("drove on for", (max(forward, default=at_us) - at_us) / 1000, "ms", COASTED_MS)
    return Injected(times, at_us, again=drives_again(rig), checks=(coasted,))


def _forward_mps(row: MotorRow) -> float:
    return (row.left_rad_s + row.right_rad_s) / 2 * DiffDriveConfig().wheel_radius_m


# --- STOP --------------------------------------------------------------------------------------------------------


def _send_stop(rig: RobotFixture, fault: str = "") -> int:
    """Send STOP as an operator. Returns the time of the first message."""
    rig.start_peer("person", "operator", fault=fault)
    rig.processes.wait_line("person", "person ready", AGAIN_S)
    rig.trigger("person")
    rig.until(lambda: rig.injected("person") > 0, 5.0, "a STOP")
    return rig.noted("person", REQUESTED)[0].t_us


def _stop(rig: RobotFixture, fault: str = "") -> Injected:
    at_us = _send_stop(rig, fault)
    rig.watch(BAD_S)
    return Injected(rig.injected("person"), at_us)


def _stop_lossy(rig: RobotFixture) -> Injected:
    before = shape(rig, LinkShapes())
    rig.start_peer("person", "operator")
    rig.processes.wait_line("person", "person ready", AGAIN_S)
    shape(rig, LinkShapes(ab=LOSSY, ba=LOSSY))
    rig.trigger("person")
    rig.until(lambda: rig.injected("person") > 0, 5.0, "a STOP")
    rig.watch(2 * BAD_S)
    return Injected(shape(rig, LinkShapes()) - before, rig.noted("person", REQUESTED)[0].t_us)


def _stop_then_commands(rig: RobotFixture) -> Injected:
    at_us = _send_stop(rig)
    rig.watch(SETTLED_S)
    rig.trigger()
    rig.watch(BAD_S)
    times = rig.injected()
    return Injected(times, at_us, checks=(at_least("commands after it", times, "times", 1000),))


def _stop_then_restart(rig: RobotFixture) -> Injected:
    at_us = _send_stop(rig)
    rig.watch(SETTLED_S)
    before = rig.processes.network("robot")
    rig.signal_network(signal.SIGKILL)
    rig.until(lambda: rig.processes.network("robot") not in (0, before), AGAIN_S, "a new network process")
    since_us = monotonic_us()
    rig.until(lambda: rig.sent("peer")[-1].t_us > since_us, AGAIN_S, "commands after the restart")
    rig.watch(BAD_S)
    return Injected(1, at_us)


def _reset_moving(rig: RobotFixture) -> Injected:
    """Reset while the wheels still turn. They must come to zero, and vision must not resume."""
    injected = _stop(rig, "reset")
    refused = "reset False" in rig.processes.log("person").read_text("utf-8")
    return Injected(injected.count, injected.at_us, checks=(at_least("reset rejected", refused, "", 1),))


# --- clocks ------------------------------------------------------------------------------------------------------


def _suspend(rig: RobotFixture) -> Injected:
    """Let the robot's clock leap while commands continue. Each cites a frame from before the suspend."""
    rig.prepare_operator()
    at_us = rig.suspend()
    rig.watch(ATTACKED_S)
    _, stopped = rig.stop_by_operator(moving=False)
    return Injected(1, at_us, checks=stopped)


def _drive_on(rig: RobotFixture) -> Injected:
    """Drive with the wrong clock for a while, then let vision die."""
    since_us = monotonic_us()
    rig.watch(BAD_S)
    slowest_mps = min((wheel_mps(row) for row in rig.motors() if row.t_us > since_us), default=0.0)
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(SETTLED_S)
    checks = (at_least("speed kept", slowest_mps, "m/s", KEPT_MPS),)
    return Injected(len(rig.noted("clock", INJECTED)), at_us, checks=checks, from_us=since_us)
_STAYS: Final = "and stays at zero"

OPERATOR_CASES: Final = (
    FaultCase(
        "camera.unplugged", "camera: unplugged 3 s", partial(_spoil_camera, mode="unplugged"), VISION, again=True
    ),
    FaultCase(
        "camera.frozen", "camera: frozen 3 s, with new stamps", partial(_spoil_camera, mode="frozen"), _SCRIPT,
        blind=True, again=True, short=True
    ),
    FaultCase(
        "camera.black",
        "camera: black 3 s",
        _blacken,
        VISION,
        stops=False,
        again=True,
        also=f"forward speed zero <= {COASTED_MS:g} ms",
    ),
    FaultCase(
        "camera.slow", "camera: 5 fps for 3 s", partial(_spoil_camera, mode="slow"), _SCRIPT, stops=False, again=True
    ),
    FaultCase(
        "camera.bomb", "camera: a JPEG that claims 65500 x 65500, 3 s", partial(_spoil_camera, mode="bomb"), VISION,
        blind=True, again=True
    ),
    FaultCase(
        "camera.resized", "camera: the picture changes size, 3 s", partial(_spoil_camera, mode="resized"), VISION,
        blind=True, again=True
    ),
    *(
        FaultCase(
            f"camera.{mode}", f"camera: {what} until its process is started again", partial(_lose_camera, mode=mode),
            VISION, again=True, also=f"started again <= {RESTARTED_S:g} s, named in status", short=mode == "hangs",
        )
        for mode, what in (("hangs", "its `read` hangs"), ("nothing", "no image"))
    ),
    FaultCase(
        "drive.raises", "drive: the plug-in raises an exception", _fail_drive, _SCRIPT, blind=True, short=True,
        also="FAULT, counted in status, one traceback in the log",
    ),
    FaultCase(
        "drive.refuses", "drive: the plug-in takes no more speeds", _reject_speeds, _SCRIPT, blind=True, short=True,
        also="ended by the guardian once",
    ),
    FaultCase(
        "disk.full", "robot: its disk is full; 3 s later vision: SIGKILL", _fill_disk, _SCRIPT,
        also=f"speed stays >= {KEPT_MPS:g} m/s",
    ),
    FaultCase(
        "demo.kill", "demo beside the robot: SIGKILL", _kill_demo, _SCRIPT, stops=False, alone=True,
        also=f"0 processes after {DEMO_ENDS_S:g} s",
    ),
    FaultCase("stop.driving", "STOP: while driving", _stop, _SCRIPT, blind=True, also=_STAYS, short=True),
    FaultCase(
        "stop.lossy", "STOP: while 20 % of packets are lost", _stop_lossy, Setup(wired=True), blind=True,
        zero_ms=LOSSY_STOP_ZERO_MS, distance_m=1.0, also=_STAYS
    ),
    FaultCase(
        "stop.commands", "STOP: then 1000 commands", _stop_then_commands, Setup(fault="thousand"), blind=True,
        also=_STAYS
    ),
    FaultCase(
        "stop.restart", "STOP: then the network process is killed", _stop_then_restart, _SCRIPT, blind=True, also=_STAYS
    ),
    FaultCase(
        "stop.reset", "STOP: then reset while moving", _reset_moving, _SCRIPT, blind=True, also="rejected; " + _STAYS
    ),
    FaultCase("clock.suspend", "clocks: a suspend of a minute between a frame and its twist, simulated", _suspend,
              Setup(sleeps=True), blind=True, also="then STOP: exit code 0"),
    FaultCase("clock.ahead", "clocks: a day ahead, then vision: SIGKILL", _drive_on, Setup(clock=f"{DAY_S}")),
    FaultCase("clock.behind", "clocks: a day behind, then vision: SIGKILL", _drive_on, Setup(clock=f"-{DAY_S}")),
    FaultCase(
        "clock.steps",
        "clocks: an hour forth and back every 0.5 s",
        _drive_on,
        Setup(clock="3600 * (int(2 * right()) % 3 - 1)"),
    ),
)


# All rows of the fault bench, and their selection. Shell (the rows inject faults).

CASES: Final[tuple[FaultCase, ...]] = (
    *PROCESS_CASES, *NETWORK_CASES, *COMMAND_CASES, *CLIENT_CASES, *OPERATOR_CASES, *STOP_CASES,
)


def chosen(only: Sequence[str], *, short: bool) -> list[FaultCase]:
    """Return the rows named by id or by the part before the dot; all without names. Raises ConfigError for no row."""
    rows = [row for row in CASES if row.short or not short]
    for name in only:
        if not any(_is_named(row, name) for row in rows):
            what = "fault of the short set" if short else "fault"
            raise ConfigError(no_such_name(what, name, [row.id for row in rows]))
    return [row for row in rows if not only or any(_is_named(row, name) for name in only)]


def _is_named(row: FaultCase, name: str) -> bool:
    return name in (row.id, row.id.partition(".")[0])
