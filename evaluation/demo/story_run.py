"""Runs the two takes of the story: Sightline, then a naive robot in the same scene. Shell (processes).

Simulation, robot, vision service and relay are processes. "Wi-Fi lost" stops the relay, through which every byte
between vision service and robot passes. The runner itself reads the robot's messages past the relay.
"""

import json
import shutil
import signal
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sightline.evaluation.baselines.naive import READY as NAIVE_READY
from sightline.evaluation.checks import check_lines, to_dict
from sightline.evaluation.demo.relay import READY as RELAY_READY
from sightline.evaluation.demo.run import MOTOR_LOG, ROBOT, arm_robot, open_truth, run_folder
from sightline.evaluation.demo.story import (
    AFTER_S,
    AGAIN_S,
    NAIVE_NAME,
    SAFE_NAME,
    WALL_S,
    Arrival,
    Event,
    Image,
    StateAt,
    Story,
    Take,
    compose,
    has_fast_command,
    heads_for_wall,
    wall_us,
)
from sightline.evaluation.faults.evidence import read_motors
from sightline.evaluation.processes import Processes, free_port, terminated_like_interrupted
from sightline.evaluation.scenario_config import robot_of, robot_table, vision_table
from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.operator_side.config.toml_text import toml_text
from sightline.operator_side.preflight import check_out_file, needs
from sightline.protocol.channels import FRAME, STATUS, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import decode
from sightline.protocol.errors import CheckError, ConfigError, HardwareError, WireError
from sightline.protocol.messages import AnswerHeader, FrameHeader, Status
from sightline.protocol.text import parse_twist
from sightline.protocol.transports.link import Link, Message
from sightline.protocol.transports.open import open_link
from sightline.sim.bus import TruthReader
from sightline.sim.scenario import Scenario, load_scenario
from sightline.sim.toml_file import laid_over
from sightline.sim.truth import Truth

SCENE: Final[dict[str, Any]] = {
    "summary": "a ball goes round a room, close to its walls", "stand_off_m": 0.6, "look": "plain", "seconds": 120.0,
    # The ball waits until the robot is armed. Then it moves along the south wall and turns before the east wall.
    "target": {
        "kind": "path", "speed_mps": 0.4, "waits_s": 14.0, "phase": [0.0, 0.0], "start_m": [-1.0, -1.35],
        "color": [0.95, 0.78, 0.05],
        "path": [
            {"length_m": 2.6}, {"length_m": 0.549779, "turn_deg": 90.0},
            {"length_m": 2.0}, {"length_m": 0.549779, "turn_deg": 90.0},
            {"length_m": 3.2}, {"length_m": 0.549779, "turn_deg": 90.0},
            {"length_m": 2.0}, {"length_m": 0.549779, "turn_deg": 90.0}, {"length_m": 0.6},
        ],
    },
    "start": {"distance_m": [0.6, 0.6], "bearing_deg": [-3.0, 3.0], "approach_deg": [178.0, 182.0]},
    "walls": [
        {"start_m": [-2.2, -1.75], "end_m": [2.12, -1.75], "height_m": 0.22, "color": [0.60, 0.64, 0.72]},
        {"start_m": [-2.2, 1.6], "end_m": [2.12, 1.6], "height_m": 0.22, "color": [0.60, 0.64, 0.72]},
        {"start_m": [-2.2, -1.75], "end_m": [-2.2, 1.6], "height_m": 0.22, "color": [0.60, 0.64, 0.72]},
        {"start_m": [2.12, -1.75], "end_m": [2.12, 1.6], "height_m": 0.22, "color": [0.36, 0.46, 0.66]},
    ],
}
SCENARIO: Final = "scenario.toml"
OUTAGE_S: Final = 3.6
"""Duration of the radio outage. A robot that drives on hits the wall within it."""
_IN_FLIGHT_S: Final = 0.1
"""Time in which a command that passed the relay before its stop arrives."""
_FOLLOWS_MPS: Final = 0.2
_MOVES_S: Final = 60.0
_AGAIN_WITHIN_S: Final = 40.0
_DYING_S: Final = 1.0
_SILENT_S: Final = 2.0
_STEADY_US: Final = 700_000


class Witness:
    """Stores the messages on a robot's link. Callbacks only append."""

    def __init__(self, link: Link, take: Take) -> None:
        self._take = take
        for channel, store in ((FRAME, self._frame), (TWIST, self._twist), (STATUS, self._status)):
            link.subscribe(channel, store)

    def _frame(self, message: Message) -> None:
        self._take.images.append(Image(decode(FrameHeader, message.header).t_us, message.payload))

    def _twist(self, message: Message) -> None:
        try:
            echo, twist = decode(AnswerHeader, message.header).echo, parse_twist(message.payload)
        except WireError:
            return
        if echo is not None:
            self._take.arrivals.append(Arrival(monotonic_us(), echo.t_us, twist.linear_mps))

    def _status(self, message: Message) -> None:
        status = decode(Status, message.payload, STATUS.max_payload_bytes)
        self._take.states.append(StateAt(monotonic_us(), status.state.value))


class TakeProcesses:
    """The processes of one take, as a context manager: simulation, robot, relay and vision service."""

    def __init__(self, take: Take, folder: Path, seed: int) -> None:
        self.take, self._folder, self._seed = take, folder, seed
        self._ending = ExitStack()
        self._truth: TruthReader
        self.operator: Operator
        self.processes: Processes

    def __enter__(self) -> "TakeProcesses":
        with self._ending:
            self._start()
            self._ending = self._ending.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.close()

    def _start(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        self.processes = self._ending.enter_context(Processes(self._folder))
        self._sockets = self.processes.temporary_folder()
        self._robot_port, self._relay_port = free_port(), free_port()
        write_configuration(self._folder, self._sockets, self._seed)
        scenario = str(self._folder / SCENARIO)
        self.processes.start("sim", ["sim", "--config", str(self._folder / "sim.toml"), "--scenario", scenario,
                                     "--seed", str(self._seed), "--motor-log", str(self._folder / MOTOR_LOG),
                                     "--socket-dir", self._sockets])
        self.processes.wait_line("sim", "simulation ready")
        self._start_robot(f"tcp/127.0.0.1:{self._robot_port}")
        self.processes.start("relay", [str(self._relay_port), str(self._robot_port)],
                             module="sightline.evaluation.demo.relay")
        self.processes.wait_line("relay", RELAY_READY)
        link = open_link(ROBOT, connect=[f"tcp/127.0.0.1:{self._robot_port}"], role=SOURCE)
        self._ending.enter_context(link)
        self.operator = Operator(link)
        Witness(link, self.take)
        self._truth = self._ending.enter_context(open_truth(self._sockets))
        self.start_vision()

    def _start_robot(self, endpoint: str) -> None:
        if self.take.name == NAIVE_NAME:
            options = {"robot": ROBOT, "listen": endpoint, "socket_dir": self._sockets}
            self.processes.start("robot", [json.dumps(options)], module="sightline.evaluation.baselines.naive")
            self.processes.wait_line("robot", NAIVE_READY)
            return
        self.processes.start("robot", ["robot", "--robot", ROBOT, "--config", str(self._folder / "robot.toml"),
                                       "--listen", endpoint])
        self.processes.wait_line("robot", f"robot {ROBOT}: on")

    def start_vision(self) -> None:
        """Start a vision service that reaches the robot through the relay only."""
        self.processes.start("vision", ["vision", "--robot", ROBOT, "--config", str(self._folder / "vision.toml"),
                                        "--connect", f"tcp/127.0.0.1:{self._relay_port}"])

    def mark(self, event: Event) -> None:
        """Record that `event` happens now."""
        self.take.events[event] = monotonic_us()

    def watch(self, seconds: float) -> None:
        """Store truth for this long."""
        ends_us = monotonic_us() + round(seconds * 1e6)
        self.until(lambda now: now.t_us >= ends_us, seconds + 5.0, "the end of a scene")

    def until(self, happened: Callable[[Truth], bool], seconds: float, what: str) -> None:
        """Store truth until `happened`. Raises CheckError with `what` after the time limit."""
        deadline_s = time.monotonic() + seconds
        while True:
            self.processes.check()
            now = self._truth.read(timeout_s=_SILENT_S)
            if now is None:
                raise HardwareError(f"the simulation stopped responding; see {self.processes.log('sim')}")
            self.take.truths.append(now)
            if happened(now):
                return
            if time.monotonic() > deadline_s:
                raise CheckError(f"{self.take.name}: no {what} within {seconds:g} s; the logs are in "
                                 f"{self._folder}; run it again on a machine with less load")

    def follows(self, since_us: int) -> Callable[[Truth], bool]:
        """Return a condition: the robot has followed the visible ball for a while, all of it after `since_us`."""
        def happened(now: Truth) -> bool:
            late = [one for one in self.take.truths if one.t_us > max(since_us, now.t_us - _STEADY_US)]
            return now.t_us - since_us > _STEADY_US and all(
                one.visible and one.linear_mps > _FOLLOWS_MPS for one in late)
        return happened

    def read_motors(self) -> None:
        """Read the motor log into the take."""
        self.take.motors = read_motors((self._folder / MOTOR_LOG).read_text("ascii"))


def write_configuration(folder: Path, sockets: str, seed: int) -> Scenario:
    """Write the files of all services to `folder`, so that a user can start the same services."""
    (folder / SCENARIO).write_text(toml_text(SCENE), "utf-8")
    scenario = load_scenario(str(folder / SCENARIO))
    device, model = {"kind": "sim", "options": {"socket_dir": sockets}}, robot_of(scenario)
    files: dict[str, dict[str, Any]] = {
        "sim": {"scenario": str(folder / SCENARIO), "seed": seed, "socket_dir": sockets},
        "robot": laid_over(robot_table(model), {
            "robot": ROBOT, "state_dir": str(Path(sockets) / "state"), "camera": device, "drive": device}),
        "vision": {"robot": ROBOT, **vision_table(scenario, model, seed)},
    }
    for name, table in files.items():
        (folder / f"{name}.toml").write_text(toml_text(table), "utf-8")
    return scenario


def _lose_radio(stage: TakeProcesses) -> None:
    """Drive toward the wall, then stop the relay and watch the consequence."""
    stage.until(lambda now: now.linear_mps > _FOLLOWS_MPS, _MOVES_S, "motion")
    stage.mark("moving")
    while True:
        stage.until(lambda now: heads_for_wall(now, stage.take.arrivals), _MOVES_S, "way to the wall")
        stage.mark("wifi lost")  # before the signal, so that the figures include its duration
        stage.processes.signal("relay", signal.SIGSTOP)
        stage.watch(_IN_FLIGHT_S)
        if has_fast_command(stage.take.arrivals):
            break
        stage.processes.signal("relay", signal.SIGCONT)  # a slower command had passed already
    stage.watch(OUTAGE_S - _IN_FLIGHT_S)


def run_safe(folder: Path, seed: int) -> Take:
    """Take 1: the robot of Sightline loses the radio, then its vision service, then receives STOP."""
    take = Take(SAFE_NAME)
    with TakeProcesses(take, folder, seed) as stage:
        arm_robot(stage.operator, stage.processes)
        _lose_radio(stage)
        stage.processes.signal("relay", signal.SIGCONT)
        stage.mark("wifi back")
        stage.until(stage.follows(monotonic_us()), _AGAIN_WITHIN_S, "motion after the radio was back")
        stage.watch(AGAIN_S)
        stage.mark("vision killed")
        stage.processes.kill("vision")
        stage.watch(AFTER_S)
        stage.start_vision()
        stage.mark("vision back")
        stage.until(stage.follows(monotonic_us()), _AGAIN_WITHIN_S, "motion after the vision service was back")
        stage.watch(AGAIN_S / 2)
        stage.mark("STOP")
        stopping = threading.Thread(target=stage.operator.stop, args=(lambda: None,), name="story STOP", daemon=True)
        stopping.start()
        stage.watch(AFTER_S)
        stopping.join()
        stage.mark("end")
        stage.read_motors()
    return take


def run_naive(folder: Path, seed: int) -> Take:
    """Take 2: the naive robot in the same scene loses the radio at the same place."""
    take = Take(NAIVE_NAME)
    with TakeProcesses(take, folder, seed) as stage:
        _lose_radio(stage)
        hit_us = wall_us(take.truths, take.events["wifi lost"])
        if hit_us is not None:
            take.events["wall"] = hit_us
            stage.watch(max(0.1, WALL_S - (monotonic_us() - hit_us) / 1e6))
        stage.mark("end")
        stage.processes.signal("relay", signal.SIGCONT)
        stage.read_motors()
    return take


def run_takes(folder: Path, seed: int, show: Callable[[str], None]) -> tuple[Take, Take]:
    """Run both takes in `folder`.

    Raises ConfigError, LinkError or the failure of a process; nothing is left running.
    """
    takes = []
    for number, (name, run) in enumerate((("sightline", run_safe), ("naive", run_naive)), start=1):
        show(f"running {number} of 2: {name}, up to 1 minute; the logs are in {folder / name}")
        take = run(folder / name, seed)
        (folder / name / "events.json").write_text(json.dumps(take.events, indent=2) + "\n", "utf-8")
        takes.append(take)
    return takes[0], takes[1]


# `sightline demo --story`: both takes, the figures, the film. Shell (files).


FILM: Final = "story.webp"
SPACE_BYTES: Final = 10_000_000
"""Logs and film of a story need a third of this."""


@dataclass(frozen=True, slots=True)
class StoryResult:
    """A finished story: its figures and its files in `folder`."""

    story: Story
    folder: Path
    images: int

    def to_dict(self) -> dict[str, Any]:
        """Return the content of `--json` and story.json."""
        story = self.story
        stops = {"wifi_lost": story.wifi, "vision_killed": story.vision, "stop": story.stop}
        return {
            **to_dict(story.checks),
            "stops": {name: {"zero_ms": figure.ms, "distance_m": figure.m} for name, figure in stops.items()},
            "naive": {"wall_ms": story.naive_ms, "distance_m": story.naive_m, "speed_mps": story.naive_mps},
            "folder": str(self.folder), "film": str(self.folder / FILM), "images": self.images,
        }

    def lines(self) -> list[str]:
        """Return the closing lines: figures with bounds, and paths of the files."""
        return [*check_lines(self.story.checks), f"left in {self.folder}: {FILM} story.json sightline naive"]


def make_story(out: Path | None, seed: int, show: Callable[[str], None]) -> StoryResult:
    """Run both takes and write the film.

    Raises ConfigError for a place that cannot be written or is too small, if possible before any run.
    """
    with needs("report"):
        from sightline.evaluation.demo.story_film import write_story
    folder = run_folder(out, f"story-{seed}")
    check_out_file(folder / FILM)
    check_space(folder, shutil.disk_usage(folder).free)
    try:
        with terminated_like_interrupted():
            story = compose(*run_takes(folder, seed, show))
        scenario = load_scenario(str(folder / "sightline" / SCENARIO))
        images = write_story(folder / FILM, story, scenario, robot_of(scenario), show=show)
        result = StoryResult(story, folder, images)
        (folder / "story.json").write_text(json.dumps(result.to_dict(), indent=2) + "\n", "utf-8")
    except OSError as error:
        raise ConfigError(f"run folder {folder}: {error.strerror or error}; pass another with --out") from None
    return result


def check_space(folder: Path, free_bytes: int) -> None:
    """Raise ConfigError if the logs and the film would not fit."""
    if free_bytes < SPACE_BYTES:
        raise ConfigError(f"run folder {folder}: {free_bytes / 1e6:.1f} MB free, the story needs "
                          f"{SPACE_BYTES / 1e6:.0f} MB; free some space or pass another folder with --out")
