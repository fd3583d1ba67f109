"""Rows: commands that lie about what they answer, that are no commands, or too many; and who may drive. Shell."""

from functools import partial
from typing import Final

from sightline.evaluation.checks import at_least, at_most
from sightline.evaluation.faults.evidence import most_gain_mps2, wheel_mps
from sightline.operator_side.faults.rig import RobotFixture, Setup
from sightline.evaluation.faults.runner import Case, Injected
from sightline.evaluation.faults.cases import SETTLED_S
from sightline.protocol.clock import monotonic_us
from sightline.robot_side.safety.limits import SafetyConfig

ATTACKED_S: Final = 3.0
LEASE_US: Final = SafetyConfig().lease_ms * 1000
GAIN_MPS2: Final = SafetyConfig().max_acceleration_mps2 * 1.05
"""Five percent for rounding in the log."""
ENOUGH: Final = 30
FLOOD_AT_LEAST: Final = 20_000


def _attack(rig: RobotFixture, at_least_times: int = ENOUGH) -> Injected:
    """From the trigger on, only what must be refused is sent."""
    at_us = rig.trigger()
    rig.watch(ATTACKED_S)
    times = rig.injected()
    return Injected(times, at_us, checks=(at_least("sent", times, "times", at_least_times),))


def _reverse(rig: RobotFixture) -> Injected:
    at_us = rig.trigger()
    rig.watch(2.0 + SETTLED_S)
    gain = at_most("hardest change", most_gain_mps2(rig.motors(), at_us), "m/s2", GAIN_MPS2)
    return Injected(rig.injected(), at_us, checks=(gain,))


def _replay_earlier(rig: RobotFixture) -> Injected:
    """Record a session, start the robot anew, drive, and then play the recording to it."""
    recording = rig.folder / "earlier.txt"
    rig.start_peer("recorder", "driver", source="teleop", recording=recording, seconds=3.0)
    rig.until(lambda: recording.exists() and len(recording.read_text("ascii").splitlines()) > 30, 15.0, "a recording")
    rig.fleet.exit_code("recorder", 15.0)
    rig.fleet.kill("peer")
    rig.fleet.end_one("robot")
    rig.start_robot()
    rig.start_peer("replayer", "driver", fault="replay", recording=recording)
    rig.wait_speed(rig.setup.at_speed_mps)
    at_us = rig.trigger("replayer")
    rig.watch(ATTACKED_S)
    return Injected(rig.injected("replayer"), at_us)


def _two_visions(rig: RobotFixture) -> Injected:
    """A second vision asks for the opposite all the time; then both die."""
    rig.start_peer("second", "driver", linear_mps=-0.5, angular_rad_s=0.0)
    rig.until(lambda: len(rig.sent("second")) > 30, 15.0, "a second vision")
    last = [row for row in rig.motors() if row.t_us >= rig.sent("second")[0].t_us]
    backwards = sum(row.left_rad_s + row.right_rad_s < 0 for row in last)
    slowest_mps = min(map(wheel_mps, last))
    at_us = monotonic_us()
    rig.fleet.kill("second")
    rig.fleet.kill("peer")
    rig.watch(SETTLED_S)
    checks = (
        at_most("obeyed the second", backwards, "lines", 0),
        at_least("speed kept", slowest_mps, "m/s", 0.4),
    )
    return Injected(len(rig.sent("second")), at_us, checks=checks)


def _take_over(rig: RobotFixture) -> Injected:
    """A person takes over at full speed and drives back, then is lost: a stop that vision does not end."""
    rig.start_peer("person", "driver", source="teleop", linear_mps=-0.4, angular_rad_s=0.0)
    rig.until(lambda: _goes_back(rig), 15.0, "a takeover")
    took_ms = (monotonic_us() - rig.sent("person")[0].t_us) / 1000
    rig.watch(0.5)
    at_us = monotonic_us()
    rig.fleet.kill("person")
    rig.watch(SETTLED_S + 1.0)
    return Injected(1, at_us, checks=(at_most("person obeyed after", took_ms, "ms", 1000.0),))


def _goes_back(rig: RobotFixture) -> bool:
    last = rig.motors()[-1]
    return last.left_rad_s < 0 and last.right_rad_s < 0 and wheel_mps(last) > 0.39


def _holder_dies(rig: RobotFixture) -> Injected:
    """The driver dies while another waits: a stop first, the other only when the lease is over."""
    rig.start_peer("second", "driver", linear_mps=0.3)
    rig.until(lambda: len(rig.sent("second")) > 10, 15.0, "a second driver")
    at_us = monotonic_us()
    rig.fleet.kill("peer")
    rig.watch(ATTACKED_S)
    last_us = rig.sent("peer")[-1].t_us
    moving = [row.t_us for row in rig.motors() if row.t_us > last_us + LEASE_US // 2 and wheel_mps(row) > 0]
    waited_ms = (moving[0] - last_us) / 1000 if moving else 0.0
    checks = (at_least("next driver after", waited_ms, "ms", LEASE_US / 1000 - 20),)
    return Injected(1, at_us, last_us + LEASE_US - 20_000, bool(moving), checks)


def _command_case(name: str, what: str, *, short: bool = False) -> Case:
    return Case(f"command.{name}", f"commands: {what}", _attack, Setup(fault=name), short=short)


COMMAND_CASES: Final = (
    _command_case("late", "each 500 ms after its frame"),
    _command_case("replay", "this session's, replayed", short=True),
    Case("command.earlier", "commands: an earlier session's, replayed", _replay_earlier, Setup()),
    _command_case("never_issued", "citing frames never issued"),
    _command_case("from_future", "citing frames from the future"),
    _command_case("wrapped", "their numbers wrap"),
    _command_case("malformed", "nan, inf, 1e400, underscores, full-width, empty, 3 fields, 257 bytes, 10 MB, binary ..."),
    Case("command.flood", "commands: an old one at 10 kHz", partial(_attack, at_least_times=FLOOD_AT_LEAST),
        Setup(fault="flood"), also=f">= {FLOOD_AT_LEAST} sent", short=True, alone=True),
    Case("command.reversal", "commands: full speed ahead and back at 50 Hz", _reverse, Setup(fault="reversal"),
        also=f"speed changes by <= {GAIN_MPS2:g} m/s2"),
    _command_case("heartbeat", "none, but frames are acknowledged and the link is alive", short=True),
    Case("driver.two", "drivers: two visions, then none", _two_visions, Setup(), also="the second is not obeyed"),
    Case("driver.person", "drivers: a person takes over at full speed, and is lost", _take_over, Setup(), blind=True,
        also="obeyed <= 1000 ms; vision does not resume by itself"),
    Case("driver.dies", "drivers: the holder dies while another waits", _holder_dies, Setup(), blind=True, again=True,
        also="the other drives only after the lease"),
)
