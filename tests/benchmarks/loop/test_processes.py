"""`sightline bench loop`, `watchers` and `camera`: short runs of real processes and sockets; nothing is timed."""

import json
import math
import os
import socket
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import typer

from sightline.benchmarks.loop import viewers
from sightline.benchmarks.loop.counters import carried_between, carried_bytes
from sightline.benchmarks.loop.figures import FLOOR, OURS, PEERS, Course, LoopSetting
from sightline.benchmarks.loop.pictures import COUNT, camera_of, write_pictures
from sightline.benchmarks.loop.race import run_race
from sightline.benchmarks.loop.viewers import Watch, measure_watchers
from sightline.benchmarks.loop.vision import PipelineVision
from sightline.benchmarks.peers.classic_detector import ClassicVision
from sightline.evaluation.processes import children_of
from sightline.operator_side.cli.bench import register
from sightline.protocol.errors import HardwareError
from sightline.robot_side.hardware.cameras.files import FolderCamera, FolderCameraConfig
from tests.fixtures import demanded
from tests.fixtures.links import until
from tests.fixtures.ports import free_port

SMALL = LoopSetting(Path(), 160, 120, fps=30.0, seconds=2.0, tries=1)


def test_the_pictures_are_those_of_the_camera_and_every_one_is_answered(tmp_path):
    mean_bytes = write_pictures(tmp_path, 640, 480)
    assert 40_000 < mean_bytes < 52_000
    camera = FolderCamera(FolderCameraConfig(path=tmp_path))
    assert camera.model == camera_of(640, 480)
    eyes = PipelineVision(640, 480, 0.0)
    answers = {eyes.answer(33_333 * at, path.read_bytes()) for at, path in enumerate(sorted(tmp_path.iterdir()), 1)}
    assert len(answers) > 20  # the ball goes round, and the command with it


def test_user_detector_finds_the_same_ball(tmp_path):
    write_pictures(tmp_path, 640, 480)
    turned = 0
    for number, path in enumerate(sorted(tmp_path.iterdir())):
        linear, angular = map(float, ClassicVision(0.0, 0.0).answer(1, path.read_bytes()).split("|"))
        right = math.cos(math.tau * number / COUNT)  # that is how the ball goes round
        assert linear > 0 and angular * right <= 0
        turned += angular != 0
    assert turned > COUNT // 2


def test_user_detector_finds_nothing_in_an_empty_image_and_reports_invalid_bytes(tmp_path):
    import cv2
    import numpy as np

    plain = cv2.imencode(".jpg", np.full((120, 160, 3), 130, np.uint8))[1].tobytes()
    assert ClassicVision(0.0, 0.0).answer(1, plain) == "0|0"
    with pytest.raises(ValueError, match="decode"):
        ClassicVision(0.0, 0.0).answer(1, b"no picture")


def test_the_kernel_counts_the_bytes_of_a_connection():
    with socket.create_server(("127.0.0.1", free_port())) as server:
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


def test_busiest_of_several_connections_counts():
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
    assert set(ours.cpu_ms) == {"guardian", "driver", "network", "stop", "vision"}
    assert ours.bytes_per_picture > race.jpeg_bytes
    assert ours.memory_mb["vision"] < race.figures[FLOOR].memory_mb["vision"] + 30, "the same detector for both"
    assert race.figures[FLOOR].hot_ms is not None


@pytest.mark.long
@pytest.mark.alone
def test_every_peer_answers(tmp_path):
    demanded.module("zmq", "bench")
    race = run_race(replace(SMALL, detector_delay_ms=40.0), lambda _: None)
    assert set(race.figures) == {FLOOR, OURS, *PEERS}
    for name, one in race.figures.items():
        assert one.captured > 10, name
        assert one.p50_ms >= 40, name
        assert name == FLOOR or one.bytes_per_picture > 1000, name


@pytest.mark.slow
def test_loop_continues_while_viewers_stall():
    checks = {check.name: check for check in measure_watchers(replace(SMALL, tries=1), 3, lambda _: None)}
    assert checks["not accepted"].value < 50
    assert checks["memory, more"].value < 50


@pytest.mark.parametrize(("fps", "failed"), [(30.0, set()), (1.0, {"answered per second"})])
def test_loop_that_films_few_images_beside_viewers_fails(fps, failed):
    ages_us = tuple((number * 33_333, 20_000) for number in range(60))
    alone = Watch(Course(60, 100.0, ages_us), 30.0, 50.0, 0.0)
    checks = viewers._checks(30.0, alone, replace(alone, fps=fps))
    assert {check.name for check in checks if not check.ok} == failed


class ForeverError(Exception):
    """A wait that nothing ends."""


class Seen:
    """An event whose `wait` fails at once where it would last for ever."""

    def __init__(self):
        self.set, self.wait = (lambda: setattr(self, "wait", lambda: None)), self.fail

    def fail(self):
        raise ForeverError


@pytest.mark.parametrize(("admitted", "printed"), [(["viewer0", "viewer1"], "watching\n"), (["viewer0"], "")])
def test_viewers_watch_only_when_each_has_seen_a_frame(monkeypatch, capsys, admitted, printed):
    class Viewer(nullcontext):
        def subscribe(self, _channel, saw):
            if self.enter_result in admitted:
                saw(None)

        def __enter__(self):
            return self

    monkeypatch.setattr(viewers, "open_link", lambda *_, role, **__: Viewer(role))
    monkeypatch.setattr(viewers.threading, "Event", Seen)
    with pytest.raises(ForeverError):
        viewers.main("tcp/127.0.0.1:1", 2, 0.0)
    assert capsys.readouterr().out == printed


@pytest.mark.slow
def test_the_command_leaves_its_figures_and_its_picture(tmp_path, capsys, monkeypatch):
    app = typer.Typer()
    register(app)
    monkeypatch.setattr("sightline.benchmarks.loop.race.TAKEN_BOUND_PERCENT", 100.0)
    asked = ["--size", "160x120", "--seconds", "2", "--peers", "none", "--out", str(tmp_path / "new"), "--json"]
    code = app(["bench", "loop", *asked], standalone_mode=False)
    printed = json.loads(capsys.readouterr().out)
    assert code == (0 if printed["ok"] else 5)
    assert [one["name"] for one in printed["contestants"]] == [FLOOR, OURS]
    assert json.loads((tmp_path / "new" / "loop.json").read_text()) == printed
    assert (tmp_path / "new" / "loop.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.slow
def test_terminated_it_leaves_no_process_and_no_folder(tmp_path):
    code = """
from pathlib import Path
from sightline.benchmarks.loop.race import run_race
from sightline.benchmarks.loop.figures import LoopSetting
run_race(LoopSetting(Path(), 160, 120, seconds=60.0, peers=(), tries=1), print)
"""
    bench = subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(tmp_path)}, stderr=subprocess.DEVNULL
    )
    try:
        assert until(lambda: "first answer" in "".join(path.read_text() for path in tmp_path.rglob("floor.log")), 20)
        children = children_of(bench.pid)
        assert children
        bench.terminate()
        assert bench.wait(10) != 0
    finally:
        bench.kill()
    assert until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in children))
    assert not list(tmp_path.iterdir())


def test_process_that_cannot_start_reports_its_own_error(monkeypatch):
    monkeypatch.setattr("sightline.benchmarks.loop.race._MODULE", "benchmarks.no_such_module")
    with pytest.raises(HardwareError, match="No module named"):
        run_race(replace(SMALL, peers=()), lambda _: None)

