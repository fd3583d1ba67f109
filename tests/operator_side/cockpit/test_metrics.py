"""`sightline metrics` against a real robot, read with Prometheus' own parser; a robot that is gone is down."""

import socket
import subprocess
import urllib.error
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families as parsed

from sightline.evaluation.processes import SIGHTLINE
from sightline.operator_side.cli import app as cli
from tests.fixtures.links import until
from tests.fixtures.ports import free_port
from tests.fixtures.robot_process import RobotProcess, Vision, driving


def _samples(port):
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
        text = answer.read().decode()
    return {(s.name, *sorted(s.labels.values())): s.value for family in parsed(text) for s in family.samples}


def _ready(port):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/ready", timeout=5) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


@pytest.mark.slow
def test_metrics_show_a_robot_and_its_end(tmp_path):
    port = free_port()
    with RobotProcess(tmp_path) as robot, Vision(robot.endpoint) as vision:
        command = [*SIGHTLINE, "metrics", "r1", "--connect", robot.endpoint]
        exporter = subprocess.Popen([*command, "--port", str(port)], stdout=subprocess.PIPE, text=True)
        try:
            assert exporter.stdout.readline() == f"metrics of r1: http://127.0.0.1:{port}/metrics\n"
            assert driving(robot)
            assert until(lambda: _ready(port) == 200)
            assert until(lambda: 0 < _samples(port).get(("sightline_frame_age_seconds", "r1"), 0) < 0.15)
            vision.twist = b"nan|0"
            assert until(lambda: _samples(port).get(("sightline_commands_refused_total", "NOT_FINITE", "r1"), 0) > 3)
            assert until(lambda: _samples(port)["sightline_frames_sent_total", "r1"] > 10)
            samples = _samples(port)
            assert samples["sightline_up", "r1"] == 1
            assert samples["sightline_commands_accepted_total", "r1"] > 5
            assert samples["sightline_frames_overtaken_total", "r1"] >= 0
            assert 0 < samples["sightline_round_trip_seconds", "r1"] < 0.5
            robot.kill_network()
            assert until(lambda: _samples(port).get(("sightline_holds_total", "r1"), 0) > 0, 8)
            samples = _samples(port)
            assert sum(value for key, value in samples.items() if key[0] == "sightline_state") == 1
            robot.process.terminate()
            assert until(lambda: _samples(port) == {("sightline_up", "r1"): 0}, 6)
            assert _ready(port) == 503
        finally:
            exporter.terminate()
            assert exporter.wait(20) == 0


@pytest.mark.slow
def test_busy_port_is_reported_with_its_owner(tmp_path):
    with RobotProcess(tmp_path) as robot, socket.create_server(("127.0.0.1", free_port())) as taken:
        command = [*SIGHTLINE, "metrics", "--connect", robot.endpoint, "--port"]
        robot.wait_until_on()
        port = str(taken.getsockname()[1])
        done = subprocess.run([*command, port], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 4
    assert f"port {port} is in use by" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.slow
def test_vision_service_is_measured_and_ready_while_its_link_is_open(tmp_path):
    port = free_port()
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        command = [*SIGHTLINE, "vision", "--connect", robot.endpoint]
        vision = subprocess.Popen([*command, "--metrics", str(port)], stdout=subprocess.PIPE, text=True)
        try:
            assert until(lambda: _ready_if_up(port) == 200, 40)
            assert until(lambda: _samples(port).get(("sightline_vision_hears", "r1")) == 1)
            samples = _samples(port)
            received = samples["sightline_vision_frames_received_total", "r1"]
            assert received >= samples["sightline_vision_frames_answered_total", "r1"] > 0
            assert samples["sightline_vision_restarts_total", "r1"] == 0
            assert until(lambda: _samples(port)["sightline_vision_compute_seconds", "r1"] > 0)
            robot.process.terminate()
            assert until(lambda: _samples(port)["sightline_vision_hears", "r1"] == 0, 15)
            assert _ready(port) == 503, "the robot was its link"
        finally:
            vision.terminate()
            assert vision.wait(20) == 0


def _ready_if_up(port):
    try:
        return _ready(port)
    except OSError:
        return 0


@pytest.mark.parametrize("where", ["", "x", "0", "70000", "1:2:3", "a b:9", "::1:9465", "[::1]", "[]:9", "[:9"])
def test_invalid_address_is_rejected(where, capsys):
    assert cli.run(["vision", "--metrics", where]) == 2
    assert capsys.readouterr().err.startswith(f"error: invalid --metrics '{where}'")
