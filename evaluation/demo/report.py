"""Scores a demo, summarizes it, and writes score.json, trajectory.png and run.mp4. Shell (files)."""

import json
import math
import re
import shlex
import shutil
import sys
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sightline.evaluation.checks import Check, at_most, check_lines, to_dict
from sightline.evaluation.demo.run import MOTOR_LOG, OTHER_FOLDER, RECORDING, DemoRun, usual_s
from sightline.evaluation.demo.shaped_vision import INJECTED
from sightline.evaluation.faults.evidence import read_motors
from sightline.evaluation.processes import last_line
from sightline.evaluation.scenario_config import robot_config, robot_of
from sightline.evaluation.score.figures import (
    NOT_EVALUATED,
    AnsweredFrame,
    RimSpeeds,
    RunRecord,
    Score,
    bounds_of,
    checks_of,
    score,
)
from sightline.evaluation.score.runs import MOST_NOTICES
from sightline.operator_side.client.requests import StatusReport, read_report
from sightline.operator_side.preflight import needs, whole, writes
from sightline.operator_side.recording.recorder import read_recording
from sightline.operator_side.recording.replay import Replayed, replay
from sightline.protocol.channels import STATUS
from sightline.protocol.errors import CheckError, ConfigError, WireError
from sightline.sim.scenario import AT_LEAST

if TYPE_CHECKING:
    from sightline.evaluation.plots import StatusAt

REAL_TIME_FACTOR: Final = 1.5
"""Factor on the bounds of lockstep for a real machine."""
HOLDS_A_MINUTE: Final = 1.0
"""Most HOLDs a minute, up to this loss on each leg and this latency."""
HOLDS_LOSS, HOLDS_LATENCY_MS = 0.2, 50.0


@dataclass(frozen=True, slots=True)
class DemoReport:
    """The score of a run."""

    run: DemoRun
    score: Score
    checks: list[Check]
    replayed: Replayed
    injected: dict[str, Any] | None

    @property
    def ok(self) -> bool | None:
        """Return True if every check passes, None if the scenario has no bounds to check."""
        if not all(check.ok for check in self.checks):
            return False
        return True if bounds_of(self.run.scenario, self.run.options.latency_ms) else None

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of `--json` and score.json."""
        options = self.run.options
        return {
            **to_dict(self.checks), "ok": self.ok,
            "score": asdict(self.score),
            "scenario": options.scenario, "seed": options.seed, "latency_ms": options.latency_ms, "loss": options.loss,
            "replayed": asdict(self.replayed), "injected": self.injected,
            "recorder_dropped": self.run.dropped_by_recorder,
            "interrupted": self.run.interrupted, "folder": str(self.run.folder),
        }


def report(run: DemoRun) -> DemoReport:
    """Score `run`. Raises CheckError for a run that ended before its start, ConfigError for an incomplete recording."""
    recording = run.folder / RECORDING
    if run.recorder_failed:  # without the rest, a run that drove well would fail
        raise ConfigError(f"recording {recording} ends too early to be scored: {run.recorder_failed}; {OTHER_FOLDER}")
    if not run.samples:
        raise CheckError(f"ended before the robot drove; the logs are in {run.folder}")
    answered: list[AnsweredFrame] = []
    replayed = replay(  # the same pipeline gives the same results for the same frames
        recording, lambda step: answered.append(AnsweredFrame.of(step.frame.header.t_us, step.answer.seen)))
    during = [one for one in answered if run.samples[0].t_us <= one.t_us <= run.samples[-1].t_us]
    record = RunRecord(run.samples, during, accepted_us(recording), _wheels(run))
    result = score(run.scenario, record)
    injected = _injected(run)
    checks = _checks(run, result) + _injection_checks(run, injected)
    return DemoReport(run, result, checks, replayed, injected)


def write_files(scored: DemoReport) -> None:
    """Write score.json, trajectory.png and run.mp4 to the run folder. Raises ConfigError if one cannot be written."""
    folder = scored.run.folder
    with writes(folder, OTHER_FOLDER):
        with whole(folder / "score.json") as part:
            part.write_text(json.dumps(scored.to_dict(), indent=2) + "\n", "utf-8")
        _draw(scored.run, folder / RECORDING)


def accepted_us(recording: Path) -> int | None:
    """Return the time of the first status that counts an accepted twist."""
    return next((report.stamp.t_us for report in read_reports(recording) if report.status.accepted), None)


def _wheels(run: DemoRun) -> list[RimSpeeds]:
    """Read the wheel commands from the motor log."""
    radius_m = robot_of(run.scenario).wheels.radius_m
    rows = read_motors((run.folder / MOTOR_LOG).read_text("ascii"))
    return [RimSpeeds(row.t_us, row.left_rad_s * radius_m, row.right_rad_s * radius_m) for row in rows]


def _draw(run: DemoRun, recording: Path) -> None:
    with needs("report"):
        from sightline.evaluation.demo.video import film_run
        from sightline.evaluation.plots import AgeLimits, plot_run
    options, safety = run.options, robot_config(robot_of(run.scenario)).safety
    limits, statuses = AgeLimits(safety.full_speed_age_ms, safety.zero_speed_age_ms), read_statuses(recording)
    title = f"{run.scenario.name}, seed {options.seed}, +{options.latency_ms:g} ms, {options.loss:.0%} loss"
    with whole(run.folder / "trajectory.png", ".png") as part:
        plot_run(part, run.samples, run.scenario, title, statuses=statuses, limits=limits)
    with whole(run.folder / "run.mp4", ".mp4") as part:
        film_run(part, recording, run.samples, run.scenario, statuses)


def read_statuses(recording: Path) -> "list[StatusAt]":
    """Read state and frame age over time from a recording; an invalid message is left out."""
    from sightline.evaluation.plots import StatusAt

    return [
        StatusAt(report.stamp.t_us, report.status.state.value, report.status.frame_age_us)
        for report in read_reports(recording)
    ]


def read_reports(recording: Path) -> list[StatusReport]:
    """Read every status of a recording in the order of time; an invalid message is left out."""
    reports = []
    for recorded in read_recording(recording):
        if recorded.message.channel is STATUS:
            with suppress(WireError):
                reports.append(read_report(recorded.message))
    return sorted(reports, key=lambda report: report.stamp.t_us)


def _injected(run: DemoRun) -> dict[str, Any] | None:
    """Read the counters of the shaped link from its log, or return None without them."""
    line = last_line(run.folder / "vision.log")
    if not line.startswith(INJECTED):
        return None
    counts: dict[str, Any] = json.loads(line.removeprefix(INJECTED))
    return counts


def _injection_checks(run: DemoRun, injected: dict[str, Any] | None) -> list[Check]:
    """Check that a run with injected loss lost messages."""
    if not run.options.loss:
        return []
    lost = sum(leg["lost"] for leg in injected.values()) if injected else 0
    sent = sum(leg["sent"] for leg in injected.values()) if injected else 0
    share = lost / sent if sent else 0.0
    wanted = run.options.loss
    # Three standard deviations of a fair draw. Outside of them the loss differs from the requested one.
    near = 3 * math.sqrt(wanted * (1 - wanted) / sent) if sent else 0.0
    found = Check("injected_loss", share, "share", wanted, sent > 0 and abs(share - wanted) <= near + 1e-9)
    return [found, *_hold_checks(run)]


def _hold_checks(run: DemoRun) -> list[Check]:
    """Check that loss alone seldom stops the robot."""
    options = run.options
    if options.loss > HOLDS_LOSS or options.latency_ms > HOLDS_LATENCY_MS or options.transport == "legacy":
        return []
    return [at_most("holds", run.holds, "", HOLDS_A_MINUTE * _lasted_s(run) / 60)]


def _lasted_s(run: DemoRun) -> int:
    return round((run.samples[-1].t_us - run.samples[0].t_us) / 1e6)


def _checks(run: DemoRun, result: Score) -> list[Check]:
    """Return the checks of the scenario. The legacy protocol, slow and without odometry, only has to follow."""
    if run.options.transport != "legacy":
        return checks_of(run.scenario, result, run.options.latency_ms, REAL_TIME_FACTOR)
    if not bounds_of(run.scenario, run.options.latency_ms):
        return []
    unseen = 100 * sum(not sample.visible for sample in run.samples) / len(run.samples)
    return [
        at_most("out of view", unseen, "%", 0.0),
        at_most("wall_contacts", result.wall_contacts, "steps", 0.0),
    ]


def summary(scored: DemoReport) -> list[str]:
    """Format the closing lines: the score with its bounds, the files, and the next commands."""
    run, replayed = scored.run, scored.replayed
    lines = check_lines(scored.checks)
    if not bounds_of(run.scenario, run.options.latency_ms):
        lines.append(NOT_EVALUATED)
    lines.append(_replay_line(replayed, _loss_fix(run)))
    if run.dropped_by_recorder:
        lines.append(f"the recorder dropped {run.dropped_by_recorder} messages: the disk was too slow")
    if run.killed:
        lines.append(f"had to be killed: {', '.join(run.killed)}; see their logs")
    if scored.ok is False:
        lines += [*_short_lines(scored), *_late_lines(run.folder / "sim.log")]
    lines += _detector_lines(run.folder / "vision.log")
    lines.append(f"left in {run.folder}: score.json trajectory.png run.mp4 run.mcap motors.csv *.log")
    return [*lines, _next_thing(run)]


def _short_lines(scored: DemoReport) -> list[str]:
    """Return a line if figures are missing because the run ended before the robot had time for them."""
    lasted_s, needed_s = _lasted_s(scored.run), usual_s(scored.run.scenario)
    is_missing = any(not one.ok and (one.value is None or one.name.startswith(AT_LEAST)) for one in scored.checks)
    if lasted_s >= needed_s or not is_missing:
        return []
    return [f"the run of {lasted_s} s was too short for these bounds; repeat it with --seconds {needed_s:g}"]


def _late_lines(log: Path) -> list[str]:
    """Return a line if the simulation was behind the clock: a busy machine makes a robot slow that works."""
    with suppress(FileNotFoundError):
        if lags_ms := re.findall(r"simulation is (\d+) ms behind the clock", log.read_text("utf-8", "replace")):
            worst_ms = max(map(int, lags_ms))
            return [f"the simulation was up to {worst_ms} ms behind the clock; end other programs and repeat"]
    return []


def _detector_lines(log: Path) -> list[str]:
    """Return the notices of the detector in a log of vision, e.g. that the color range marks the floor."""
    parts = (line.partition(" vision: detector: ") for line in log.read_text("utf-8", "replace").splitlines())
    notices = dict.fromkeys(line for _, found, line in parts if found)
    return [f"detector: {line}" for line in list(notices)[:MOST_NOTICES]]


def _loss_fix(run: DemoRun) -> str:
    """Return how to record all messages, by the cause of the missing ones."""
    if run.dropped_by_recorder:
        return "use a faster disk: --out DIR"
    return "run without loss to compare" if run.options.loss else "the machine was too busy; close other programs"


def _replay_line(replayed: Replayed, fix: str) -> str:
    if not replayed.total:
        return "replay: vision's answers did not cross the recorder's transport, so there is nothing to compare"
    if replayed.gaps or replayed.missing_frames:
        lost = f"{replayed.gaps} answers and {replayed.missing_frames} frames are not in the recording"
        return f"replay: cannot be compared, for {lost}; {fix}"
    if replayed.has_fallback and replayed.equal < replayed.total:
        return "replay: cannot be compared, because the time decides whether the detector or its fallback answers"
    return f"replay: {replayed.equal} of {replayed.total} answers equal byte for byte"


def _next_thing(run: DemoRun) -> str:
    options = run.options
    # `make demo` starts a command that the shell of the user does not find.
    is_found = shutil.which("sightline") or Path(sys.argv[0]).name != "sightline"
    demo = f"next: {'sightline' if is_found else shlex.quote(sys.argv[0])} demo"
    if not options.latency_ms and not options.loss:
        chosen = f" --detector {options.detector}" if options.detector else ""
        return f"{demo} --scenario {options.scenario}{chosen} --latency-ms 100 --loss 0.1"
    other = "pushed" if run.scenario.name == "eight" else "eight"
    return f"{demo} --scenario {other} --latency-ms {options.latency_ms:g} --loss {options.loss:g}"
