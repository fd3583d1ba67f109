"""Rows: the camera fails; STOP in every situation; wall clocks that are wrong. Shell."""

import signal
from functools import partial
from typing import Final

from sightline.evaluation.checks import at_least, at_most
from sightline.evaluation.faults.evidence import MotorRow, wheel_mps
from sightline.operator_side.faults.ledger import REQUESTED
from sightline.operator_side.faults.rig import RobotFixture, Setup
from sightline.evaluation.faults.runner import Case, Injected
from sightline.operator_side.faults.rows_network import LOSSY, shape
from sightline.evaluation.faults.cases import AGAIN_S, SETTLED_S, drives_again
from sightline.protocol.clock import monotonic_us
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.sim.network_emulator import LinkShapes
from sightline.vision_side.config import TrackConfig

BAD_S: Final = 3.0
STOP_ZERO_MS: Final = 700.0
LOSSY_STOP_ZERO_MS: Final = 2000.0
"""A lost packet is sent again after 200 ms at the earliest, and the next loss doubles that."""
COASTED_MS: Final = TrackConfig().coast_s * 1000 + 700.0
DAY_S: Final = 86_400


# --- the camera --------------------------------------------------------------------------------------------------


def _spoil_camera(rig: RobotFixture, mode: str) -> Injected:
    at_us = rig.camera_mode(mode)
    rig.watch(BAD_S)
    times, resumed_us = rig.injected("camera"), rig.camera_mode("")
    return Injected(times, at_us, resumed_us, drives_again(rig))


def _blacken(rig: RobotFixture) -> Injected:
    """Nothing is seen, on young frames: vision may coast and then turn to search, but not drive on."""
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
    """A person says STOP; returns when it was first sent."""
    rig.start_peer("person", "operator", fault=fault)
    rig.fleet.wait_line("person", "person ready", AGAIN_S)
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
    rig.fleet.wait_line("person", "person ready", AGAIN_S)
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
    before = rig.fleet.child("robot")
    rig.signal_network(signal.SIGKILL)
    rig.until(lambda: rig.fleet.child("robot") not in (0, before), AGAIN_S, "a new network process")
    since_us = monotonic_us()
    rig.until(lambda: rig.sent("peer")[-1].t_us > since_us, AGAIN_S, "commands after the restart")
    rig.watch(BAD_S)
    return Injected(1, at_us)


def _reset_moving(rig: RobotFixture) -> Injected:
    """Reset while the wheels still turn; the wheels must come to zero and vision must not take it up again."""
    injected = _stop(rig, "reset")
    refused = "reset False" in rig.fleet.log("person").read_text("utf-8")
    return Injected(injected.count, injected.at_us, checks=(at_least("reset refused", refused, "", 1),))


# --- clocks ------------------------------------------------------------------------------------------------------


def _drive_on(rig: RobotFixture) -> Injected:
    """Drive with the wrong clock for a while, then let vision die."""
    rig.watch(BAD_S)
    slowest_mps = min((wheel_mps(row) for row in rig.motors() if row.t_us > monotonic_us() - BAD_S * 1e6), default=0.0)
    at_us = monotonic_us()
    rig.fleet.kill("peer")
    rig.watch(SETTLED_S)
    checks = (at_least("speed kept", slowest_mps, "m/s", 0.4),)
    return Injected(len(rig.noted("clock", "injected")), at_us, checks=checks)


_VISION: Final = Setup(driver="vision")
_SCRIPT: Final = Setup()
_STAYS: Final = "and stays at zero"

OPERATOR_CASES: Final = (
    Case("camera.unplugged", "camera: unplugged 3 s", partial(_spoil_camera, mode="unplugged"), _VISION, again=True),
    Case("camera.frozen", "camera: frozen 3 s, with new stamps", partial(_spoil_camera, mode="frozen"), _SCRIPT,
        blind=True, again=True, short=True),
    Case("camera.black", "camera: black 3 s", _blacken, _VISION, stops=False, again=True,
        also=f"forward speed zero <= {COASTED_MS:g} ms"),
    Case("camera.slow", "camera: 5 fps for 3 s", partial(_spoil_camera, mode="slow"), _SCRIPT, stops=False, again=True),
    Case("camera.bomb", "camera: a JPEG that claims 65500 x 65500, 3 s", partial(_spoil_camera, mode="bomb"), _VISION,
        blind=True, again=True),
    Case("camera.resized", "camera: the picture changes size, 3 s", partial(_spoil_camera, mode="resized"), _VISION,
        blind=True, again=True),
    Case("stop.driving", "STOP: while driving", _stop, _SCRIPT, blind=True, also=_STAYS, short=True),
    Case("stop.lossy", "STOP: while 20 % of packets are lost", _stop_lossy, Setup(wired=True), blind=True,
        zero_ms=LOSSY_STOP_ZERO_MS, distance_m=1.0, also=_STAYS),
    Case("stop.commands", "STOP: then 1000 commands", _stop_then_commands, Setup(fault="thousand"), blind=True,
        also=_STAYS),
    Case("stop.restart", "STOP: then the network process is killed", _stop_then_restart, _SCRIPT, blind=True,
        also=_STAYS),
    Case("stop.reset", "STOP: then reset while moving", _reset_moving, _SCRIPT, blind=True, also="refused; " + _STAYS),
    Case("clock.ahead", "clocks: a day ahead, then vision: SIGKILL", _drive_on, Setup(clock=f"{DAY_S}")),
    Case("clock.behind", "clocks: a day behind, then vision: SIGKILL", _drive_on, Setup(clock=f"-{DAY_S}")),
    Case("clock.steps", "clocks: an hour forth and back every 0.5 s", _drive_on,
        Setup(clock="3600 * (int(2 * right()) % 3 - 1)")),
)
