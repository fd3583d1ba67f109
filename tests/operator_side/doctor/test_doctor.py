"""`sightline doctor`: its findings on this machine, on a real robot, and on a broken link."""

import itertools
import json
import os
import re
import shutil
import socket
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from sightline.operator_side.cli import app as cli
from sightline.operator_side.config.context import Context, write_context
from sightline.operator_side.doctor import machine
from sightline.operator_side.doctor import machine as cameras
from sightline.operator_side.doctor import network as between
from sightline.operator_side.doctor.finding import Finding, as_object, histogram
from sightline.operator_side.setup import keys
from sightline.protocol.config import Config
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports import diagnosis
from sightline.protocol.transports.diagnosis import port_owner
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.robot_side.hardware.cameras.files import FolderCamera
from sightline.robot_side.ports import Picture
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint, free_port, port_of
from tests.fixtures.robot_process import RobotProcess


def _checks(capsys, *arguments):
    code = cli.run(["doctor", "--json", *arguments])
    report = json.loads(capsys.readouterr().out)
    assert code == (0 if report["ok"] else 5)
    return {check["name"]: check for check in report["checks"]}


@pytest.mark.parametrize("values", [[1.0], [3.0, 3.0, 3.0], [0.1 * n for n in range(50)], []])
def test_a_histogram_counts_every_value_once(values):
    assert sum(int(line.rsplit(" ", 1)[1]) for line in histogram(values)) == len(values)


def test_plain_information_is_not_a_failure():
    said, good, bad = Finding("a", None, "x", "do"), Finding("b", True, "y", "do"), Finding("c", False, "z", "do this")
    assert as_object([said, good])["ok"] is True
    assert as_object([said, bad])["ok"] is False
    assert bad.line.endswith("fix: do this") and "fix" not in good.line


def test_values_with_units_are_numbers_in_json():
    check = Finding("round trip", True, "12.5", "", "ms", "60").check
    assert (check["value"], check["bound"]) == (12.5, 60.0)
    assert Finding("a", True, "x", "do").check["fix"] == "" and Finding("a", False, "x", "do").check["fix"] == "do"
    assert Finding("port 1", None, "12").check["value"] == "12"
    assert Finding("odd", None, "n/a", "", "ms").check == {
        "name": "odd", "ok": None, "value": "n/a", "fix": "", "unit": "ms", "bound": None,
    }  # fmt: skip


@pytest.mark.parametrize(("stat", "cpu", "ok"), [
    ("nr_throttled 0\nthrottled_usec 0", "cpu 100 0 100 1000 0 0 0 5 0 0", True),
    ("nr_throttled 12\nthrottled_usec 34000", "cpu 100 0 100 100 0 0 0 50 0 0", False),
])  # fmt: skip
def test_throttled_processor_is_reported(monkeypatch, tmp_path, stat, cpu, ok):
    (tmp_path / "cpu.stat").write_text(stat)
    (tmp_path / "stat").write_text(f"{cpu}\ncpu0 1")
    throttle = tmp_path / "cpu0" / "thermal_throttle"
    throttle.mkdir(parents=True)
    (throttle / "core_throttle_count").write_text("0" if ok else "3")
    for name, path in (("CGROUP", tmp_path), ("CPUS", tmp_path), ("PROC_STAT", tmp_path / "stat")):
        monkeypatch.setattr(machine, name, path)
    found = {one.name: one for one in machine._slowed_down()}
    assert {one.ok for one in found.values()} == {ok} and len(found) == 3
    assert ok or found["throttled by quota"].value == "12 times, 34 ms in all"


@pytest.mark.parametrize(("said", "ok"), [("Power save: on", False), ("Power save: off", True), ("", None)])
def test_power_save_of_wifi_is_reported_with_its_fix(monkeypatch, tmp_path, said, ok):
    (tmp_path / "wlan0" / "wireless").mkdir(parents=True)
    (tmp_path / "eth0").mkdir()
    (tmp_path / "iw").write_text(f"#!/bin/sh\necho '{said}'\n")
    (tmp_path / "iw").chmod(0o755)
    monkeypatch.setattr(machine, "INTERFACES", tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    (found,) = machine._power_save()
    assert (found.name, found.ok) == ("power save wlan0", ok)
    assert found.fix == "sudo iw dev wlan0 set power_save off" if said else "apt install iw" in found.value


_ARP = "IP address HW type Flags HW address Mask Device\n192.168.1.7 0x1 {} aa:bb:cc:dd:ee:ff * wlan0\n"


@pytest.mark.parametrize(("flags", "host", "words"), [
    ("0x0", "192.168.1.7", "client isolation"), ("0x2", "192.168.1.8", ""),
    ("0x2", "192.168.1.7", "a firewall blocks it: sudo ufw allow 9090/tcp on that"),
    ("0x0", "no-such-name.invalid", ""),
])  # fmt: skip
def test_isolated_client_and_firewall_are_distinguished(tmp_path, flags, host, words):
    (tmp_path / "arp").write_text(_ARP.format(flags))
    said = between.neighbor(host, 9090, tmp_path / "arp")
    assert words in said and bool(said) is bool(words)
    assert between.neighbor(host, 9090, tmp_path / "absent") == ""


@pytest.mark.parametrize(("offered", "ok", "said"), [
    (["YUYV", "MJPG"], True, "passes unchanged"), (["YUYV"], None, "this machine encodes each image"),
    (["GREY"], False, "neither MJPG nor YUYV"),
])  # fmt: skip
def test_modes_of_a_camera_are_reported_with_their_cost(capsys, monkeypatch, tmp_path, offered, ok, said):
    (tmp_path / "video3").touch()
    monkeypatch.setattr(cameras, "DEVICES", tmp_path)
    assert list(cameras.modes()) == []  # a file, not a camera
    monkeypatch.setattr(cameras, "formats", lambda device: offered)
    check = _checks(capsys)["modes video3"]
    assert check["ok"] is ok and said in check["value"] and (ok or check["fix"])


def test_camera_that_does_not_open_is_reported(monkeypatch, tmp_path):
    (tmp_path / "video0").mkdir()
    monkeypatch.setattr(cameras, "DEVICES", tmp_path)
    found = next(cameras.modes())
    assert found.ok is False and found.fix


def test_a_format_is_read_from_the_kernels_answer():
    answer = cameras._FORMAT.pack(0, 1, 0, b"Motion-JPEG", int.from_bytes(b"MJPG", "little"), 0)
    assert len(answer) == 64 and cameras.read_format(answer) == "MJPG"


@pytest.mark.parametrize("transport", ["tcp", "udp"])
def test_other_end_is_reported_with_version_clock_and_round_trip(transport):
    endpoint = free_endpoint(f"{transport}/")
    with open_zenoh("r1", listen=[endpoint], role="robot"):
        found = {one.name: one for one in between.findings(endpoint, "r1", "")}
    assert found["version of robot"].ok and "sightline" in found["version of robot"].value
    assert int(re.match(r"the robot's clock is (\d+) ms", found["clock skew"].value)[1]) < 100  # one machine, one clock
    assert found["round trip p50"].ok and "#" in found["jitter"].value
    assert found["link"].ok is False and "no status" in found["link"].value  # it publishes no status


def test_busy_port_is_reported_with_its_owner(capsys, monkeypatch):
    with socket.create_server(("127.0.0.1", free_port())) as server:
        monkeypatch.setattr(machine, "PORTS", {server.getsockname()[1]: "mine"})
        check = _checks(capsys)[f"port {server.getsockname()[1]}"]
    assert "in use by" in check["value"] and f"(pid {os.getpid()})" in check["value"]
    assert f"kill {os.getpid()}," in check["fix"]


def test_port_of_another_user_is_in_use(monkeypatch):
    monkeypatch.setattr(diagnosis, "_descriptors", lambda _process: [])  # /proc/PID/fd of another user
    with socket.create_server(("127.0.0.1", free_port())) as server:
        port = server.getsockname()[1]
        found = machine._port(port, "mine")
    assert found.value == "mine: in use by a process of another user" and "sudo sightline doctor" in found.fix
    assert machine._port(port, "mine").value == "mine: free"


def test_package_of_the_same_name_is_reported(capsys, monkeypatch):
    owners = {"sightline": ["sightline-robot", "sightline"]}
    monkeypatch.setattr(machine.metadata, "packages_distributions", lambda: owners)
    check = _checks(capsys)["package names"]
    assert not check["ok"] and check["fix"].startswith("pip uninstall sightline,")


def test_certificates_near_expiry_are_reported_with_the_command(capsys, tmp_path):
    keys.make(tmp_path / "k", [])
    keys.add(tmp_path / "k", "vision", [], days=10)
    checks = _checks(capsys, "--secure", str(tmp_path / "k"))
    assert checks["key robot"]["ok"] and checks["key ca"]["ok"]
    assert not checks["key vision"]["ok"]
    assert checks["key vision"]["fix"] == f"sightline keys add {tmp_path / 'k'} vision"


@pytest.mark.parametrize(("name", "setting", "value", "fix"), [
    ("DAYS", -0.5, "expired on 2", "sightline keys add {}/k robot"),
    ("AUTHORITY_DAYS", -0.5, "expired on 2", "sightline keys init {}/k-new"),
    ("AUTHORITY_DAYS", 20, "until 2", "sightline keys init {}/k-new"),
    ("_BEGUN_EARLIER", machine.datetime.timedelta(days=-9), "not valid before 2", "set the clock of this machine:"),
])
def test_key_that_no_peer_accepts_is_reported_with_its_fix(capsys, monkeypatch, tmp_path, name, setting, value, fix):
    monkeypatch.setattr(keys, name, setting)
    keys.make(tmp_path / "k", [], days=keys.DAYS)
    check = _checks(capsys, "--secure", str(tmp_path / "k"))["key robot"]
    assert not check["ok"] and check["value"].startswith(value)
    assert check["fix"].startswith(fix.format(tmp_path))


def test_key_of_another_authority_is_reported(capsys, tmp_path):
    keys.make(tmp_path / "other", [])
    keys.make(tmp_path / "k", [])
    shutil.copy(tmp_path / "other/robot.pem", tmp_path / "k")
    checks = _checks(capsys, "--secure", str(tmp_path / "k"))
    assert checks["key robot"]["value"].startswith("of another authority") and checks["key vision"]["ok"]
    assert checks["key robot"]["fix"] == f"sightline keys add {tmp_path / 'k'} robot"


def test_fix_of_a_machine_without_the_authority_names_the_other_machine(capsys, tmp_path):
    keys.make(tmp_path / "k", [])
    keys.add(tmp_path / "k", "vision", [], days=10)
    (tmp_path / "k/ca.key").unlink()  # as on every machine but one
    with pytest.raises(ConfigError):
        keys.add(tmp_path / "k", "vision", [])
    fix = _checks(capsys, "--secure", str(tmp_path / "k"))["key vision"]["fix"]
    assert fix == f"run `sightline keys add DIR vision` where ca.key is, and copy the new files to {tmp_path}/k"


def test_unreadable_certificates_are_reported_with_the_extra(capsys, tmp_path, monkeypatch):
    keys.make(tmp_path / "k", [])
    for name in [one for one in sys.modules if one.partition(".")[0] == "cryptography"]:
        monkeypatch.setitem(sys.modules, name, None)
    check = _checks(capsys, "--secure", str(tmp_path / "k"))["certificates"]
    assert not check["ok"] and "pip install --editable '.[secure]'" in str(check)


def test_closed_port_and_unknown_host_have_different_fixes(capsys, monkeypatch):
    monkeypatch.setattr(between, "neighbor", lambda *_given: "; a firewall blocks it")
    refused = _checks(capsys, "--peer", free_endpoint())["reach"]
    assert "firewall" not in refused["fix"], "a closed port"
    unknown = _checks(capsys, "--peer", "tcp/no-such-name.invalid:7447")["reach"]
    assert "the port is closed" in refused["fix"] and "does not resolve" in unknown["fix"]
    assert not refused["ok"] and not unknown["ok"]


@pytest.mark.parametrize("page", ["how-to/troubleshooting.md", "tutorials/two-machines.md"])
def test_pages_quote_the_line_of_an_address_without_a_reply(page, monkeypatch):
    def create_connection(*_address):
        raise TimeoutError

    monkeypatch.setattr(between.socket, "create_connection", create_connection)
    monkeypatch.setattr(between, "neighbor", lambda *_given: "")
    (found,) = between.findings("tcp/192.0.2.1:7447", "r1", "")
    text = (Path(__file__).parent.parent.parent.parent / "docs" / page).read_text("utf-8")
    assert f"| `{found.fix}` |" in text


@pytest.mark.waits
def test_other_program_on_the_port_is_reported(capsys):
    with socket.create_server(("127.0.0.1", free_port())) as server:
        port = server.getsockname()[1]
        checks = _checks(capsys, "--peer", f"tcp/127.0.0.1:{port}")
    assert checks["round trip p50"]["ok"] and not checks["link"]["ok"]
    assert checks["link"]["fix"] == (
        f"there: sightline robot --listen tcp/0.0.0.0:{port}; what listens on the port now is something else"
    )


@pytest.mark.parametrize("scheme", ["tcp/", "ws/", "ws://", "wss://", "ws-legacy://"])
def test_fix_of_a_link_without_an_answer_keeps_the_scheme(scheme):
    found = between._no_link(LinkError("no answer from it after 5 s; start the robot"), f"{scheme}10.0.0.1:9090")
    assert found.fix.startswith(f"there: sightline robot --listen {scheme}0.0.0.0:9090; ")


def test_fix_of_a_link_is_separate_from_its_problem():
    (found,) = between.findings("quic/127.0.0.1:1", "r1", "")
    assert found.value == "quic/127.0.0.1:1: a quic/ endpoint needs keys"
    assert found.fix == "pass --secure DIR"


def test_invalid_endpoint_is_rejected(capsys):
    assert cli.run(["doctor", "--json", "--peer", "foo"]) == 2
    said = capsys.readouterr()
    assert "error: invalid endpoint 'foo'" in said.err and said.out == "", "before anything is looked at"


def test_address_without_peer_is_rejected_with_the_option(capsys):
    assert cli.run(["doctor", "tcp/127.0.0.1:7447"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == (
        "error: robot 'tcp/127.0.0.1:7447' is an address; run `sightline doctor --peer tcp/127.0.0.1:7447`\n"
    )
    assert cli.run(["doctor", "r*"]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.startswith("error: invalid robot id 'r*': ")


@pytest.mark.parametrize(("saved", "variable", "given", "expected", "origin"), [
    (None, "", [], ("r1", (), ""), ""),
    (None, "", ["car"], ("car", ("tcp/127.0.0.1:7447",), ""), "default"),  # a named robot is not ignored
    (Context("tcp/10.0.0.1:7447", "r7", "/keys"), "", [], ("r7", ("tcp/10.0.0.1:7447",), "/keys"), "context.toml"),
    (Context("tcp/10.0.0.1:7447", "r7"), "", ["r8"], ("r8", ("tcp/10.0.0.1:7447",), ""), "context.toml"),
    (Context("tcp/10.0.0.1:7447", "r7", "/keys"), "ws://a:1,ws://b:2", [], ("r1", ("ws://a:1", "ws://b:2"), ""),
     "SIGHTLINE_CONNECT"),
    (Context("tcp/10.0.0.1:7447", "r7", "/keys"), "ws://a:1", ["--peer", "tcp/c:3"], ("r1", ("tcp/c:3",), ""), ""),
])
def test_doctor_checks_the_address_of_other_client_commands(
    saved, variable, given, expected, origin, capsys, monkeypatch, tmp_path
):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("SIGHTLINE_CONNECT", variable)
    if saved:
        write_context(tmp_path / "sightline/context.toml", saved)
    checked = []
    monkeypatch.setattr(cameras, "modes", list)
    monkeypatch.setattr(machine, "findings", lambda secure: checked.append(secure) or [])
    monkeypatch.setattr(between, "findings", lambda *link: checked.append(link) or [])
    assert cli.run(["doctor", *given]) == 0
    robot, peers, secure = expected
    assert checked == [secure, *((peer, robot, secure) for peer in peers)]
    printed = capsys.readouterr().err
    assert origin in printed and bool(printed) is bool(origin)


def test_missing_camera_is_reported(capsys):
    check = _checks(capsys, "--camera", "v4l2", "--camera-set", "device=/dev/video99")["camera v4l2"]
    assert not check["ok"] and "is not there" in check["value"]


def test_the_rate_that_a_camera_delivers_is_measured(capsys, monkeypatch):
    stamps_us, read = itertools.count(0, 100_000), FolderCamera.read

    def stamped(*given):
        picture = read(*given)
        return picture and replace(picture, t_us=next(stamps_us))

    monkeypatch.setattr(FolderCamera, "read", stamped)
    check = _checks(capsys, "--camera", "folder", "--camera-set", "path=examples/pictures", "--camera-set", "fps=10")
    assert check["camera folder"]["ok"] and check["camera folder"]["value"] == 10.0


class StampedCamera:
    """Delivers an image per read, stamped `step_us` after the last one."""

    model, live = None, True

    class Config(Config):
        step_us: int = 33_333
        jpeg: str = "examples/pictures"
        fps: float = 30.0

    def __init__(self, config):
        image = next(Path(config.jpeg).glob("*.jpg")).read_bytes() if config.jpeg else b"raw pixels"
        self._images = (Picture(image, number * config.step_us) for number in itertools.count())

    def read(self, timeout_s):
        return next(self._images)

    def close(self):
        pass


@pytest.mark.parametrize(("options", "ok", "value", "bound"), [
    ([], True, 30.0, 30.0), (["step_us=454545"], False, 2.2, 30.0),  # the rate of its configuration, also by default
    (["step_us=66666", "fps=0x0F"], True, 15.0, 15.0), (["step_us=66666", "fps =30"], False, 15.0, 30.0),
    (["step_us=0"], False, "the time of its images does not advance", ""),
    (["jpeg="], False, "an image is not a valid JPEG", ""),
    (["step_us=-1"], False, "the time of its images does not advance", ""),
])
def test_camera_that_does_not_deliver_its_rate_is_reported(monkeypatch, options, ok, value, bound):
    monkeypatch.setattr(cameras, "_MEASURED_S", 0.02)
    found = cameras.delivered(f"{__name__}:StampedCamera", options)
    check = found.check
    assert (check["ok"], check["bound"]) == (ok, bound) and bool(check["fix"]) is not ok
    assert check["value"].startswith(value) if isinstance(value, str) else check["value"] == value


def test_invalid_rate_of_a_camera_is_an_error_of_its_configuration():
    found = cameras.delivered("folder", ["path=examples/pictures", 'fps="fast"'])
    assert found.ok is False and "fps" in found.value


@pytest.mark.slow
def test_doctor_checks_a_robot_and_counts_its_frames(capsys, tmp_path):
    with RobotProcess(tmp_path) as robot:
        assert until(lambda: port_owner(port_of(robot.endpoint)), START_S)
        checks = _checks(capsys, "--peer", robot.endpoint)
    assert checks["frames"]["ok"] and checks["round trip p95"]["ok"] and checks["stream"]["ok"]
    assert checks["version of robot"]["ok"] and "robot's clock is" in checks["clock skew"]["value"]
    assert "r1 is DISARMED" in checks["robot"]["value"]
    assert float(checks["frames"]["value"].split()[0]) > 20
