"""`sightline doctor`: what it says of this machine, of a real robot, and of a way that leads nowhere."""

import json
import socket

import pytest

from operator_side import cli, keys
from operator_side.doctor import machine
from operator_side.doctor.finding import Finding, as_object, histogram
from protocol.transports.port_owner import port_owner
from tests.link_rigs import free_endpoint, until
from tests.robot_process import RobotProcess


def _checks(capsys, *arguments):
    code = cli.run(["doctor", "--json", *arguments])
    report = json.loads(capsys.readouterr().out)
    assert code == (0 if report["ok"] else 5)
    return {check["name"]: check for check in report["checks"]}


@pytest.mark.parametrize("values", [[1.0], [3.0, 3.0, 3.0], [0.1 * n for n in range(50)], []])
def test_a_histogram_counts_every_value_once(values):
    assert sum(int(line.rsplit(" ", 1)[1]) for line in histogram(values)) == len(values)


def test_what_is_only_said_is_no_failure():
    said, good, bad = Finding("a", None, "x", "do"), Finding("b", True, "y", "do"), Finding("c", False, "z", "do this")
    assert as_object([said, good])["ok"] is True
    assert as_object([said, bad])["ok"] is False
    assert bad.line.endswith("fix: do this") and "fix" not in good.line


def test_a_busy_port_is_told_with_its_owner(capsys, monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setattr(machine, "PORTS", {server.getsockname()[1]: "mine"})
        check = _checks(capsys)[f"port {server.getsockname()[1]}"]
    assert "in use by" in check["value"] and "(pid " in check["value"] and check["fix"]


def test_a_package_of_the_same_name_is_told(capsys, monkeypatch):
    monkeypatch.setattr(machine.metadata, "packages_distributions", lambda: {"protocol": ["sightline", "protocol"]})
    check = _checks(capsys)["package names"]
    assert not check["ok"] and check["fix"].startswith("pip uninstall protocol")


def test_certificates_near_their_end_are_told_with_the_command(capsys, tmp_path):
    keys.make(tmp_path / "k", [])
    keys.add(tmp_path / "k", "vision", [], days=10)
    checks = _checks(capsys, "--secure", str(tmp_path / "k"))
    assert checks["key robot"]["ok"] and checks["key ca"]["ok"]
    assert not checks["key vision"]["ok"]
    assert checks["key vision"]["fix"] == f"sightline keys add {tmp_path / 'k'} vision"


def test_nobody_listening_is_told_apart_from_no_such_name(capsys):
    refused = _checks(capsys, "--peer", free_endpoint())["reach"]
    unknown = _checks(capsys, "--peer", "tcp/no-such-name.invalid:7447")["reach"]
    assert "nobody listens" in refused["fix"] and "no machine is called" in unknown["fix"]
    assert not refused["ok"] and not unknown["ok"]


def test_somebody_else_on_the_port_is_no_robot(capsys):
    with socket.create_server(("127.0.0.1", 0)) as server:
        checks = _checks(capsys, "--peer", f"tcp/127.0.0.1:{server.getsockname()[1]}")
    assert checks["round trip p50"]["ok"] and not checks["link"]["ok"]


def test_an_endpoint_that_is_none_is_refused(capsys):
    assert cli.run(["doctor", "--json", "--peer", "foo"]) == 2
    assert "error: endpoint 'foo' is none" in capsys.readouterr().err


def test_a_camera_that_is_not_there_says_so(capsys):
    check = _checks(capsys, "--camera", "v4l2", "--camera-set", "device=/dev/video99")["camera v4l2"]
    assert not check["ok"] and "is not there" in check["value"]


def test_the_rate_that_a_camera_delivers_is_measured(capsys):
    check = _checks(capsys, "--camera", "folder", "--camera-set", "path=examples/pictures", "--camera-set", "fps=10")
    assert check["camera folder"]["ok"] and float(check["camera folder"]["value"]) == pytest.approx(10, rel=0.2)


@pytest.mark.slow
def test_a_robot_is_looked_at_and_its_frames_counted(capsys, tmp_path):
    with RobotProcess(tmp_path) as robot:
        assert until(lambda: port_owner(int(robot.endpoint.rpartition(":")[2])))
        checks = _checks(capsys, "--peer", robot.endpoint)
    assert checks["frames"]["ok"] and checks["round trip p95"]["ok"]
    assert "r1 is DISARMED" in checks["robot"]["value"]
    assert float(checks["frames"]["value"].split()[0]) > 20
