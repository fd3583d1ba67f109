"""Cases with separate scenes: takeover, uplink, forty robots, STOP through a full medium. Shell (processes).

The score uses the wheel commands: they stop, and turn again.
"""

import json
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, Final

from sightline.benchmarks.loop.figures import WheelCommand, percentile, read_wheel_commands
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.network.cases import NetworkCase
from sightline.benchmarks.network.figures import moves_again_s, sent_between
from sightline.benchmarks.network.robots import Settings
from sightline.benchmarks.network.stage import (
    DETECTOR,
    EVERYWHERE,
    NetworkRun,
    ShapedWire,
    Stage,
    start_robot,
    start_vision,
)
from sightline.benchmarks.network.stop_client import RESET, STOPPED
from sightline.evaluation.checks import Check, at_least, at_most
from sightline.evaluation.faults.evidence import (
    REQUESTED,
    ZERO_MS,
    MotorRow,
    measure_stop,
    moved_on_old_sight,
    wheel_mps,
)
from sightline.evaluation.faults.fixture import ROBOT, RobotFixture, Setup
from sightline.evaluation.processes import Processes
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import HardwareError, SightlineError
from sightline.sim.network_emulator import LinkShapes
from sightline.sim.tun_emulator import ADDRESS_A, ADDRESS_B, move_address

TAKES_OVER_S: Final = 1.5
BACK_S: Final = 3.0
"""The lease of 2 s reveals a dead link. Then connections are tried every 0.2 to 1 s."""
DOWN_S: Final = 1.0
_STEADY_S: Final = 1.5
"""Time before the next harm, for everything to recover."""
_PATIENCE_S: Final = 10.0
_OTHER_ADDRESS: Final = "10.213.77.3"


def standby(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Run two vision services. Repeatedly kill the driving one and start a new standby, until the end of the time."""
    endpoint = stage.form.format(ADDRESS_A)
    with _on_site(row, stage) as (wire, ending):
        start_robot(stage, ending.enter_context(stage.processes("robot")), wire.robot_side)
        visions: list[tuple[Processes, int]] = []

        def start() -> None:
            processes = ending.enter_context(stage.processes(f"vision{len(visions)}"))
            visions.append((processes, start_vision(stage, processes, wire.far_side, endpoint)))

        def harm() -> int:
            start()
            time.sleep(_STEADY_S)
            killed_us = monotonic_us()
            os.kill(visions[-2][1], signal.SIGKILL)
            return killed_us

        start()
        return _checks(row, stage, harm, TAKES_OVER_S)


def router(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Run all services as clients of a router that is killed. The time counts from the new router."""
    with _on_site(row, stage) as (wire, ending):
        groups: list[tuple[Processes, int]] = []

        def start() -> None:
            processes = ending.enter_context(stage.processes(f"router{len(groups)}"))
            groups.append((processes, start_router(processes, wire)))

        def harm() -> int:
            time.sleep(_STEADY_S)
            os.kill(groups[-1][1], signal.SIGKILL)
            time.sleep(DOWN_S)
            start()
            return monotonic_us()

        start()
        _start_clients(stage, wire, ending)
        return _checks(row, stage, harm, BACK_S, stands=True)


def moved(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Change the address of the robot's end of the wire, and change it back the next time."""
    addresses = [ADDRESS_A, _OTHER_ADDRESS]
    with _on_site(row, stage) as (wire, ending):

        def harm() -> int:
            time.sleep(_STEADY_S)
            moved_us = monotonic_us()
            move_address(wire.robot_side, *addresses)
            addresses.reverse()
            return moved_us

        start_router(ending.enter_context(stage.processes("router")), wire)
        _start_clients(stage, wire, ending)
        return _checks(row, stage, harm, BACK_S, stands=True)


def start_router(processes: Processes, wire: ShapedWire) -> int:
    """Start `sightline router` beyond the radio. Returns its process id."""
    pid = processes.start("router", ["router", "--listen", f"tcp/{EVERYWHERE}:7447"], namespace=wire.far_side)
    processes.wait_line("router", "router: on")
    return pid


@contextmanager
def _on_site(row: NetworkCase, stage: Stage) -> Iterator[tuple[ShapedWire, ExitStack]]:
    with stage.wire() as wire, ExitStack() as ending:
        wire.shape(stage.seeded(row.phases[0].shapes))
        yield wire, ending


def _start_clients(stage: Stage, wire: ShapedWire, ending: ExitStack) -> None:
    start_robot(stage, ending.enter_context(stage.processes("robot")), wire.robot_side, connect=f"tcp/{ADDRESS_B}:7447")
    start_vision(stage, ending.enter_context(stage.processes("vision")), wire.far_side, "tcp/127.0.0.1:7447")


def _checks(
    row: NetworkCase, stage: Stage, harm: Callable[[], int], bound_s: float, *, stands: bool = False
) -> NetworkRun:
    """Do `harm` until the time is over. The score is the longest time until the wheels turned again."""
    _wait_moving(stage)
    end_s = time.monotonic() + stage.setting.seconds
    took_s: list[float | None] = []
    while not took_s or time.monotonic() < end_s:
        harmed_us = harm()
        took_s.append(_wait_again(stage, harmed_us))
    facts = {f"time {n}": one for n, one in enumerate(took_s)}
    return NetworkRun(row, stage.seed, len(took_s), (), again_checks(took_s, bound_s, stands=stands), facts)


def again_checks(took_s: Sequence[float | None], bound_s: float, *, stands: bool) -> tuple[Check, Check]:
    """Check the times until the wheels turned again. If the harm `stands`, wheels that never stood show no harm."""
    harmed = [one for one in took_s if one != 0.0 or not stands]
    return (
        at_least("injected", float(len(harmed)), "times", float(len(took_s))),
        at_most("drives again after, worst", _worst(took_s), "s", bound_s),
    )


def _worst(took_s: Sequence[float | None]) -> float | None:
    known = [one for one in took_s if one is not None]
    return max(known) if len(known) == len(took_s) else None


def _wait_moving(stage: Stage) -> None:
    deadline_s = time.monotonic() + _PATIENCE_S
    while not any(row.moves for row in _wheel_commands(stage)):
        if time.monotonic() > deadline_s:
            raise HardwareError(f"the wheels do not turn within {_PATIENCE_S:g} s of all being on")
        time.sleep(0.1)


def _wait_again(stage: Stage, harmed_us: int) -> float | None:
    """Wait until the wheels have stood and turned again, or the time limit is over."""
    deadline_s = time.monotonic() + _PATIENCE_S
    again_s = None
    while time.monotonic() < deadline_s and not again_s:
        time.sleep(0.1)
        again_s = moves_again_s(_wheel_commands(stage), harmed_us, monotonic_us())
    return again_s


def _wheel_commands(stage: Stage) -> list[WheelCommand]:
    return read_wheel_commands(stage.wheels.read_text("ascii")) if stage.wheels.exists() else []


# A row of `bench network`: the radio traffic when several clients watch one robot. Shell (processes).
#
# Vision and all other clients are at a router beyond the radio. First vision alone, then with a standby, another reader
# and a viewer.


MOST_SHARE: Final = 1.05
UPLINK_LEAST_FPS: Final = 25.0
"""At a lower rate, traffic other than frames would weigh more on each frame."""
READERS: Final = 2
_AT_ROUTER: Final = "tcp/127.0.0.1:7447"
_UPLINK_SETTLE_S: Final = 2.0


def uplink(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Compare the bytes from the robot per sent frame with several clients and with vision alone."""
    shapes = stage.seeded(row.phases[0].shapes)
    with stage.wire() as wire, ExitStack() as ending:
        before = wire.shape(shapes)
        groups = {name: ending.enter_context(stage.processes(name)) for name in ("site", "standby")}
        start_router(groups["site"], wire)
        # The camera's own JPEGs, so that their size does not depend on the load of the machine.
        start_robot(stage, groups["site"], wire.robot_side, connect=f"tcp/{ADDRESS_B}:7447", passes_through=True)
        start_vision(stage, groups["site"], wire.far_side, _AT_ROUTER)
        _start_notes(groups["site"], wire, stage)
        alone = _stretch(wire, shapes, stage.setting.seconds / 2)
        start_vision(stage, groups["standby"], wire.far_side, _AT_ROUTER)
        groups["site"].start("watcher", [_AT_ROUTER, str(READERS), "0"], module="sightline.benchmarks.loop.viewers",
                             namespace=wire.far_side)
        groups["site"].wait_line("watcher", "watching")
        crowded = _stretch(wire, shapes, stage.setting.seconds / 2)
        for processes in groups.values():
            processes.check()
        injected = wire.shape(LinkShapes()) - before
        groups["site"].end()
    notes = json.loads((stage.folder / "notes.json").read_text("utf-8"))
    return _uplink_run(row, stage, injected, [_stream_of(notes, one) for one in (alone, crowded)])


def _start_notes(processes: Processes, wire: ShapedWire, stage: Stage) -> None:
    arguments = [_AT_ROUTER, str(stage.folder / "notes.json"), "statuses"]
    processes.start("notes", arguments, module="sightline.benchmarks.network.watch", namespace=wire.far_side)
    processes.wait_line("notes", "watching")


def _stretch(wire: ShapedWire, shapes: LinkShapes, seconds: float) -> tuple[int, int, int]:
    """Return (from, until, bytes from the robot in between)."""
    time.sleep(_UPLINK_SETTLE_S)
    wire.shape(shapes)
    begin_us, begin_bytes = monotonic_us(), wire.counts["ab"]["delivered_bytes"]
    time.sleep(seconds)
    wire.shape(shapes)
    return begin_us, monotonic_us(), wire.counts["ab"]["delivered_bytes"] - begin_bytes


def _stream_of(notes: Mapping[str, Sequence[Sequence[Any]]], stretch: tuple[int, int, int]) -> tuple[float, float]:
    """Return (bytes on the radio per frame, frames per second)."""
    begin_us, end_us, carried = stretch
    sent = sent_between(notes["statuses"], begin_us, end_us)
    return carried / max(1.0, sent), sent * 1e6 / (end_us - begin_us)


def _uplink_run(row: NetworkCase, stage: Stage, injected: int, streams: Sequence[tuple[float, float]]) -> NetworkRun:
    (alone_bytes, alone_fps), (crowded_bytes, crowded_fps) = streams
    checks = (
        at_least("injected", float(injected), "", 1.0),
        at_most("bytes from the robot, over one stream", crowded_bytes / max(1.0, alone_bytes), "times", MOST_SHARE),
        at_least("frames while crowded", crowded_fps, "fps", UPLINK_LEAST_FPS),
    )
    facts = {"alone_bytes_per_frame": alone_bytes, "crowded_bytes_per_frame": crowded_bytes, "alone_fps": alone_fps}
    return NetworkRun(row, stage.seed, injected, (), checks, facts)


# A row of `bench network`: forty robots and one vision service for all of them. Shell (processes).


ROBOTS: Final = 40
WIDTH_PX, HEIGHT_PX, FPS = 320, 240, 15.0
FLEET_LEAST_FPS: Final = 14.0
MOST_P95_MS: Final = 80.0
_FLEET_SETTLE_S: Final = 3.0


def fleet(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Run all robots until the end of the time. The worst robot is the score."""
    pictures = stage.folder / "small"
    pictures.mkdir()
    write_pictures(pictures, WIDTH_PX, HEIGHT_PX)
    settings = Settings(endpoint=f"tcp/{ADDRESS_B}:7447", robots=ROBOTS, fps=FPS, pictures=pictures,
                        notes=stage.folder / "notes.json", seed=stage.seed)
    with stage.wire() as wire, stage.processes("processes") as processes:
        before = wire.shape(stage.seeded(row.phases[0].shapes))
        arguments = ["vision", "--robot", "r*", "--detector", DETECTOR, "--listen", f"tcp/{EVERYWHERE}:7447"]
        processes.start("vision", arguments, namespace=wire.far_side)
        processes.wait_line("vision", "looking for robots")
        processes.start("robots", [settings.model_dump_json()], module="sightline.benchmarks.network.robots",
                        namespace=wire.robot_side)
        processes.wait_line("robots", f"playing {ROBOTS} robots")
        time.sleep(_FLEET_SETTLE_S)
        begin_us = monotonic_us()
        time.sleep(stage.setting.seconds)
        end_us = monotonic_us()
        processes.check()
        injected = wire.shape(LinkShapes()) - before
        processes.end()
    answers = json.loads(settings.notes.read_text("utf-8"))
    harmed = at_least("injected", float(injected), "", 1.0)
    return NetworkRun(row, stage.seed, injected, (), (harmed, *fleet_checks(answers, begin_us, end_us)))


def fleet_checks(
    answers: Mapping[str, Sequence[Sequence[int]]], begin_us: int, end_us: int
) -> tuple[Check, Check, Check]:
    """Check the robot with the fewest answers, and the one with the oldest. `answers`: (captured_us, age_us)."""
    seconds = (end_us - begin_us) / 1e6
    ages_ms = [[age_us / 1000 for at_us, age_us in seen if begin_us <= at_us < end_us] for seen in answers.values()]
    least_fps = min((len(one) / seconds for one in ages_ms), default=0.0)
    p95_ms = [percentile(one, 95) for one in ages_ms]
    known = [one for one in p95_ms if one is not None]
    oldest_ms = max(known) if known and len(known) == len(p95_ms) else None
    return (
        at_least("robots", float(len(answers)), "", float(ROBOTS)),
        at_least("answered, least", least_fps, "fps", FLEET_LEAST_FPS),
        at_most("age p95, worst robot", oldest_ms, "ms", MOST_P95_MS),
    )


# A row of `bench network`: one half-duplex medium full of video, and an operator beyond it that sends STOP. Shell.
#
# The score uses the log of the simulated motors, with the robot and the checks of the fault bench.


REACHES_MS: Final = 300.0
REPORTED_MS: Final = REACHES_MS + 100.0
"""By the robot's status, ten times a second: as frames age, wheels slow down by themselves, before any STOP."""
_BESIDE_S: Final = 60.0


def medium(row: NetworkCase, stage: Stage) -> NetworkRun:
    """Repeat STOP and reset until the time is over. Raises HardwareError if a process does not run."""
    try:
        with RobotFixture(stage.folder / "rig", Setup(wired=True, camera="heavy")) as rig:
            return _medium_run(row, stage, rig)
    except SightlineError as error:
        raise HardwareError(str(error)) from None


def _medium_run(row: NetworkCase, stage: Stage, rig: RobotFixture) -> NetworkRun:
    assert rig.wire is not None
    before = rig.wire.shape(stage.seeded(row.phases[0].shapes))
    event_log = rig.folder / "person.events"
    arguments = [rig.endpoint, ROBOT, str(event_log), str(stage.setting.seconds), str(stage.seed)]
    rig.processes.start("person", arguments, module="sightline.benchmarks.network.stop_client",
                        namespace=rig.wire.far_side)
    rig.processes.wait_line("person", "person ready")
    if rig.processes.exit_code("person", stage.setting.seconds + _BESIDE_S) != 0:
        last = rig.processes.log("person").read_text("utf-8").strip()[-200:]
        raise HardwareError(f"the operator process failed: {last}")
    injected = rig.wire.shape(LinkShapes()) - before
    sent_us = [one.t_us for one in rig.noted("person", REQUESTED)]
    rows = rig.motors()
    checks = (
        at_least("injected", float(injected), "", 1.0),
        *stop_checks_of(rows, sent_us, [one.t_us for one in rig.noted("person", RESET)]),
        reported_check(sent_us, [one.frame_us for one in rig.noted("person", STOPPED)]),
        at_most("moved on frames over 400 ms", moved_on_old_sight(rows, rig.sent(), None), "lines", 0),
    )
    return NetworkRun(row, stage.seed, injected, (), checks, {"stops": len(sent_us)})


def stop_checks_of(rows: Sequence[MotorRow], sent_us: Sequence[int], reset_us: Sequence[int]) -> Sequence[Check]:
    """Check the times from each STOP, sent at `sent_us`, to the motor commands and to zero speed. Each must last until
    the wheels turn after its reset.
    """
    ends_us = [_again_us(rows, at_us) for at_us in reset_us]
    pairs = list(zip(sent_us, ends_us, strict=True))
    reached = [reached_ms(_window(rows, at_us, end_us), at_us) for at_us, end_us in pairs]
    zero = [measure_stop(rows, at_us, end_us).zero_ms for at_us, end_us in pairs]
    return (
        at_most(f"STOP reaches the wheels, p99 of {len(reached)}", _p99(reached), "ms", REACHES_MS),
        at_most(f"wheels at zero, p99 of {len(zero)}", _p99(zero), "ms", ZERO_MS),
    )


def reported_check(sent_us: Sequence[int], stopped_us: Sequence[int]) -> Check:
    """Check the time from each STOP to the first status that reports STOPPED."""
    delays_ms = [(stop_us - at_us) / 1000 for at_us, stop_us in zip(sent_us, stopped_us, strict=False)]
    value = percentile(delays_ms, 99) if len(stopped_us) == len(sent_us) else None
    return at_most(f"robot reports STOPPED, p99 of {len(delays_ms)}", value, "ms", REPORTED_MS)


def _again_us(rows: Sequence[MotorRow], reset_us: int) -> int:
    """Return the time just before the wheels turn after the reset; the end of the log if they do not."""
    return next((row.t_us - 1 for row in rows if row.t_us > reset_us and wheel_mps(row) > 0), rows[-1].t_us)


def _window(rows: Sequence[MotorRow], begin_us: int, end_us: int) -> list[MotorRow]:
    """Return the last row before its start, and all rows up to its end."""
    before = [row for row in rows if row.t_us <= begin_us]
    return [*before[-1:], *(row for row in rows if begin_us < row.t_us <= end_us)]


def reached_ms(window: Sequence[MotorRow], sent_us: int) -> float | None:
    """Return the time from STOP to the fall after which the wheels stayed at zero, ms, or None."""
    zero = 1 + max((index for index, row in enumerate(window) if wheel_mps(row) > 0), default=-1)
    if zero == len(window):
        return None
    first = zero
    while first > 1 and wheel_mps(window[first - 2]) > wheel_mps(window[first - 1]):
        first -= 1
    return max(0, window[first].t_us - sent_us) / 1000


def _p99(values: Sequence[float | None]) -> float | None:
    known = [one for one in values if one is not None]
    return percentile(known, 99) if len(known) == len(values) else None
