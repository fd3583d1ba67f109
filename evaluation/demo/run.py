"""Starts, arms, watches and ends the three processes of a demo. Shell."""

import fcntl
import math
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from sightline.evaluation.demo.shaped_vision import Shape
from sightline.evaluation.processes import Processes, free_port, terminated_like_interrupted
from sightline.evaluation.scenario_config import robot_of, robot_table, vision_config, vision_table
from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.operator_side.client.status import millis, twist_text
from sightline.operator_side.config.errors import no_such_name
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.config.toml_text import toml_text
from sightline.operator_side.preflight import writes
from sightline.operator_side.recording.recorder import Recorder
from sightline.operator_side.recording.replay import VISION_CONFIG
from sightline.operator_side.terminal import LiveBlock
from sightline.protocol.errors import CheckError, ConfigError, HardwareError, SightlineError, home_path
from sightline.protocol.messages import Status
from sightline.protocol.transports.open import open_link
from sightline.sim.bus import TruthReader
from sightline.sim.scenario import Scenario, load_scenario
from sightline.sim.toml_file import laid_over
from sightline.sim.truth import Truth
from sightline.vision_side.detect.registry import BOXES, check_choice, check_takes_pictures
from sightline.vision_side.missions.registry import configured_mission


def _lines(status: Status | None, truth: Truth, stand_off_m: float) -> list[str]:
    if status is None:
        return ["robot    no status yet"]
    hidden = "" if truth.visible else ", not visible"
    return [
        f"state    {status.state}: {status.reason}",
        f"frames   {status.stream.fps:.0f} fps, age {millis(status.frame_age_us)}",
        f"wheels   {twist_text(status.applied)}",
        f"bearing  {math.degrees(truth.bearing_rad):+.1f} deg{hidden}",
        f"distance {truth.distance_m:.2f} m, to keep {stand_off_m:.2f} m",
    ]


# `sightline demo`: starts, arms, watches and ends simulation, robot and vision service. Shell.
#
# They are `sightline sim`, `robot` and `vision`; their configuration lies in the run folder.


ROBOT: Final = "r1"
ARM_S: Final = 15.0
_DYING_S: Final = 1.0
_SILENT_S: Final = 2.0
"""Time without data from the simulation; longer than a busy machine delays it."""
RECORDING: Final = "run.mcap"
MOTOR_LOG: Final = "motors.csv"
_MARKS: Final = ("sim.log", "sightline/sim.log")
"""Files of an earlier run or story. The next one in the same folder replaces them."""
_RESULTS: Final = ("score.json", "trajectory.png", "run.mp4", RECORDING, MOTOR_LOG, "robot.log", "vision.log",
                   "labels.log")
"""Results that the next run removes first. If it fails, they must not pass for its own."""
OTHER_FOLDER: Final = "free some space or pass another folder with --out"
TRANSPORTS: Final = {"zenoh": "tcp/127.0.0.1:{}", "websocket": "ws://127.0.0.1:{}", "legacy": "ws-legacy://127.0.0.1:{}"}
"""Endpoint of the vision service by transport. The operator and the recorder always use Zenoh."""


_USUAL_S: Final = 20.0


@dataclass(frozen=True, slots=True)
class DemoOptions:
    """The options of a demo. `seconds` 0 runs until Ctrl-C."""

    scenario: str = "circle"
    seconds: float = _USUAL_S
    seed: int = 1
    latency_ms: float = 0.0
    loss: float = 0.0
    out: Path | None = None
    transport: str = "zenoh"
    mission: str | None = None
    """Mission in place of the scenario's own."""
    detector: str | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError for options that cannot run."""
        for option, value, is_valid, expected in (
            ("--seconds", self.seconds, 0 <= self.seconds <= 3600, "0 to 3600"),
            ("--latency-ms", self.latency_ms, 0 <= self.latency_ms <= 10_000, "0 to 10000"),
            ("--loss", self.loss, 0 <= self.loss < 1, "a share from 0 to below 1, e.g. 0.1"),
            ("--seed", self.seed, 0 <= self.seed < 2**32, "0 to 4294967295"),
        ):
            if not is_valid:
                raise ConfigError(f"{option} {value}: expected {expected}")
        if self.transport not in TRANSPORTS:
            raise ConfigError(no_such_name("--transport", self.transport, TRANSPORTS))


def usual_s(scenario: Scenario) -> float:
    """Return the length of a demo without --seconds: that of the course, or 20 s."""
    is_course = scenario.goals_m or scenario.light or "least_passes" in scenario.bounds
    return scenario.seconds if is_course else _USUAL_S


@dataclass(slots=True)
class DemoRun:
    """The result of a run, next to the files in `folder`."""

    options: DemoOptions
    scenario: Scenario
    folder: Path
    samples: list[Truth] = field(default_factory=list)
    holds: int = 0
    """HOLDs after the first motion, by the log of the robot: a status every 100 ms would miss short ones."""
    dropped_by_recorder: int = 0
    recorder_failed: str = ""
    killed: list[str] = field(default_factory=list)
    interrupted: bool = False


def run_demo(options: DemoOptions, print_line: Callable[[str], None]) -> DemoRun:
    """Run a demo. Raises ConfigError, LinkError, CheckError, the failure of a process, or an early KeyboardInterrupt.

    Nothing is left running in any case.
    """
    scenario = load_scenario(options.scenario)
    _check_vision(options, scenario)
    run = DemoRun(options, scenario, run_folder(options.out, f"{scenario.name}-{options.seed}"))
    for file in map(run.folder.joinpath, _RESULTS):
        with writes(file, OTHER_FOLDER):
            file.unlink(missing_ok=True)
    with ExitStack() as ending:
        ending.enter_context(terminated_like_interrupted())
        processes = ending.enter_context(Processes(run.folder))
        try:
            _drive(run, processes, processes.temporary_folder(), print_line)
        except KeyboardInterrupt:
            if not run.samples:  # there is nothing to score
                raise
            run.interrupted = True
        except SightlineError:
            processes.check(_DYING_S)  # the process that ended is the cause, not the error that it caused here
            raise
        run.killed = processes.end()
    return run


def _check_vision(options: DemoOptions, scenario: Scenario) -> None:
    """Raise ConfigError before any start for a mission or detector that the vision service would reject."""
    config = vision_config(scenario, robot_of(scenario), options.seed, options.mission)
    configured_mission(config)
    kind = options.detector
    if kind is None or (kind == BOXES and scenario.labels):
        return
    if kind == BOXES:
        raise ConfigError(f"--detector {BOXES}: no service publishes boxes in {scenario.name}; choose a local one, "
                          "e.g. hsv")
    check_takes_pictures(kind)
    check_choice(kind, {}, config)


def _drive(run: DemoRun, processes: Processes, sockets: str, print_line: Callable[[str], None]) -> None:
    options, endpoint = run.options, TRANSPORTS["zenoh"].format(free_port())
    for_vision = endpoint if options.transport == "zenoh" else TRANSPORTS[options.transport].format(free_port())
    listen = [part for end in dict.fromkeys((endpoint, for_vision)) for part in ("--listen", end)]
    _write_configuration(run, sockets)
    print_line(f"simulation, robot and vision start as three processes; their logs are in {run.folder}")
    # The options of the run are on the command lines, because the environment takes precedence over files.
    processes.start("sim", ["sim", "--config", str(run.folder / "sim.toml"), "--scenario", options.scenario,
                            "--seed", str(options.seed), "--motor-log", str(run.folder / MOTOR_LOG),
                            "--socket-dir", sockets])
    processes.wait_line("sim", "simulation ready")
    processes.start("robot", ["robot", "--robot", ROBOT, "--config", str(run.folder / "robot.toml"), *listen])
    processes.wait_line("robot", f"robot {ROBOT}: on")
    with (
        open_link(ROBOT, connect=[endpoint], role=SOURCE) as link,
        Recorder(link, run.folder / RECORDING, _about(run)) as recorder,
        open_truth(sockets) as truth,
        LiveBlock(is_progress=True) as block,
    ):
        operator = Operator(link)
        if run.scenario.labels:
            processes.start("labels", ["labels", ROBOT, "--connect", endpoint, "--socket-dir", sockets])
        processes.start("vision", _vision_arguments(run, for_vision))
        arm_robot(operator, processes)
        try:
            _watch(run, processes, operator, truth, block, failure=lambda: recorder.failed)
        finally:
            run.holds = holds_in(processes.log("robot").read_text("utf-8", "replace"))
            recorder.close()
            run.dropped_by_recorder, run.recorder_failed = recorder.dropped, recorder.failed


def arm_robot(operator: Operator, processes: Processes) -> None:
    """Repeat the arm request until the robot receives live commands. Otherwise raises with the robot's reason."""
    deadline_s = time.monotonic() + ARM_S
    while True:
        processes.check()
        operator.wait_report()
        reply = operator.arm(patience_s=0.5)
        if reply.ok:
            return
        if time.monotonic() > deadline_s:
            raise CheckError(
                f"the robot would not be armed: {reply.detail}; see vision.log in the run folder for the cause"
            )


def _watch(
    run: DemoRun, processes: Processes, operator: Operator, truth: TruthReader, block: LiveBlock, *,
    failure: Callable[[], str],
) -> None:
    """Collect and show the truth until the time is over, or the recording fails."""
    _discard_old(truth)
    started_s = time.monotonic()
    seconds = run.options.seconds
    end_s, until = (started_s + seconds, f"of {seconds:g} s") if seconds else (float("inf"), "s, Ctrl-C ends it")
    while time.monotonic() < end_s and not failure():
        processes.check()
        sample = truth.read(timeout_s=_SILENT_S)
        if sample is None:
            raise HardwareError("the simulation stopped responding; see sim.log in the run folder")
        run.samples.append(sample)
        report = operator.report
        lines = _lines(report.status if report else None, sample, run.scenario.stand_off_m)
        block.show([f"{time.monotonic() - started_s:5.1f} {until}", *lines])


def holds_in(log: str) -> int:
    """Count the HOLDs after the first motion in the log of a robot."""
    states = re.findall(rf" robot {ROBOT}: (ACTIVE|DEGRADED|HOLD) \(", log)
    return sum(state == "HOLD" and before != "HOLD" for before, state in pairwise(states))


def _discard_old(truth: TruthReader) -> None:
    while truth.read(timeout_s=0.0) is not None:
        pass


# --- inputs of the processes -------------------------------------------------------------------------------------


def _write_configuration(run: DemoRun, sockets: str) -> None:
    """Write the file of each service to the run folder, so that an operator can start the same services."""
    device = {"kind": "sim", "options": {"socket_dir": sockets}}
    options, model = run.options, robot_of(run.scenario)
    legacy = options.transport == "legacy"
    files: dict[str, dict[str, Any]] = {
        "sim": {
            "scenario": options.scenario, "seed": options.seed, "socket_dir": sockets,
            "motor_log": str(run.folder / MOTOR_LOG),
        },
        "robot": laid_over(robot_table(model), {
            # Not in the run folder: a STOP ends with its robot, and the next run in that folder drives again.
            "robot": ROBOT, "state_dir": str(Path(sockets) / "state"), "camera": device, "drive": device,
            "safety": {"guests": legacy},
        }),
        "vision": {
            "robot": ROBOT, **vision_table(run.scenario, model, options.seed, options.mission),
            # The legacy protocol has no camera model. The operator of a demo uses the robot, not the vision service.
            **({"camera": model.camera.camera_model().model_dump(), "listen": [f"tcp/127.0.0.1:{free_port()}"]}
               if legacy else {}),
        },
    }
    if options.detector is not None:
        files["vision"] = laid_over(files["vision"], {"detector": {"kind": options.detector}})
    for name, table in files.items():
        file = run.folder / f"{name}.toml"
        with writes(file, OTHER_FOLDER):
            file.write_text(toml_text(table), "utf-8")


def _vision_arguments(run: DemoRun, endpoint: str) -> list[str]:
    options = run.options
    arguments = ["vision", "--robot", ROBOT, "--config", str(run.folder / "vision.toml"), "--connect", endpoint]
    if options.latency_ms or options.loss:
        arguments += ["--shape", Shape(options.latency_ms, options.loss, options.seed).text()]
    return arguments


def _about(run: DemoRun) -> dict[str, str]:
    loaded = load_service("vision", file=str(run.folder / "vision.toml"), environ=os.environ)
    return {VISION_CONFIG: loaded.config.model_dump_json(), "scenario": run.options.scenario}


def run_folder(out: Path | None, name: str) -> Path:
    """Create the folder of a run: `out`, or a new one in `runs`.

    Raises ConfigError if it cannot be created, has files but none of a run, or belongs to a run in progress.
    """
    dated = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{name}"
    folder = home_path(out or Path("runs") / dated).absolute()
    while True:
        try:
            folder.mkdir(parents=True, exist_ok=out is not None)
            if any(folder.iterdir()) and not any((folder / mark).exists() for mark in _MARKS):
                raise ConfigError(f"run folder {folder} has other files; choose a new one with --out")
            _lock(folder)
            return folder
        except OSError as error:
            if out is not None or not isinstance(error, FileExistsError):
                raise ConfigError(f"run folder {folder}: {error.strerror}; choose another with --out") from None
            folder = folder.with_name(folder.name + "-again")  # another run began in the same second


@cache
def _lock(folder: Path) -> int:
    """Keep other processes from running in `folder` until this one ends. Raises ConfigError if one does."""
    number = os.open(folder, os.O_RDONLY)
    with suppress(OSError):  # a file system without locks
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(number)
            raise ConfigError(f"run folder {folder} is of a run in progress; choose another with --out") from None
    return number


@contextmanager
def open_truth(sockets: str) -> Iterator[TruthReader]:
    """Open the truth of the simulation of this folder."""
    reader = TruthReader(sockets)
    try:
        yield reader
    finally:
        reader.close()
