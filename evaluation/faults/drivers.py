"""Rows: commands with a false echo, invalid commands, too many commands, copied identities, several drivers. Shell."""

import itertools
import signal
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Final

from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.evidence import (
    FLOOD_AT_LEAST,
    INJECTED,
    ZERO_MS,
    MotorRow,
    SentCommand,
    most_gain_mps2,
    wheel_mps,
)
from sightline.evaluation.faults.fixture import KEPT_MPS, SESSION, RobotFixture, Setup
from sightline.evaluation.faults.runner import FaultCase, Injected
from sightline.protocol.clock import monotonic_us
from sightline.robot_side.safety.limits import SafetyConfig

SETTLED_S: Final = 1.5
VISION: Final = Setup(driver="vision")
ATTACKED_S: Final = 3.0
LEASE_US: Final = SafetyConfig().lease_ms * 1000
GAIN_MPS2: Final = SafetyConfig().max_acceleration_mps2 * 1.05
"""Five percent for rounding in the log."""
ENOUGH: Final = 30
PERSON: Final = "0e0e0e0e"
_STOPS: Final = "then STOP: exit code 0"
_STOPS_MOVING: Final = f"then STOP: zero <= {ZERO_MS:g} ms after the first packet, exit code 0"


def _attack(rig: RobotFixture, at_least_times: int = ENOUGH) -> Injected:
    """Send only commands that must be rejected, from the trigger on."""
    at_us = rig.trigger()
    rig.watch(ATTACKED_S)
    rig.until(lambda: rig.injected() >= at_least_times, 2 * ATTACKED_S, f"an attack with {at_least_times} commands")
    times = rig.injected()
    return Injected(times, at_us, checks=(at_least("sent", times, "times", at_least_times),))


def _reverse(rig: RobotFixture) -> Injected:
    at_us = rig.trigger()
    rig.watch(2.0 + SETTLED_S)
    gain = at_most("hardest change", most_gain_mps2(rig.motors(), at_us), "m/s2", GAIN_MPS2)
    return Injected(rig.injected(), at_us, checks=(gain,))


def _replay_earlier(rig: RobotFixture) -> Injected:
    """Record a session, restart the robot, drive, and then replay the recording."""
    recording = rig.folder / "earlier.txt"
    rig.start_peer("recorder", "driver", source="teleop", recording=recording, seconds=3.0)
    rig.until(lambda: recording.exists() and len(recording.read_text("ascii").splitlines()) > 30, 15.0, "a recording")
    rig.processes.exit_code("recorder", 15.0)
    rig.processes.kill("peer")
    rig.processes.end_one("robot")
    rig.start_robot()
    rig.start_peer("replayer", "driver", fault="replay", recording=recording)
    rig.wait_speed(rig.setup.at_speed_mps)
    at_us = rig.trigger("replayer")
    rig.watch(ATTACKED_S)
    return Injected(rig.injected("replayer"), at_us)


def _two_visions(rig: RobotFixture) -> Injected:
    """Start a second vision service that sends the opposite commands; then both die."""
    rig.start_peer("second", "driver", linear_mps=-0.5, angular_rad_s=0.0)
    rig.until(lambda: len(rig.sent("second")) > 30, 15.0, "a second vision service")
    last = [row for row in rig.motors() if row.t_us >= rig.sent("second")[0].t_us]
    backwards = sum(row.left_rad_s + row.right_rad_s < 0 for row in last)
    slowest_mps = min(map(wheel_mps, last))
    at_us = monotonic_us()
    rig.processes.kill("second")
    rig.processes.kill("peer")
    rig.watch(SETTLED_S)
    checks = (
        at_most("applied from the second", backwards, "lines", 0),
        at_least("speed kept", slowest_mps, "m/s", KEPT_MPS),
    )
    return Injected(len(rig.sent("second")), at_us, checks=checks, from_us=last[0].t_us)


def _impersonate(rig: RobotFixture, fault: str = "copied", **attacker: Any) -> Injected:
    """Attack with the driver's session and opposite commands. Then the driver dies, then comes STOP."""
    rig.prepare_operator()
    rig.start_peer("attacker", "driver", fault=fault, linear_mps=-0.5, angular_rad_s=0.0, **attacker)
    rig.until(lambda: bool(rig.sent("attacker")), 15.0, "the attacker's link")
    rig.trigger("attacker")
    rig.until(lambda: rig.injected("attacker") > ENOUGH, 15.0, "an attack")
    began_us = rig.noted("attacker", INJECTED)[0].t_us
    rig.watch(ATTACKED_S)
    rows = [row for row in rig.motors() if row.t_us >= began_us]
    backwards = sum(row.left_rad_s + row.right_rad_s < 0 for row in rows)
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(LEASE_US / 2e6)
    rig.processes.kill("attacker")  # after the lease it may drive under its own name
    rig.watch(SETTLED_S)
    _, stopped = rig.stop_by_operator(moving=False)
    checks = (
        at_most("motor log lines of the attacker", backwards, "lines", 0),
        at_least("speed kept", min(map(wheel_mps, rows)), "m/s", KEPT_MPS),
    )
    return Injected(rig.injected("attacker"), at_us, checks=(*checks, *stopped), from_us=began_us)


def _replay_driver(rig: RobotFixture) -> Injected:
    """Replay an operator's messages while it drives and afterwards. An `arm` would let vision drive."""
    rig.prepare_operator()
    recording = rig.folder / "driver.txt"
    rig.start_peer("person", "driver", source="teleop", session=PERSON, recording=recording, fault="turn_round",
                   linear_mps=-0.5, angular_rad_s=0.0)
    rig.until(lambda: _goes_back(rig), 15.0, "a takeover")
    rig.start_peer("attacker", "driver", source="teleop", session=PERSON, recording=recording, fault="replay")
    rig.until(lambda: bool(rig.sent("attacker")), 15.0, "the attacker's link")
    rig.trigger("person")
    rig.until(lambda: rig.motors()[-1].left_rad_s > 0 and wheel_mps(rig.motors()[-1]) > 0.49, 15.0, "driving ahead")
    began_us = rig.trigger("attacker")
    rig.watch(ATTACKED_S)
    rows = [row for row in rig.motors() if row.t_us >= began_us]
    backwards = sum(row.left_rad_s + row.right_rad_s < 0 for row in rows)
    at_us = monotonic_us()
    rig.processes.kill("person")
    rig.watch(ATTACKED_S)  # after the lease, an `arm` would let vision drive
    _, stopped = rig.stop_by_operator(moving=False)
    rig.watch(SETTLED_S)
    checks = (
        at_most("motor log lines of the replay", backwards, "lines", 0),
        at_least("speed kept", min(map(wheel_mps, rows)), "m/s", KEPT_MPS),
    )
    return Injected(rig.injected("attacker"), at_us, checks=(*checks, *stopped), from_us=began_us)


def _forge_frames(rig: RobotFixture) -> Injected:
    """Send frames of the future in the robot's name for three seconds. Vision drives within one second after."""
    rig.prepare_operator()
    rig.start_peer("attacker", "driver", source="guest", fault="future_frames")
    rig.until(lambda: bool(rig.sent("attacker")), 15.0, "the attacker's link")
    rig.trigger("attacker")
    rig.until(lambda: rig.injected("attacker") > ENOUGH, 15.0, "forged frames")
    rig.watch(ATTACKED_S)
    times = rig.injected("attacker")
    rig.processes.kill("attacker")
    at_us = monotonic_us()
    rig.until(lambda: wheel_mps(rig.motors()[-1]) > 0 and rig.motors()[-1].t_us > at_us, 5.0, "vision driving again")
    again_ms = (next(row.t_us for row in rig.motors() if row.t_us > at_us and wheel_mps(row) > 0) - at_us) / 1000
    rig.wait_speed(rig.setup.at_speed_mps)
    _, stopped = rig.stop_by_operator(moving=True)
    return Injected(times, at_us, checks=(at_most("drives again after", again_ms, "ms", 1000.0), *stopped))


def _take_over(rig: RobotFixture) -> Injected:
    """Let an operator take over at full speed and drive back, then lose it. Vision must not end this stop."""
    rig.start_peer("person", "driver", source="teleop", linear_mps=-0.4, angular_rad_s=0.0)
    rig.until(lambda: _goes_back(rig), 15.0, "a takeover")
    took_ms = (monotonic_us() - rig.sent("person")[0].t_us) / 1000
    rig.watch(0.5)
    at_us = monotonic_us()
    rig.processes.kill("person")
    rig.watch(SETTLED_S + 1.0)
    applied = at_most("operator applied after", took_ms, "ms", 1000.0)
    return Injected(1, at_us, checks=(applied,), from_us=rig.sent("person")[0].t_us)


def _goes_back(rig: RobotFixture) -> bool:
    last = rig.motors()[-1]
    return last.left_rad_s < 0 and last.right_rad_s < 0 and wheel_mps(last) > 0.39


def _holder_dies(rig: RobotFixture) -> Injected:
    """Kill the driver while another waits: a stop first, the other drives only after the lease."""
    rig.start_peer("second", "driver", linear_mps=0.3)
    rig.until(lambda: len(rig.sent("second")) > 10, 15.0, "a second driver")
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(ATTACKED_S)
    last_us = rig.sent("peer")[-1].t_us
    moving = [row.t_us for row in rig.motors() if row.t_us > last_us + LEASE_US // 2 and wheel_mps(row) > 0]
    waited_ms = (moving[0] - last_us) / 1000 if moving else 0.0
    checks = (at_least("next driver after", waited_ms, "ms", LEASE_US / 1000 - 20),)
    return Injected(1, at_us, last_us + LEASE_US - 20_000, bool(moving), checks)


# --- services that share robots --------------------------------------------------------------------------------------


OWNER, STANDBY = "a", "b"
"""Names of two services; the first is the better choice of the bench's robot."""
RIGHT_RAD_S: Final = -0.4
"""The first driver turns left."""
KILLED_GAP_MS: Final = 250.0
JOINED_GAP_MS: Final = 150.0
ENDS_S: Final = 1.0
_SIDE_RAD_S: Final = 0.3
"""The wheels of a circle at 0.4 rad/s differ by more than this."""


def drivers_of(rows: Sequence[MotorRow]) -> list[int]:
    """Return the direction of each driver in turn: 1 turns left, -1 right."""
    differences = (row.right_rad_s - row.left_rad_s for row in rows)
    sides = (1 if one > 0 else -1 for one in differences if abs(one) > _SIDE_RAD_S)
    return [side for side, _ in itertools.groupby(sides)]


def handover_checks(
    rows: Sequence[MotorRow], sent: Sequence[SentCommand], changes: int, gap_ms: float, until_us: int
) -> Iterator[Check]:
    """Yield the checks of a robot that drives while its driver changes.

    Args:
        rows: the motor log.
        sent: commands of all drivers, from before the first change on.
        changes: changes of the driver.
        gap_ms: longest time between two commands.
        until_us: end of the measurement; later the robot may stand.
    """
    driven = [row for row in rows if sent[0].t_us <= row.t_us <= until_us]
    times = [*(one.t_us for one in sent if one.t_us <= until_us), until_us]
    longest_us = max(after - before for before, after in itertools.pairwise(times))
    changed = len(drivers_of(rows)) - 1
    yield at_least("speed kept", min(map(wheel_mps, driven)), "m/s", KEPT_MPS)
    yield at_most("between two commands", longest_us / 1000, "ms", gap_ms)
    yield at_least("changes of the driver", changed, "", changes)
    yield at_most("no more changes", changed, "", changes)


def _goes(rig: RobotFixture, side: int) -> bool:
    return drivers_of(rig.motors()[-1:]) == [side]


def _join(rig: RobotFixture, name: str, line: str) -> None:
    """Start a second service, which turns right, and wait until it logs `line`."""
    rig.start_peer("second", "shared", share=name, angular_rad_s=RIGHT_RAD_S)
    rig.processes.wait_line("second", line)


def _sent_from(rig: RobotFixture, from_us: int) -> list[SentCommand]:
    return [one for one in rig.sent() if one.t_us >= from_us]


def _kill_owner(rig: RobotFixture) -> Injected:
    """Kill the driving one of two services. The other one drives on."""
    _join(rig, STANDBY, "stands by")
    rig.watch(SETTLED_S)
    at_us = monotonic_us()
    rig.processes.kill("peer")
    rig.watch(ATTACKED_S)
    sent = _sent_from(rig, at_us - LEASE_US)
    checks = tuple(handover_checks(rig.motors(), sent, 1, KILLED_GAP_MS, at_us + int(ATTACKED_S * 1e6)))
    return Injected(1, at_us, checks=checks, from_us=at_us - LEASE_US)


def _hand_over(rig: RobotFixture) -> Injected:
    """Let a better choice join and drive, then end it by SIGTERM. The former service drives again."""
    from_us = monotonic_us()
    _join(rig, OWNER, "drives it")
    rig.until(lambda: _goes(rig, -1), 5.0, "the second service driving")
    rig.watch(SETTLED_S)
    at_us = monotonic_us()
    rig.processes.signal("second", signal.SIGTERM)
    code = rig.processes.exit_code("second", 5 * ENDS_S)
    ended_s = (monotonic_us() - at_us) / 1e6
    rig.watch(SETTLED_S)
    until_us = monotonic_us()
    first_us = rig.sent("second")[0].t_us
    overlaps = sum(first_us < one.t_us < at_us for one in rig.sent("peer"))
    checks = handover_checks(rig.motors(), _sent_from(rig, from_us), 2, JOINED_GAP_MS, until_us)
    return Injected(2, at_us, from_us=from_us, checks=(
        *checks, at_most("commands beside the driver", overlaps, "", 0), at_most("ends after", ended_s, "s", ENDS_S),
        at_most("exit code", code, "", 0),
    ))


def _drive_without_token(rig: RobotFixture) -> Injected:
    """End the token of a driver that continues; a service drives. Then kill the service; the driver continues."""
    _join(rig, STANDBY, "shares robots")
    rig.watch(LEASE_US / 2e6)
    ended_us = rig.trigger()
    rig.until(lambda: _goes(rig, -1), 5.0, "the service driving")
    rig.watch(SETTLED_S)
    at_us = monotonic_us()
    rig.processes.kill("second")
    rig.watch(ATTACKED_S)
    sent = _sent_from(rig, ended_us - LEASE_US // 2)
    checks = handover_checks(rig.motors(), sent, 1, KILLED_GAP_MS, at_us)
    return Injected(rig.injected(), at_us, checks=tuple(checks), from_us=ended_us)


def _command_case(name: str, what: str, *, short: bool = False) -> FaultCase:
    return FaultCase(f"command.{name}", f"commands: {what}", _attack, Setup(fault=name), short=short)


COMMAND_CASES: Final = (
    _command_case("late", "each 500 ms after its frame"),
    _command_case("replay", "this session's, replayed", short=True),
    FaultCase("command.earlier", "commands: an earlier session's, replayed", _replay_earlier, Setup()),
    _command_case("never_issued", "citing frames never issued"),
    _command_case("from_future", "citing frames from the future"),
    _command_case("wrapped", "their numbers wrap"),
    _command_case(
        "malformed", "nan, inf, 1e400, underscores, full-width, empty, 3 fields, 257 bytes, 10 MB, binary ..."
    ),
    FaultCase(
        "command.flood", "commands: an old one at 10 kHz", partial(_attack, at_least_times=FLOOD_AT_LEAST),
        Setup(fault="flood"), also=f">= {FLOOD_AT_LEAST} sent", short=True, alone=True
    ),
    FaultCase(
        "command.reversal", "commands: full speed ahead and back at 50 Hz", _reverse, Setup(fault="reversal"),
        also=f"speed changes by <= {GAIN_MPS2:g} m/s2"
    ),
    _command_case("heartbeat", "none, but frames are acknowledged and the link is alive", short=True),
    FaultCase("driver.two", "drivers: two vision services, then none", _two_visions, Setup(),
              also="the second is not applied"),
    FaultCase("identity.copied", "drivers: a copied identity, certificate of the same role; then the driver dies",
              partial(_impersonate, session=SESSION), Setup(secure=True),
              also=f"0 motor log lines of the copy; {_STOPS}"),
    FaultCase("identity.role", "drivers: a copied identity, certificate of an operator; then the driver dies",
              partial(_impersonate, session=SESSION, certificate="operator"), Setup(secure=True),
              also=f"0 motor log lines of the copy; {_STOPS}"),
    FaultCase("identity.requests", "drivers: release, acquire, arm and reset in an operator's name; then it dies",
              partial(_impersonate, fault="copied_requests", source="teleop", session=SESSION),
              Setup(source="teleop", secure=True), also=f"0 motor log lines of the copy; {_STOPS}"),
    FaultCase("identity.replayed", "drivers: an operator's twists, acquire, arm and reset, replayed (secured); it dies",
              _replay_driver, Setup(secure=True), blind=True, also=f"0 motor log lines of the replay; {_STOPS}"),
    FaultCase("frame.future", "vision: forged frames of the future for 3 s", _forge_frames, VISION, stops=False,
              also=f"drives again <= 1000 ms after they end; {_STOPS_MOVING}"),
    FaultCase(
        "driver.person", "drivers: an operator takes over at full speed, and is lost", _take_over, Setup(), blind=True,
        also="applied <= 1000 ms; vision does not resume by itself"
    ),
    FaultCase(
        "driver.dies", "drivers: the holder dies while another waits", _holder_dies, Setup(), blind=True, again=True,
        also="the other drives only after the lease"
    ),
    FaultCase("token.end", "tokens: the driving one of two services that share is killed", _kill_owner,
              Setup("shared", routed=True, share=OWNER), stops=False, alone=True,
              also=f"the other drives on: speed >= {KEPT_MPS:g} m/s, <= {KILLED_GAP_MS:g} ms between commands"),
    FaultCase("token.handover", "tokens: a better choice joins, then ends by SIGTERM", _hand_over,
              Setup("shared", routed=True, share=STANDBY), stops=False, alone=True,
              also=f"speed >= {KEPT_MPS:g} m/s, <= {JOINED_GAP_MS:g} ms between commands, one driver at a time; "
              f"ends <= {ENDS_S:g} s"),
    FaultCase("token.late", "tokens: a driver goes on after the end of its token, also when its successor is killed",
              _drive_without_token, Setup(fault="after_token", routed=True, share="former"), alone=True,
              also=f"0 motor log lines of it; until the kill speed >= {KEPT_MPS:g} m/s"),
)
