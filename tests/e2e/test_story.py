"""`sightline demo --story` as a user runs it: real processes, both takes, the film, and the figures in it."""

import json
import subprocess
from pathlib import Path

import pytest
from PIL import Image

from sightline.evaluation.faults.evidence import measure_stop, read_motors
from sightline.evaluation.processes import SIGHTLINE

pytestmark = pytest.mark.slow

COMMAND = [*SIGHTLINE, "demo"]


def demo(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*COMMAND, *options], capture_output=True, text=True, timeout=280, check=False)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("story") / "run"
    return folder, demo("--story", "--out", str(folder), "--json")


def events(folder: Path) -> dict[str, int]:
    return json.loads((folder / "events.json").read_text())


@pytest.mark.alone  # the naive robot has to drive fast when the radio is lost
def test_story_shows_that_the_robot_stops_and_the_naive_robot_does_not(filmed):
    folder, result = filmed
    assert result.returncode == 0, result.stdout + result.stderr
    shown = json.loads(result.stdout)
    assert shown == json.loads((folder / "story.json").read_text())
    assert {check["name"]: check["ok"] for check in shown["checks"]}["wall contacts of Sightline"]
    assert shown["naive"]["speed_mps"] > 0.2, "its wheels turn at the wall"
    for line in ("running 1 of 2", "running 2 of 2", "filming 3 of 5"):
        assert line in result.stderr, "progress is on stderr"


@pytest.mark.alone
def test_figures_come_from_the_motor_log(filmed):
    folder, result = filmed
    stops = json.loads(result.stdout)["stops"]
    at_us, rows = events(folder / "sightline"), read_motors((folder / "sightline" / "motors.csv").read_text())
    for name, begin, end in (("wifi_lost", "wifi lost", "wifi back"), ("vision_killed", "vision killed", "vision back"),
                             ("stop", "STOP", "end")):
        stop = measure_stop(rows, at_us[begin], at_us[end])
        assert (stops[name]["zero_ms"], stops[name]["distance_m"]) == (stop.zero_ms, stop.distance_m)


@pytest.mark.alone
def test_film_is_small_and_lasts_25_to_30_seconds(filmed):
    folder, _ = filmed
    path = folder / "story.webp"
    assert path.stat().st_size < 3_000_000
    with Image.open(path) as film:
        lasting_ms = 0
        for number in range(film.n_frames):
            film.seek(number)
            film.load()
            lasting_ms += film.info["duration"]
    assert 25_000 <= lasting_ms <= 30_000


@pytest.mark.parametrize("option", ["--scenario=eight", "--seconds=5", "--loss=0.1", "--mission=band"])
def test_story_rejects_options_that_it_sets(option, tmp_path):
    result = demo("--story", option, "--out", str(tmp_path / "run"))
    name = option.partition("=")[0]
    assert result.returncode == 2, result.stderr
    assert result.stderr.startswith(f"error: --story and {name} exclude each other")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_story_in_an_unwritable_folder_is_one_line(tmp_path):
    (tmp_path / "file").touch()
    result = demo("--story", "--out", str(tmp_path / "file" / "run"))
    assert result.returncode == 2
    assert result.stderr.startswith("error: run folder ")
    assert result.stderr.count("\n") == 1
