"""`sightline bench loop` and `bench watchers`: their figures, and short runs of real processes; nothing is timed."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.loop import run_race
from benchmarks.loop_course import Course, Sample, course_of_headers, course_of_tally
from benchmarks.loop_crew import free_port
from benchmarks.loop_eyes import Eyes
from benchmarks.loop_figures import figures_of, judge, percentile
from benchmarks.loop_machine import Reading, children_of, taken_percent
from benchmarks.loop_pictures import camera_of, write_pictures
from benchmarks.loop_setting import FLOOR, OURS, PEERS, TCP, LoopSetting, peers_of, size_of
from benchmarks.loop_sockets import carried_between, carried_bytes
from benchmarks.watchers import measure_watchers
from operator_side.cli_bench_loop import register_bench
from protocol.errors import ConfigError, HardwareError
from robot_side.hardware.folder_camera import FolderCamera, FolderCameraConfig
from tests.link_rigs import until

SMALL = LoopSetting(Path(), 160, 120, fps=30.0, seconds=2.0, tries=1)
MS = 1000


def sample(name, ages_ms, cpu_s=0.1, answered_percent=100.0, taken=0.0):
    ages_us = tuple((at * 33 * MS, round(age_ms * MS)) for at, age_ms in enumerate(ages_ms))
    course = Course(len(ages_us), answered_percent, ages_us)
    return Sample(name, course, 10.0, {"vision": cpu_s}, {"vision": 60.0}, 1000, taken)


def judged(setting=SMALL, **samples):
    figures = {name: figures_of(one) for name, one in samples.items()}
    return {check.name: check.ok for check in judge(figures, setting)}


# --- figures -----------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 10_000), min_size=1), st.integers(1, 100))
def test_a_percentile_is_a_value_that_so_many_do_not_exceed(values, percent):
    found = percentile(values, percent)
    assert found in values
    assert 100 * sum(value <= found for value in values) >= percent * len(values)
    assert 100 * sum(value < found for value in values) < percent * len(values)


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=1), st.data())
def test_of_a_tally_every_picture_captured_in_time_counts_once(captured_us, data):
    answered = data.draw(st.sets(st.sampled_from(captured_us)))
    begin_us, end_us = sorted(data.draw(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6))))
    judged_us = sorted((t_us + 5, t_us) for t_us in answered)
    course = course_of_tally(captured_us, [(t_us, at_us) for at_us, t_us in judged_us], begin_us, end_us)
    inside = [t_us for t_us in captured_us if begin_us <= t_us < end_us]
    assert course.captured == len(inside)
    assert course.answered_percent == pytest.approx(100 * len(answered & set(inside)) / max(1, len(inside)))
    assert len(course.ages_us) == sum(begin_us <= t_us + 5 < end_us for t_us in answered)
    assert all(age_us == 5 for _, age_us in course.ages_us)


def header_rows(count, refused=()):
    """Frames 33 ms apart; each header tells the age of the last command accepted, some of which were not."""
    rows, latency_us = [], None
    for seq in range(count):
        rows.append((seq, seq * 33 * MS, latency_us))
        if seq not in refused:
            latency_us = 2 * MS + seq
    return rows


def statuses(rows, refused=()):
    """Every 100 ms, how many commands were accepted up to then."""
    for t_us in range(0, rows[-1][1], 100 * MS):
        yield t_us, sum(at_us + 2 * MS <= t_us and seq not in refused for seq, at_us, _ in rows)


@given(st.sets(st.integers(5, 85), max_size=30))
def test_of_headers_the_commands_that_were_refused_are_missing(refused):
    rows = header_rows(100, refused)
    course = course_of_headers(rows, list(statuses(rows, refused)), 0, rows[-1][1] + 1)
    assert course.captured == 100
    assert len(course.ages_us) == 99 - len(refused)
    assert course.answered_percent == pytest.approx(100 - len(refused), abs=2.5)


def test_frames_that_never_reached_the_vision_are_not_answered():
    rows = header_rows(100)
    kept = [row for row in rows if not 40 <= row[0] < 60]
    accepted = list(statuses(rows, range(40, 60)))
    course = course_of_headers(kept, accepted, 0, rows[-1][1] + 1)
    assert course.captured == 100
    assert course.answered_percent == pytest.approx(80, abs=2.5)


def test_without_an_answer_there_are_no_figures_and_no_check_holds():
    silent = figures_of(sample(OURS, []))
    assert (silent.p50_ms, silent.p95_ms, silent.first_ms) == (None, None, None)
    found = judged(**{OURS: sample(OURS, [], answered_percent=0), FLOOR: sample(FLOOR, [1.0] * 100)})
    assert not found["p50 over floor"]
    assert not found["p95 over floor"]
    assert not found["not accepted"]


def test_the_bounds_are_held_against_the_floor_of_the_same_run():
    floor = sample(FLOOR, [1.0] * 100, cpu_s=0.1)
    assert all(judged(**{FLOOR: floor, OURS: sample(OURS, [2.5] * 95 + [5.9] * 5, cpu_s=0.15)}).values())
    assert not judged(**{FLOOR: floor, OURS: sample(OURS, [2.6] * 100)})["p50 over floor"]
    assert not judged(**{FLOOR: floor, OURS: sample(OURS, [2.0] * 94 + [6.1] * 6)})["p95 over floor"]
    assert not judged(**{FLOOR: floor, OURS: sample(OURS, [2.0] * 100, cpu_s=0.17)})["vision CPU over floor"]
    assert not judged(**{FLOOR: floor, OURS: sample(OURS, [2.0] * 100, answered_percent=98.9)})["not accepted"]


def test_with_a_slow_detector_age_has_bounds_of_its_own_and_must_not_grow():
    slow = replace(SMALL, detector_delay_ms=80.0)
    floor = sample(FLOOR, [81.0] * 100)
    assert all(judged(slow, **{FLOOR: floor, OURS: sample(OURS, [85.0] * 100)}).values())
    growing = [80 + at / 10 for at in range(100)]
    found = judged(slow, **{FLOOR: floor, OURS: sample(OURS, [*growing, *[121.0] * 5])})
    assert not found["drift of age"]
    assert not found["age p99"]


@pytest.mark.parametrize("rival", PEERS)
def test_every_peer_is_a_rival(rival):
    ours, floor = sample(OURS, [2.0] * 100), sample(FLOOR, [1.0] * 100)
    assert judged(**{FLOOR: floor, OURS: ours, rival: sample(rival, [2.1] * 100)})[f"p95 behind {rival}"]
    assert not judged(**{FLOOR: floor, OURS: ours, rival: sample(rival, [1.9] * 100)})[f"p95 behind {rival}"]


def test_a_disturbed_sample_fails_the_run():
    found = judged(**{FLOOR: sample(FLOOR, [1.0] * 9, taken=50.0), OURS: sample(OURS, [2.0] * 9)})
    assert not found["samples disturbed by others"]


def test_time_of_others_is_what_neither_we_nor_idleness_had(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    before = Reading({"vision": 1.0}, own_s=1.0, busy_s=10.0, steal_s=0.0)
    after = Reading({"vision": 3.0}, own_s=2.0, busy_s=14.0, steal_s=0.5)
    assert taken_percent(before, after, 10.0) == pytest.approx(100 * (1.0 + 0.5) / 20)


# --- what is asked -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["640", "x480", "640x", "a640x480", "640x480x3", "６４０x480", "-1x4", ""])
def test_a_size_that_is_none_is_refused(text):
    with pytest.raises(ConfigError, match="WIDTHxHEIGHT"):
        size_of(text)


def test_sizes_and_peers_are_read():
    assert size_of("640x480") == (640, 480)
    assert (peers_of("all"), peers_of("none"), peers_of("older,openpi")) == (PEERS, (), ("older", "openpi"))
    with pytest.raises(ConfigError, match="zmqq"):
        peers_of("older,zmqq")


@pytest.mark.parametrize("change", [{"fps": 0.5}, {"seconds": 1}, {"detector_delay_ms": 301}, {"width_px": 63}])
def test_what_cannot_be_run_is_refused(change):
    with pytest.raises(ConfigError):
        replace(SMALL, **change)


def test_an_unknown_transport_is_refused_before_anything_starts():
    with pytest.raises(ConfigError, match="carrier"):
        run_race(replace(SMALL, transport="carrier"), print)


# --- the parts, for real -----------------------------------------------------------------------------------------


def test_the_pictures_are_those_of_the_camera_and_every_one_is_answered(tmp_path):
    mean_bytes = write_pictures(tmp_path, 640, 480)
    assert 40_000 < mean_bytes < 52_000
    camera = FolderCamera(FolderCameraConfig(path=tmp_path))
    assert camera.model == camera_of(640, 480)
    eyes = Eyes(640, 480, 0.0)
    answers = {eyes.answer(33_333 * at, path.read_bytes()) for at, path in enumerate(sorted(tmp_path.iterdir()), 1)}
    assert len(answers) > 20  # the ball goes round, and the command with it


def test_the_kernel_counts_the_bytes_of_a_connection():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as client, server.accept()[0] as accepted:
            before = carried_bytes([port])
            accepted.sendall(bytes(5000))
            received = client.recv(5000, socket.MSG_WAITALL)
            client.sendall(bytes(70))
            received += accepted.recv(70, socket.MSG_WAITALL)
            assert len(received) == 5070
            assert carried_between(before, carried_bytes([port])) == 5070
        assert carried_bytes([free_port()]) == {}


def test_of_several_connections_to_a_port_the_busiest_counts():
    assert carried_between({(1, 5): 10}, {(1, 5): 30, (1, 6): 4, (2, 7): 100}) == 120
    assert carried_between({}, {}) is None


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["zenoh", "websocket"])
def test_a_short_race_of_the_services_over_each_transport(transport):
    race = run_race(replace(SMALL, transport=transport, peers=()), lambda _: None)
    assert list(race.figures) == [FLOOR, OURS]
    ours = race.figures[OURS]
    assert ours.captured > 20
    assert ours.answered_percent > 50
    assert set(ours.cpu_ms) == {"driver", "network", "vision"}
    assert ours.bytes_per_picture > race.jpeg_bytes
    assert race.figures[FLOOR].hot_ms is not None


@pytest.mark.slow
def test_every_peer_answers(tmp_path):
    pytest.importorskip("zmq")
    race = run_race(replace(SMALL, detector_delay_ms=40.0), lambda _: None)
    assert set(race.figures) == {FLOOR, OURS, TCP, *PEERS}
    for name, one in race.figures.items():
        assert one.captured > 10, name
        assert one.p50_ms >= 40, name
        assert name == FLOOR or one.bytes_per_picture > 1000, name


@pytest.mark.slow
def test_viewers_come_and_stall_and_the_loop_goes_on():
    checks = {check.name: check for check in measure_watchers(replace(SMALL, tries=1), 3, lambda _: None)}
    assert checks["not accepted"].value < 50
    assert checks["memory, more"].value < 50


@pytest.mark.slow
def test_the_command_leaves_its_figures_and_its_picture(tmp_path, capsys, monkeypatch):
    app = typer.Typer()
    register_bench(app)
    monkeypatch.setattr("benchmarks.loop_sample.TAKEN_BOUND_PERCENT", 100.0)
    asked = ["--size", "160x120", "--seconds", "2", "--peers", "none", "--out", str(tmp_path / "new"), "--json"]
    code = app(["loop", *asked], standalone_mode=False)
    printed = json.loads(capsys.readouterr().out)
    assert code == (0 if printed["ok"] else 5)
    assert [one["name"] for one in printed["contestants"]] == [FLOOR, OURS]
    assert json.loads((tmp_path / "new" / "loop.json").read_text()) == printed
    assert (tmp_path / "new" / "loop.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_terminated_it_leaves_no_process_and_no_folder(tmp_path):
    code = """
from pathlib import Path
from benchmarks.loop import run_race
from benchmarks.loop_setting import LoopSetting
run_race(LoopSetting(Path(), 160, 120, seconds=60.0, peers=(), tries=1), print)
"""
    bench = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, stderr=subprocess.DEVNULL
    )
    try:
        assert until(lambda: "first answer" in "".join(path.read_text() for path in tmp_path.rglob("floor.log")), 20)
        (floor,) = children_of(bench.pid)
        bench.terminate()
        assert bench.wait(10) != 0
    finally:
        bench.kill()
    assert not Path(f"/proc/{floor}").exists()
    assert not list(tmp_path.iterdir())


def test_a_process_that_cannot_start_is_said_in_its_own_words(monkeypatch):
    monkeypatch.setattr("benchmarks.loop_sample._MODULE", "benchmarks.no_such_module")
    with pytest.raises(HardwareError, match="No module named"):
        run_race(replace(SMALL, peers=()), lambda _: None)
