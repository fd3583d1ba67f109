"""The score of one demo and of many: also by the reports of the mission, and each figure by its own kind of bound."""

import errno
import fcntl
import json
import os
import resource
import shutil
import sys
import tomllib
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import av
import pytest

from sightline.benchmarks import real_time
from sightline.benchmarks.real_time import Kinds, _figures, measure_demos
from sightline.evaluation.checks import Check
from sightline.evaluation.demo import report as demo_report
from sightline.evaluation.demo import run as demo_run
from sightline.evaluation.demo import video
from sightline.evaluation.demo.run import MOTOR_LOG, RECORDING, DemoOptions, DemoRun
from sightline.evaluation.lockstep import Conditions, Lockstep
from sightline.evaluation.processes import ProcessError
from sightline.evaluation.scenario_config import robot_config, robot_of, vision_config
from sightline.evaluation.score.figures import EXACT
from sightline.operator_side.recording.recorder import Recorder, read_about, read_recording
from sightline.operator_side.recording.replay import VISION_CONFIG, Replayed
from sightline.protocol.channels import CAMERA, STATUS
from sightline.protocol.codec import encode
from sightline.protocol.errors import CheckError, ConfigError
from sightline.protocol.messages import Reply, Stamp, State, Status
from sightline.protocol.transports.link import Message
from sightline.sim.scenario import AT_LEAST, load_scenario
from sightline.sim.world.world import World
from sightline.vision_side.config import VisionConfig
from tests.fixtures.commands import run

RADIUS_M = robot_of(load_scenario("traffic-light")).wheels.radius_m


@pytest.fixture(scope="module")
def lights(tmp_path_factory) -> DemoRun:
    """Two seconds at a traffic light, as a demo leaves them but for the wire: the real line in virtual time."""
    folder = tmp_path_factory.mktemp("lights")
    scenario = load_scenario("traffic-light")
    model = robot_of(scenario)
    config = vision_config(scenario, model, 3)
    with World(scenario, model, 3) as world:
        lockstep = Lockstep(world, robot_config(model, auto_arm=True), config, Conditions(), 3)
        with Recorder(lockstep.network.link("r1"), folder / RECORDING, {VISION_CONFIG: config.model_dump_json()}):
            stamp = Stamp(session="00000001", seq=0, t_us=0)
            lockstep.network.link("r1").publish(CAMERA, encode(stamp), encode(world.camera_model))
            while world.now_us < 2_000_000:
                lockstep.step()
    (folder / "vision.log").touch()
    rows = [f"{t_us},{left / RADIUS_M},{right / RADIUS_M},0,0" for t_us, left, right in lockstep.run.wheels]
    (folder / MOTOR_LOG).write_text("\n".join(["header", *rows, ""]))
    return DemoRun(DemoOptions("traffic-light"), scenario, folder, lockstep.run.samples)


@pytest.fixture(scope="module")
def scored(lights) -> demo_report.DemoReport:
    return demo_report.report(lights)


def misread(driven: DemoRun):
    """(share of the frames that were read wrong, whether that is accepted)."""
    judged = demo_report.report(driven)
    return next((check.value, check.ok) for check in judged.checks if check.name == "wrong_states_percent")


def test_color_of_the_light_is_scored_from_the_recording(lights):
    assert misread(lights) == (0.0, True)
    assert misread(replace(lights, samples=[replace(one, light="off") for one in lights.samples])) == (100.0, False)
    first, late = lights.samples[0], lights.samples[len(lights.samples) // 2 :]
    assert misread(replace(lights, samples=[replace(first, light="off"), *late])) == (0.0, True), "no report"


def test_wheel_commands_are_scored_from_the_motor_log(lights):
    still = replace(lights, options=replace(lights.options, latency_ms=400.0))
    (check,) = [check for check in demo_report.report(still).checks if check.name == "commanded_m"]
    assert check.value > 0.2 and not check.ok
    assert check.value == pytest.approx(lights.samples[-1].x_m - lights.samples[0].x_m, rel=0.2)


def test_demo_of_a_scenario_without_bounds_is_not_evaluated(lights):
    bare = demo_report.report(replace(lights, scenario=lights.scenario.model_copy(update={"bounds": {}})))
    assert bare.ok is None and bare.to_dict()["ok"] is None and bare.checks == []
    assert any("not evaluated" in line for line in demo_report.summary(bare))
    legacy = replace(bare.run, options=DemoOptions("traffic-light", transport="legacy"))
    assert demo_report.report(legacy).ok is None


@pytest.mark.parametrize("transport", ["zenoh", "legacy"])
def test_demo_with_a_latency_without_bounds_is_not_evaluated(lights, transport):
    options = DemoOptions("traffic-light", transport=transport, latency_ms=300.0)
    late = demo_report.report(replace(lights, options=options))
    assert late.ok is None and late.to_dict()["ok"] is None and late.checks == []
    assert any("not evaluated" in line for line in demo_report.summary(late))


@pytest.mark.parametrize(("states", "holds"), [
    ("", 0), ("HOLD HOLD", 0), ("HOLD ACTIVE", 0), ("ACTIVE HOLD", 1), ("HOLD DEGRADED HOLD ACTIVE HOLD DISARMED", 2),
])
def test_holds_after_the_first_motion_are_counted(states, holds):
    log = "".join(f"2026-03-01T10:00:00.000Z info robot r1: {state} (reason)\n" for state in states.split())
    assert demo_run.holds_in(log) == holds


@pytest.mark.parametrize(("options", "seconds", "holds", "ok"), [
    ({"loss": 0.2, "latency_ms": 50.0}, 60, 1, True), ({"loss": 0.2, "latency_ms": 50.0}, 60, 2, False),
    ({"loss": 0.1}, 59, 1, False), ({"loss": 0.2}, 120, 2, True), ({"loss": 0.01}, 20, 0, True),
    ({"loss": 0.3, "latency_ms": 50.0}, 60, 9, None), ({"loss": 0.2, "latency_ms": 100.0}, 60, 9, None),
    ({"latency_ms": 50.0}, 60, 9, None), ({"loss": 0.1, "transport": "legacy"}, 60, 9, None),
])
def test_loss_may_stop_the_robot_once_a_minute(lights, options, seconds, holds, ok):
    ends_us = lights.samples[0].t_us + seconds * 1_000_000 - 20_000
    driven = replace(lights, options=replace(lights.options, **options), holds=holds,
                     samples=[lights.samples[0], replace(lights.samples[-1], t_us=ends_us)])
    checks = demo_report._injection_checks(driven, None)
    assert next((check.ok for check in checks if check.name == "holds"), None) is ok


@pytest.mark.parametrize("name", ["circle", "traffic-light", "eight"])
def test_summary_of_a_failed_short_run_names_the_time_that_it_needs(lights, scored, name):
    scenario = load_scenario(name)
    needed_s = demo_run.usual_s(scenario)
    missing = [Check("acquired_s", None, "s", 12.0, False), Check("least_passes", 1.0, "", 2.0, False)]
    beyond = Check("wall_contacts", 3.0, "steps", 0.0, False)
    for lasted_s, check, is_named in [(3, missing[0], True), (needed_s - 1, missing[1], True), (3, beyond, False),
                                      (needed_s, missing[0], False)]:
        samples = [lights.samples[0], replace(lights.samples[-1], t_us=lights.samples[0].t_us + int(lasted_s * 1e6))]
        driven = replace(lights, scenario=scenario, samples=samples)
        lines = demo_report.summary(replace(scored, run=driven, checks=[check]))
        line = f"the run of {lasted_s:g} s was too short for these bounds; repeat it with --seconds {needed_s:g}"
        assert (line in lines) is is_named


@pytest.mark.parametrize(("dropped", "loss", "fix"), [
    (0, 0.1, "run without loss to compare"), (0, 0.0, "the machine was too busy; close other programs"),
    (3, 0.0, "use a faster disk: --out DIR"), (3, 0.1, "use a faster disk: --out DIR"),
])
@pytest.mark.parametrize("missing", [{"gaps": 2}, {"missing_frames": 4}])
def test_summary_names_how_to_record_the_missing_messages(lights, dropped, loss, fix, missing):
    driven = replace(lights, dropped_by_recorder=dropped, options=replace(lights.options, loss=loss))
    replayed = Replayed(total=9, equal=9, **missing)
    lines = demo_report.summary(demo_report.DemoReport(driven, None, [], replayed, None))
    (line,) = [line for line in lines if line.startswith("replay: ")]
    assert line == (f"replay: cannot be compared, for {replayed.gaps} answers and {replayed.missing_frames} frames are "
                    f"not in the recording; {fix}")


@pytest.mark.parametrize(("equal", "has_fallback", "line"), [
    (9, False, "9 of 9 answers equal byte for byte"), (9, True, "9 of 9 answers equal byte for byte"),
    (3, False, "3 of 9 answers equal byte for byte"),
    (3, True, "cannot be compared, because the time decides whether the detector or its fallback answers"),
])
def test_summary_compares_no_answers_that_depend_on_the_time(lights, equal, has_fallback, line):
    replayed = Replayed(total=9, equal=equal, has_fallback=has_fallback)
    lines = demo_report.summary(demo_report.DemoReport(lights, None, [], replayed, None))
    assert [one for one in lines if one.startswith("replay: ")] == [f"replay: {line}"]


def test_summary_shows_what_the_detector_reported_each_line_once_and_the_first_three(lights):
    judged = demo_report.report(lights)
    before = demo_report.summary(judged)
    assert not any("detector: " in line for line in before)
    lines = [f"2026-03-01T10:00:00.{number:03}Z info vision: detector: the color range marks {number // 2} %"
             for number in range(9)]
    log = lights.folder / "vision.log"
    log.write_text("\n".join(["2026-03-01T10:00:00.000Z info vision: target seen", *lines, ""]))
    try:
        after = demo_report.summary(judged)
    finally:
        log.write_text("")
    told = [f"detector: the color range marks {share} %" for share in (0, 1, 2)]
    assert after == [*before[:-2], *told, *before[-2:]]


@pytest.mark.parametrize(("lags_ms", "ok", "worst_ms"), [
    ((), False, None), ((130, 582, 147), True, None), ((130, 582, 147), False, 582), ((101,), False, 101),
    ((1000, 999), False, 1000),
])
def test_summary_of_a_failed_run_shows_how_late_the_simulation_was(scored, tmp_path, lags_ms, ok, worst_ms):
    (tmp_path / "vision.log").touch()
    lags = [f"simulation is {lag} ms behind the clock; is the machine busy?" for lag in lags_ms]
    lines = [f"2026-03-01T10:00:00.000Z info {line}\n" for line in ("simulation ready: circle", *lags)]
    (tmp_path / "sim.log").write_text("".join(lines))
    checks = [replace(check, ok=ok) for check in scored.checks]
    ended = replace(scored, run=replace(scored.run, folder=tmp_path), checks=checks)
    late = [line for line in demo_report.summary(ended) if "behind the clock" in line]
    busy = f"the simulation was up to {worst_ms} ms behind the clock; end other programs and repeat"
    assert late == ([] if worst_ms is None else [busy])


@pytest.mark.parametrize(("found", "started_as", "shown"), [
    ("/usr/bin/sightline", "/usr/bin/sightline", "sightline"), (None, ".venv/bin/sightline", ".venv/bin/sightline"),
    (None, "/my clone/bin/sightline", "'/my clone/bin/sightline'"), (None, "cli/app.py", "sightline"),
])
@pytest.mark.parametrize("latency_ms", [0.0, 50.0])
def test_next_command_works_where_the_demo_was_started(scored, monkeypatch, found, started_as, shown, latency_ms):
    monkeypatch.setattr(shutil, "which", lambda _name: found)
    monkeypatch.setattr(sys, "argv", [started_as, "demo"])
    driven = replace(scored.run, options=replace(scored.run.options, latency_ms=latency_ms))
    assert demo_report.summary(replace(scored, run=driven))[-1].startswith(f"next: {shown} demo --scenario ")


def test_results_are_printed_before_files_that_cannot_be_written(lights, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    shutil.copytree(lights.folder, folder)
    (folder / "score.json").mkdir()
    monkeypatch.setattr(demo_run, "run_demo", lambda *_given: replace(lights, folder=folder))
    code, out, err = run(capsys, "demo", "--scenario", "traffic-light", "--json")
    assert code == 2 and json.loads(out)["checks"]
    assert err.splitlines()[-1] == (
        f"error: cannot write {folder}: Is a directory; free some space or pass another folder with --out")


@pytest.mark.parametrize(("room_bytes", "files"), [
    (500, []), (5_000, ["score.json"]), (80_000, ["score.json", "trajectory.png"]),
])  # fmt: skip
def test_full_disk_leaves_no_damaged_file(lights, tmp_path, monkeypatch, room_bytes, files):
    judged = demo_report.report(lights)
    monkeypatch.setattr(lights, "folder", tmp_path)
    with Recorder(StatusLink(), tmp_path / RECORDING, {}):
        pass
    monkeypatch.setattr("sightline.evaluation.plots.plot_run", lambda path, *_, **__: path.write_bytes(bytes(50_000)))
    monkeypatch.setattr("sightline.evaluation.demo.video.film_run", lambda path, *_: path.write_bytes(bytes(90_000)))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, limits[1]))
    try:
        with pytest.raises(ConfigError, match=f"cannot write {tmp_path}: File too large; free some space"):
            demo_report.write_files(judged)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sorted(path.name for path in tmp_path.iterdir()) == [RECORDING, *files]


@pytest.mark.parametrize("share", [10, 60, 100])
def test_recording_that_ends_early_fails_no_check(lights, tmp_path, monkeypatch, capsys, share):
    """A part of the answers would show a mission that does nothing from there on."""
    shutil.copytree(lights.folder, tmp_path, dirs_exist_ok=True)
    os.truncate(tmp_path / RECORDING, (tmp_path / RECORDING).stat().st_size * share // 100)
    cut = replace(lights, folder=tmp_path, recorder_failed="No space left on device")
    for samples in (lights.samples, []):
        driven = replace(cut, samples=samples)
        monkeypatch.setattr(demo_run, "run_demo", lambda *_given, driven=driven: driven)
        code, out, err = run(capsys, "demo", "--scenario", "traffic-light")
        assert code == 2 and "FAIL" not in out
        assert err == (f"error: recording {tmp_path / RECORDING} ends too early to be scored: No space left on device; "
                       "free some space or pass another folder with --out\n")


@pytest.mark.parametrize("seconds", [0.0, 20.0])
def test_demo_ends_when_its_recording_does(lights, seconds):
    failures = iter(["", "", "No space left on device"])
    truth = SimpleNamespace(read=lambda timeout_s: lights.samples[0] if timeout_s else None)
    driven = replace(lights, samples=[], options=replace(lights.options, seconds=seconds))
    idle = SimpleNamespace(check=lambda: None, report=None, show=lambda _lines: None)
    demo_run._watch(driven, idle, idle, truth, idle, failure=lambda: next(failures))
    assert driven.samples == lights.samples[:1] * 2


@pytest.mark.parametrize(("kept", "least_s", "most_s"), [
    (("camera", "twist", "ack", "frame"), 1.5, 2.1), (("camera", "frame"), 1.5, 2.1), (("camera",), 0, 0),
])  # fmt: skip
def test_run_whose_answers_crossed_another_transport_has_its_film(lights, tmp_path, kept, least_s, most_s):
    """The recorder uses Zenoh, so it has no answer of a WebSocket or legacy vision service."""
    link, recording = StatusLink(), tmp_path / RECORDING
    with Recorder(link, recording, read_about(lights.folder / RECORDING)):
        for recorded in read_recording(lights.folder / RECORDING):
            if recorded.message.channel.name in kept:
                link.callbacks[recorded.message.channel](recorded.message)
    frames = video.film_run(tmp_path / "run.mp4", recording, lights.samples, lights.scenario)
    with av.open(str(tmp_path / "run.mp4")) as film:
        times_s = [frame.time for frame in film.decode(video=0)]
    assert len(times_s) == frames > 0
    assert least_s <= times_s[-1] <= most_s


def test_recording_without_a_camera_model_names_the_error_of_the_disk(lights, tmp_path):
    with Recorder(StatusLink(), tmp_path / RECORDING, {VISION_CONFIG: VisionConfig().model_dump_json()}):
        pass
    cut = replace(lights, folder=tmp_path, recorder_failed="No space left on device")
    with pytest.raises(ConfigError, match="too early to be scored: No space left on device; free some space"):
        demo_report.report(cut)


def test_configuration_that_cannot_be_written_is_reported(lights, tmp_path):
    (tmp_path / "robot.toml").mkdir()
    with pytest.raises(ConfigError, match=f"cannot write {tmp_path}/robot.toml: Is a directory; free some space"):
        demo_run._write_configuration(replace(lights, folder=tmp_path), "/tmp/sockets")


def test_stop_of_a_run_does_not_outlast_it(lights, tmp_path):
    demo_run._write_configuration(replace(lights, folder=tmp_path), "/tmp/sockets")
    robot = tomllib.loads((tmp_path / "robot.toml").read_text())
    assert Path(robot["state_dir"]).is_relative_to("/tmp/sockets"), "the processes remove it at their end"


def test_run_that_fails_leaves_no_result_of_an_earlier_one(tmp_path, monkeypatch):
    earlier = ("score.json", "trajectory.png", "run.mp4", RECORDING, MOTOR_LOG, "sim.log", "robot.log", "labels.log")
    for name in (*earlier, "notes.txt"):
        (tmp_path / name).touch()

    def fail(*_given):
        raise CheckError("the robot would not be armed")

    monkeypatch.setattr(demo_run, "_drive", fail)
    with pytest.raises(CheckError):
        demo_run.run_demo(DemoOptions(out=tmp_path), print)
    kept = sorted(path.name for path in tmp_path.iterdir())
    assert kept == ["notes.txt", "sim.log"], "the log marks the folder as one of runs"
    (tmp_path / "run.mp4").mkdir()
    with pytest.raises(ConfigError, match=r"cannot write .*run.mp4: Is a directory; free some space"):
        demo_run.run_demo(DemoOptions(out=tmp_path), print)


def test_interrupt_before_the_first_sample_ends_the_demo(tmp_path, monkeypatch):
    def interrupted(*_given):
        raise KeyboardInterrupt

    monkeypatch.setattr(demo_run, "_drive", interrupted)
    with pytest.raises(KeyboardInterrupt):
        demo_run.run_demo(DemoOptions(out=tmp_path), print)


def test_run_folder_of_a_run_in_progress_is_rejected(tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    other = os.open(folder, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    for _ in range(2):
        with pytest.raises(ConfigError, match=f"run folder {folder} is of a run in progress; choose another with"):
            demo_run.run_folder(folder, "")
    os.close(other)
    assert demo_run.run_folder(folder, "") == folder
    with pytest.raises(BlockingIOError):
        fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    assert demo_run.run_folder(folder, "") == folder, "the same process may run there again"


def test_run_folder_without_locks_is_used(tmp_path, monkeypatch):
    def without_locks(_number, _flags):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("fcntl.flock", without_locks)
    assert demo_run.run_folder(tmp_path / "run", "") == tmp_path / "run"


def test_run_folder_is_new_or_of_an_earlier_run(tmp_path):
    (tmp_path / "run/sightline").mkdir(parents=True)
    (tmp_path / "run/robot.toml").touch()
    with pytest.raises(ConfigError, match=f"run folder {tmp_path}/run has other files; choose a new one with --out"):
        demo_run.run_folder(tmp_path / "run", "")
    for mark in ("run/sim.log", "run/sightline/sim.log"):
        (tmp_path / mark).touch()
        assert demo_run.run_folder(tmp_path / "run", "") == tmp_path / "run"
        (tmp_path / mark).unlink()


def test_run_that_cannot_be_scored_is_a_failed_check(lights, monkeypatch):
    with pytest.raises(CheckError, match="ended before the robot drove"):
        demo_report.report(replace(lights, samples=[]))
    monkeypatch.setattr(demo_run, "ARM_S", 0.0)
    refused = Reply(to="0000000a", id=1, ok=False, state=State.STOPPED, detail="STOPPED: reset first")
    operator = SimpleNamespace(wait_report=lambda: None, arm=lambda patience_s: refused)
    with pytest.raises(CheckError, match="would not be armed: STOPPED"):
        demo_run.arm_robot(operator, SimpleNamespace(check=lambda: None))


class StatusLink:
    """Publishes to the recorder what a test gives it."""

    def __init__(self) -> None:
        self.callbacks = {}

    def subscribe(self, channel, callback) -> None:
        self.callbacks[channel] = callback

    def give(self, t_us: int, payload: bytes) -> None:
        header = encode(Stamp(session="00000001", seq=t_us, t_us=t_us))
        self.callbacks[STATUS](Message(STATUS, "", header, payload))


def test_state_and_frame_age_come_from_the_recording_in_order(tmp_path):
    link = StatusLink()
    with Recorder(link, tmp_path / RECORDING, {}):
        link.give(20, encode(Status(state=State.HOLD, reason="no command")))
        link.give(30, b"{")
        link.give(10, encode(Status(state=State.ACTIVE, reason="driving", frame_age_us=24_000)))
    assert demo_report.accepted_us(tmp_path / RECORDING) is None
    with Recorder(link, tmp_path / "later.mcap", {}):
        for t_us, accepted in ((30, 9), (10, 0), (20, 2)):
            link.give(t_us, encode(Status(state=State.ACTIVE, reason="driving", accepted=accepted)))
    assert demo_report.accepted_us(tmp_path / "later.mcap") == 20
    assert demo_report.read_statuses(tmp_path / RECORDING) == [(10, "ACTIVE", 24_000), (20, "HOLD", None)]


# --- many demos ------------------------------------------------------------------------------------------------------


REPLAYED = asdict(Replayed(total=9, equal=9))


@pytest.mark.parametrize(("changes", "worst", "ok"), [
    ({}, 0, True), ({"equal": 7}, 2, False), ({"gaps": 3}, 3, False), ({"missing_frames": 4}, 4, False),
    ({"total": 0, "equal": 0}, 0, False),
])  # fmt: skip
def test_recording_that_lacks_or_changes_answers_fails(changes, worst, ok):
    results = [{"checks": [], "replayed": REPLAYED | one} for one in ({}, changes, {})]
    (compared,) = _figures("ball", results, Kinds(AT_LEAST, EXACT))
    assert (compared.worst, compared.ok) == (worst, ok)


@pytest.mark.parametrize(("code", "exit_code"), [(3, 3), (-9, 1)])
def test_demo_that_cannot_run_passes_its_error_and_exit_code_on(monkeypatch, code, exit_code):
    done = SimpleNamespace(returncode=code, stderr="starting\nerror: no simulation; see sim.log\n", stdout="")
    monkeypatch.setattr(real_time.subprocess, "run", lambda *_, **__: done)
    with pytest.raises(ProcessError, match="demo of eight, seed 7: no simulation") as raised:
        measure_demos(["eight"], [7], None, Kinds(AT_LEAST, EXACT), lambda _line: None)
    assert raised.value.exit_code == exit_code


def figure(name: str, bound: float, *values: float | None):
    """Return the check of one figure with these values."""
    results = [{"checks": [{"name": name, "value": value, "unit": "", "bound": bound}],
                "replayed": REPLAYED} for value in values]
    return _figures("ball", results, Kinds(AT_LEAST, EXACT))[0]


@pytest.mark.parametrize(("name", "bound", "values", "middle", "worst", "ok"), [
    ("bearing_rms_deg", 1.5, (0.2, 9.0, 0.4), 0.4, 9.0, True),
    ("bearing_rms_deg", 1.5, (0.2, 1.6, 9.0), 1.6, 9.0, False),
    ("least_distance_m", 0.7, (0.8, 0.1, 0.9), 0.8, 0.1, True),
    ("least_distance_m", 0.7, (0.8, 0.6, 0.5), 0.6, 0.5, False),
    ("lost_percent", 0.0, (0.0, 0.0, 0.1), 0.0, 0.1, False), ("lost_percent", 0.0, (0.0, 0.0, 0.0), 0.0, 0.0, True),
    ("wall_contact_s", 0.1, (0.0, 0.0, 0.2), 0.0, 0.2, False), ("wall_contact_s", 0.1, (0.0, 0.0, 0.1), 0.0, 0.1, True),
    ("least_crossings", 1.0, (1, 2, 0), 1, 0, False), ("least_crossings", 1.0, (1, 2, 1), 1, 1, True),
    ("reached_s", 22.5, (12.0, None, 13.0), None, None, False),
])  # fmt: skip
def test_median_is_checked_and_exact_figures_in_every_run(name, bound, values, middle, worst, ok):
    judged = figure(name, bound, *values)
    assert (judged.median, judged.worst, judged.ok) == (middle, worst, ok)
