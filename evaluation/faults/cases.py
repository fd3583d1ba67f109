"""Rows: vision dies, hangs or slows; the network process does; the driver process is starved or ended. Shell."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Final

from sightline.evaluation.checks import at_most
from sightline.operator_side.faults.rig import RobotFixture, Setup
from sightline.evaluation.faults.runner import Case, Injected
from sightline.protocol.clock import monotonic_us

STOPPED_S: Final = 3.0
SETTLED_S: Final = 1.5
AGAIN_MPS: Final = 0.2
AGAIN_S: Final = 20.0
LEFT_OVER_US: Final = 500_000
"""A driver may still answer frames that it had when the network process died; a new one takes longer than this."""
BUSY: Final = 4
FREE_MS: Final = 2000.0
_BUSY_LOOP: Final = "while True: pass"


def drives_again(rig: RobotFixture) -> bool:
    """Wait until the robot drives again, and a little longer."""
    rig.wait_speed(AGAIN_MPS, AGAIN_S)
    rig.watch(0.5)
    return True


def _kill_vision(rig: RobotFixture) -> Injected:
    at_us = monotonic_us()
    rig.fleet.kill("peer")
    rig.watch(SETTLED_S)
    return Injected(1, at_us)


def _pause_vision(rig: RobotFixture) -> Injected:
    at_us = monotonic_us()
    rig.fleet.signal("peer", signal.SIGSTOP)
    rig.watch(STOPPED_S)
    resumed_us = monotonic_us()
    rig.fleet.signal("peer", signal.SIGCONT)
    return Injected(1, at_us, resumed_us, drives_again(rig))


def _fail_detector(rig: RobotFixture) -> Injected:
    at_us = rig.trigger()
    rig.watch(SETTLED_S)
    return Injected(rig.injected(), at_us)


def _slow_detector(rig: RobotFixture) -> Injected:
    at_us = rig.trigger()
    rig.watch(2 * STOPPED_S)
    return Injected(rig.injected(), at_us)


def _restart_vision(rig: RobotFixture) -> Injected:
    at_us = monotonic_us()
    rig.fleet.kill("peer")
    rig.watch(SETTLED_S)
    resumed_us = monotonic_us()
    rig.start_peer("second", "vision")
    return Injected(1, at_us, resumed_us, drives_again(rig))


def _kill_network(rig: RobotFixture) -> Injected:
    before = rig.fleet.child("robot")
    at_us = rig.signal_network(signal.SIGKILL)
    rig.until(lambda: rig.fleet.child("robot") not in (0, before), AGAIN_S, "a new network process")
    rig.watch(SETTLED_S)
    again = drives_again(rig)
    first_us = min((one.t_us for one in rig.sent() if one.t_us > at_us + LEFT_OVER_US), default=None)
    return Injected(1, at_us, first_us, again)


def _pause_network(rig: RobotFixture) -> Injected:
    at_us = rig.signal_network(signal.SIGSTOP)
    rig.watch(STOPPED_S)
    resumed_us = rig.signal_network(signal.SIGCONT)
    return Injected(1, at_us, resumed_us, drives_again(rig))


def _hold_gil(rig: RobotFixture) -> Injected:
    rig.camera_mode("gil")
    rig.until(lambda: rig.injected("camera") > 0, 5.0, "the interpreter's lock being held")
    at_us = rig.noted("camera", "injected")[0].t_us
    resumed_us = at_us + 1_000_000
    rig.camera_mode("")
    rig.watch(SETTLED_S)
    return Injected(rig.injected("camera"), at_us, resumed_us, drives_again(rig))


@contextmanager
def busy_processes() -> Iterator[None]:
    """Four processes that want all the processor they can get."""
    busy = [subprocess.Popen([sys.executable, "-c", _BUSY_LOOP]) for _ in range(BUSY)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def _starve(rig: RobotFixture) -> Injected:
    with busy_processes():
        rig.watch(SETTLED_S)
        injected = _kill_vision(rig)
    return Injected(BUSY, injected.at_us)


def _end_robot(rig: RobotFixture, number: signal.Signals) -> Injected:
    started_s, at_us = time.monotonic(), monotonic_us()
    rig.fleet.signal("robot", number)
    code = rig.fleet.exit_code("robot", FREE_MS / 1000)
    free_ms = (time.monotonic() - started_s) * 1000 if code is not None and _is_free(rig.endpoint) else None
    last_mps = rig.probe_motors()
    checks = (
        at_most("port free after", free_ms, "ms", FREE_MS),
        at_most("last speed told", last_mps, "m/s", 0.0),
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


_VISION: Final = Setup(driver="vision")
_SCRIPT: Final = Setup()
_ENDED: Final = "zero is the last speed told, exit code 0, port free <= 2 s"

PROCESS_CASES: Final = (
    Case("vision.kill", "vision: SIGKILL", _kill_vision, _VISION, short=True),
    Case("vision.pause", "vision: SIGSTOP 3 s, then SIGCONT", _pause_vision, _VISION, again=True),
    Case("vision.raises", "vision: the detector raises", _fail_detector, Setup("vision", "raises")),
    Case("vision.hangs", "vision: the detector hangs", _fail_detector, Setup("vision", "hangs"), short=True),
    Case("vision.slow", "vision: the detector takes 330 ms", _slow_detector, Setup("vision", "slow"), stops=False),
    Case("vision.restart", "vision: killed and started again", _restart_vision, _VISION, again=True),
    Case("network.kill", "network process: SIGKILL", _kill_network, _SCRIPT, blind=True, again=True, short=True),
    Case("network.pause", "network process: SIGSTOP 3 s", _pause_network, _SCRIPT, blind=True, again=True),
    Case("network.gil", "network process: C code holds the interpreter 1 s", _hold_gil, _SCRIPT, blind=True, again=True,
        short=True),
    Case("driver.starved", "robot: four busy processes beside it; then vision: SIGKILL", _starve, _SCRIPT, alone=True),
    *(
        Case(f"end.{number.name.lower()}", f"robot: {number.name} while moving", partial(_end_robot, number=number),
            _SCRIPT, blind=True, also=_ENDED, short=number is signal.SIGTERM)
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
    ),
)
