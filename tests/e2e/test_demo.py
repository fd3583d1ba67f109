"""The demo as an operator runs it: real processes, real files, and nothing left behind however it ends."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import pytest

from sightline.evaluation.processes import SIGHTLINE, ProcessError, Processes, children_of
from sightline.protocol.errors import SightlineError
from tests.fixtures.links import until

COMMAND = [*SIGHTLINE, "demo"]


def running() -> dict[int, str]:
    """Command lines of all living processes."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            if command := entry.read_bytes().replace(b"\0", b" ").decode():
                found[int(entry.parent.name)] = command
    return found


def running_in(folder: Path) -> list[str]:
    """Command lines of living processes that name `folder`."""
    return [command for command in running().values() if str(folder) in command]


def processes_of(pid: int) -> set[int]:
    """The process and all below it."""
    return {pid}.union(*(processes_of(child) for child in children_of(pid)))


def all_of(demo: subprocess.Popen) -> set[int]:
    """The processes of a demo: it, simulation, guardian, driver (perhaps a second one), network, STOP, vision."""
    assert until(lambda: len(processes_of(demo.pid)) >= 7, 10), [running().get(pid) for pid in processes_of(demo.pid)]
    return processes_of(demo.pid)


def demo(folder: Path, *options: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*COMMAND, "--out", str(folder), *options],
        capture_output=True, text=True, timeout=100, check=False, env={**os.environ, **environment},
    )


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demo") / "run"
    about = {"SIGHTLINE_SIM__SCENARIO": "eight", "SIGHTLINE_SIM__SEED": "9", "SIGHTLINE_ROBOT__ROBOT": "r9"}
    return folder, demo(folder, "--scenario", "circle", "--seconds", "5", "--json", **about)


@pytest.mark.alone  # it must reach its bounds within 5 s
def test_demo_drives_and_prints_json_for_a_script(driven):
    folder, result = driven
    said = json.loads(result.stdout)
    assert result.returncode == (0 if said["ok"] else 5), result.stderr
    assert said["ok"], said["checks"]
    assert {"name", "value", "unit", "bound", "ok"} <= set(said["checks"][0])
    assert said["score"]["travelled_m"] > 0.5
    assert said == json.loads((folder / "score.json").read_text())
    assert running_in(folder) == []
    assert "ready: circle, raspberry, seed 1," in (folder / "sim.log").read_text(), "the environment chooses none"


@pytest.mark.alone
def test_replay_gives_the_twists_of_the_wire(driven):
    folder, _ = driven
    script = (
        "import sys; from pathlib import Path; from sightline.operator_side.recording.replay import replay;"
        "result = replay(Path(sys.argv[1])); print(result); sys.exit(0 if result.ok and result.total > 60 else 1)"
    )
    fresh = subprocess.run(
        [sys.executable, "-c", script, str(folder / "run.mcap")], capture_output=True, text=True, check=False
    )
    assert fresh.returncode == 0, fresh.stdout + fresh.stderr


@pytest.mark.alone
def test_demo_writes_images_that_open(driven):
    folder, _ = driven
    assert (folder / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    film = (folder / "run.mp4").read_bytes()
    assert 0 < film.index(b"moov") < film.index(b"mdat"), "a browser starts before it has all"
    with av.open(str(folder / "run.mp4")) as container:
        stream = container.streams.video[0]
        frames = sum(1 for _ in container.decode(stream))
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.width % 2 == stream.height % 2 == 0
        assert frames > 40
        assert float(stream.duration * stream.time_base) == pytest.approx(5, abs=0.5)


@pytest.mark.alone
def test_motor_log_ends_at_zero(driven):
    folder, _ = driven
    with (folder / "motors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert max(float(row["left_rad_s"]) for row in rows) > 5
    assert float(rows[-1]["left_rad_s"]) == float(rows[-1]["right_rad_s"]) == 0
    assert all((folder / f"{name}.log").stat().st_size for name in ("sim", "robot", "vision"))


@pytest.mark.slow
def test_injected_loss_is_counted_and_checked(tmp_path):
    result = demo(tmp_path / "run", "--seconds", "5", "--latency-ms", "50", "--loss", "0.1", "--json")
    said = json.loads(result.stdout)
    assert said["injected"]["to_robot"]["lost"] > 0
    assert said["injected"]["from_robot"]["lost"] > 0
    assert "injected_loss" in [check["name"] for check in said["checks"]]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_all_processes_and_the_run_is_scored(tmp_path, number):
    folder = tmp_path / "run"
    process = subprocess.Popen([*COMMAND, "--out", str(folder), "--seconds", "0", "--json"], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if "ACTIVE" in line:
            break
    started = all_of(process)
    process.send_signal(number)
    said, _ = process.communicate(timeout=40)
    assert json.loads(said)["interrupted"]
    assert process.returncode in (0, 5)
    assert running_in(folder) == [] and not started & running().keys()


@pytest.mark.alone  # it must end within 2 s
def test_demo_that_is_killed_leaves_no_process_no_folder_and_stopped_wheels(tmp_path):
    folder = tmp_path / "run"
    with TemporaryDirectory() as temporary:  # a short name, for the path of a socket
        process = subprocess.Popen([*COMMAND, "--out", str(folder), "--seconds", "0"], stderr=subprocess.PIPE,
                                   text=True, env={**os.environ, "TMPDIR": temporary})
        with process:
            try:
                assert any("ACTIVE" in line for line in process.stderr)
                assert until(lambda: wheel_speeds(folder)[0] > 3.0, 20)
                started = all_of(process)
            finally:
                process.kill()
                killed_s = time.monotonic()
        assert until(lambda: not running_in(folder) and not started & running().keys(), 5)
        assert until(lambda: not any(Path(temporary).iterdir()), 5)
    assert time.monotonic() - killed_s < 2.0
    assert wheel_speeds(folder) == (0.0, 0.0)


def wheel_speeds(folder: Path) -> tuple[float, float]:
    """Return the speeds that were set last, rad/s."""
    _, left, right, *_ = (folder / "motors.csv").read_text().splitlines()[-1].split(",")
    return float(left), float(right)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("environment", "code", "expected"),
    [
        ({"SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPS": "-1"}, 2, "SIGHTLINE_ROBOT__SAFETY__MAX_LINEAR_MPS = -1"),
        ({"SIGHTLINE_SIM__SECONDS": "0.5"}, None, "ended by itself"),
    ],
)
def test_a_process_that_fails_is_quoted_and_the_others_end(tmp_path, environment, code, expected):
    folder = tmp_path / "run"
    result = demo(folder, "--seconds", "20", **environment)
    error = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(error) == 1
    assert expected in error[0]
    assert result.returncode == code if code else result.returncode != 0
    assert "Traceback" not in result.stderr
    assert running_in(folder) == []


def test_process_that_never_becomes_ready_times_out(tmp_path):
    with Processes(tmp_path) as processes:
        processes.start("sim", ["sim", "--socket-dir", str(tmp_path / "s")])
        with pytest.raises(SightlineError, match=r"is not ready after 0\.1 s"):
            processes.wait_line("sim", "something else", 0.1)
        pid = processes.pid("sim")
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_error_names_the_last_line_and_exit_code_of_a_process(tmp_path):
    with Processes(tmp_path) as processes:
        processes.start("robot", ["robot", "--socket-dir", "/nowhere"])
        with pytest.raises(ProcessError, match="nothing simulates a robot in /nowhere") as error:
            processes.wait_line("robot", "on tcp", 20.0)
    assert error.value.exit_code == 3


def test_output_is_text_for_any_shell_locale(tmp_path, monkeypatch):
    """The program that starts the processes reads the output; a JSON line would be an error inside an error."""
    monkeypatch.setenv("SIGHTLINE_LOG", "json")
    with Processes(tmp_path) as processes:
        processes.start("robot", ["robot", "--config", str(tmp_path / "absent.toml")])
        with pytest.raises(ProcessError, match=r"absent\.toml") as told:
            processes.wait_line("robot", "never", 20)
    assert "{" not in str(told.value)
