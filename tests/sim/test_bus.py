"""The simulation as a process behind the robot's ports: real sockets, real kills, the motors' log."""

import errno
import json
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.robot_side.guardian.core import HUNG_US
from sightline.robot_side.ports import Camera, Drive, RangeSensor
from sightline.sim.bus import (
    MOTION,
    MOTION_SET,
    SimCamera,
    SimDrive,
    SimRange,
    TruthReader,
    await_simulation,
    default_socket_dir,
)
from sightline.sim.process import SimConfig, SocketFolder, run
from sightline.sim.robot import load_robot
from sightline.sim.zero import _FREE_S

SERVE = (
    "import sys; from sightline.protocol.log import start_log; from sightline.sim.process import SimConfig, run; "
    "start_log(None, 'sim'); sys.exit(run(SimConfig.model_validate_json(sys.argv[1])))"
)
DRIVE = (
    "import sys, time; from sightline.sim.bus import SimDrive\n"
    "drive = SimDrive(SimDrive.Config(socket_dir=sys.argv[1]))\n"
    "drive.set(6.0, 8.0); print('driving', flush=True); time.sleep(60)"
)


@dataclass
class Simulator:
    """A running simulation."""

    process: subprocess.Popen[str]
    socket_dir: str
    log: Path
    ready: str

    def config(self) -> SimDrive.Config:
        return SimDrive.Config(socket_dir=self.socket_dir)

    def rows(self) -> list[list[float]]:
        return [[float(cell) for cell in line.split(",")] for line in self.log.read_text().splitlines()[1:]]


def started(socket_dir: Path, **settings) -> Simulator:
    log = socket_dir / "motors.csv"
    config = {"socket_dir": str(socket_dir), "scenario": "circle", "motor_log": str(log), **settings}
    process = subprocess.Popen(
        [sys.executable, "-c", SERVE, json.dumps(config)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    return Simulator(process, str(socket_dir), log, process.stdout.readline())


@pytest.fixture
def sim(tmp_path) -> Iterator[Simulator]:
    simulator = started(tmp_path)
    yield simulator
    simulator.process.kill()
    simulator.process.wait(10)


def eventually(condition: Callable[[], object], timeout_s: float = 5.0) -> None:
    """Wait until it holds."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, "it never came to hold"
        time.sleep(0.005)


def test_ready_line_and_ports(sim):
    assert "simulation ready" in sim.ready
    camera: Camera = SimCamera(sim.config())
    drive: Drive = SimDrive(sim.config())
    lidar: RangeSensor = SimRange(sim.config())
    assert camera.model == load_robot("raspberry").camera.camera_model()
    eventually(lambda: drive.wheels() is not None)
    scans = []
    eventually(lambda: scans.append(lidar.read()) or scans[-1])
    assert len(scans[-1].ranges_m) == 360
    assert scans[-1].angle_min_rad == pytest.approx(-3.14159, abs=1e-4)
    for port in (camera, drive, lidar):
        port.close()
        port.close()


@pytest.mark.alone
def test_pictures_are_fresh_distinct_and_paced(sim):
    camera = SimCamera(sim.config())
    stamps, ages_us = [], []
    for _ in range(15):
        before_us = time.monotonic_ns() // 1000
        picture = camera.read(1.0)
        assert picture is not None
        assert read_jpeg_size(picture.jpeg).width_px == 320
        assert picture.t_us > before_us - 8_000  # drawn after the request, except for the current step
        ages_us.append(time.monotonic_ns() // 1000 - picture.t_us)
        stamps.append(picture.t_us)
    gaps_us = [later - earlier for earlier, later in pairwise(stamps[1:])]  # the first request may be late
    assert min(gaps_us) >= 28_000
    assert sorted(ages_us)[7] < 30_000


def test_pictures_come_at_the_requested_rate(tmp_path):
    simulator = started(tmp_path, fps=10.0)
    try:
        camera = SimCamera(simulator.config())
        stamps = [camera.read(1.0).t_us for _ in range(5)][1:]  # the first request may be late
    finally:
        simulator.process.kill()
        simulator.process.wait(10)
    assert min(later - earlier for earlier, later in pairwise(stamps)) >= 96_000, "one physics step less than 0.1 s"


def test_a_picture_that_came_too_late_is_not_given_to_the_next_read(sim):
    camera = SimCamera(sim.config())
    assert camera.read(0.0) is None
    time.sleep(0.2)
    requested_us = time.monotonic_ns() // 1000
    picture = camera.read(1.0)
    assert picture is not None
    assert picture.t_us > requested_us - 8_000


def test_encoders_and_truth_follow_the_wheels(sim):
    drive, truth = SimDrive(sim.config()), TruthReader(sim.socket_dir)
    assert (truth.simulated.scenario, truth.simulated.pid) == ("circle", sim.process.pid)
    drive.set(6.0, 8.0)
    eventually(lambda: (angles := drive.wheels()) and angles.right_rad > 4.0)
    angles = drive.wheels()
    assert 0.6 < angles.left_rad / angles.right_rad < 0.85
    assert abs(time.monotonic_ns() // 1000 - angles.t_us) < 200_000
    reports = []
    eventually(lambda: reports.append(truth.read(1.0)) or reports[-1].linear_mps > 0.2)
    assert reports[-1].t_us > reports[0].t_us
    assert all(later.t_us - earlier.t_us == 20_000 for earlier, later in pairwise(reports))


def test_motors_latch_and_the_log_outlives_killed_clients_and_a_killed_simulation(sim):
    client = subprocess.Popen([sys.executable, "-c", DRIVE, sim.socket_dir], stdout=subprocess.PIPE, text=True)
    assert client.stdout.readline() == "driving\n"
    client.send_signal(signal.SIGKILL)
    client.wait(10)
    drive = SimDrive(sim.config())
    eventually(lambda: (angles := drive.wheels()) and angles.right_rad > 8.0)  # a second and more without a driver
    sent_us = time.monotonic_ns() // 1000
    drive.set(1.0, 2.0)
    eventually(lambda: len(sim.rows()) == 2)
    seen_us = time.monotonic_ns() // 1000
    sim.process.kill()
    sim.process.wait(10)
    first, second = sim.rows()
    assert first[1:3] == [6.0, 8.0]
    assert second[1:3] == [1.0, 2.0]
    assert -1000 < second[0] - sent_us < seen_us - sent_us + 1000
    assert second[4] > 8.0 > first[4]


def test_second_owner_of_the_motors_is_reported_and_moves_nothing(sim):
    owner, second = SimDrive(sim.config()), SimDrive(sim.config())
    owner.set(1.0, 2.0)
    eventually(sim.rows)
    second.set(3.0, 4.0)
    assert select.select([second._connection.open()], [], [], 5)[0]
    time.sleep(0.1)  # the end of the connection is there too
    with pytest.raises(HardwareError, match=f"^another process owns the simulated motors in {sim.socket_dir}; end it$"):
        second.wheels()
    assert [row[1:3] for row in sim.rows()] == [[1.0, 2.0]]


def test_drive_of_owned_motors_does_not_open_and_moves_nothing(sim):
    busy = f"^another process owns the simulated motors in {sim.socket_dir}; end it$"
    owner = SimDrive(sim.config())
    owner.set(1.0, 2.0)
    eventually(sim.rows)
    for _ in range(3):
        with pytest.raises(HardwareError, match=busy):
            SimDrive(sim.config())
    owner.set(1.5, 2.5)
    eventually(lambda: len(sim.rows()) == 2)
    assert [row[1:3] for row in sim.rows()] == [[1.0, 2.0], [1.5, 2.5]]
    owner.close()
    SimDrive(sim.config()).close()


@pytest.mark.parametrize("commands", [1, 2, 20])
def test_busy_motors_are_the_reason_whatever_was_sent_meanwhile(sim, commands):
    """The kernel reports packets that the simulation did not read as a reset, before its last message."""
    owner, second = SimDrive(sim.config()), SimDrive(sim.config())
    owner.set(1.0, 2.0)
    eventually(sim.rows)
    sim.process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, sim.process.pid, os.WSTOPPED)
    for _ in range(commands):
        second.set(3.0, 4.0)
    sim.process.send_signal(signal.SIGCONT)
    connection = second._connection.open()
    poll = select.poll()
    poll.register(connection, select.POLLHUP)
    eventually(lambda: any(event & select.POLLHUP for _, event in poll.poll(0)))
    with pytest.raises(HardwareError, match="another process owns the simulated motors"):
        second.set(3.0, 4.0)


def test_drive_opens_when_the_simulation_hangs(sim):
    assert _FREE_S * 1e6 < HUNG_US, "the guardian kills a driver process that is silent for longer"
    sim.process.send_signal(signal.SIGSTOP)
    SimDrive(sim.config()).close()


def test_wheels_that_roll_out_have_lines_unless_a_driver_owns_them(sim):
    drive = SimDrive(sim.config())
    drive.set(8.0, 8.0)
    eventually(lambda: (angles := drive.wheels()) and angles.right_rad > 3.0)
    drive.set(0.0, 0.0)
    eventually(lambda: len(sim.rows()) > 1 and drive.wheels().t_us > sim.rows()[1][0] + 600_000)  # they stand
    assert len(sim.rows()) == 2
    drive.set(8.0, 8.0)
    eventually(lambda: drive.wheels().right_rad > sim.rows()[-1][4] + 3.0)
    drive.set(0.0, 0.0)
    drive.close()
    eventually(lambda: len(sim.rows()) > 8 and sim.rows()[-1][4] - sim.rows()[-2][4] < 0.003)
    coasting = sim.rows()[3:]
    assert all(row[1:3] == [0.0, 0.0] and later[4] >= row[4] for row, later in pairwise(coasting))


def test_last_command_counts_of_a_client_that_dies_without_reading_its_packets(sim):
    """The kernel reports the unread packets as a reset, before what the client had sent."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.connect(f"{sim.socket_dir}/{MOTION}")
        assert select.select([client], [], [], 5)[0], "an encoder reading"
        sim.process.send_signal(signal.SIGSTOP)
        client.send(MOTION_SET.pack(3.0, 4.0))
    sim.process.send_signal(signal.SIGCONT)
    eventually(sim.rows)
    assert sim.rows()[0][1:3] == [3.0, 4.0]


def test_malformed_motor_packets_change_nothing(sim):
    stranger = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    stranger.connect(f"{sim.socket_dir}/{MOTION}")
    nan, inf = float("nan"), float("inf")
    for packet in ((3.0, 3.0), (nan, 1.0), (1.0, -inf), b"short", bytes(65), b"\0" * 4096, (4.0, 4.0)):
        stranger.send(packet if isinstance(packet, bytes) else MOTION_SET.pack(*packet))
    eventually(lambda: len(sim.rows()) >= 2)
    assert [row[1:3] for row in sim.rows()] == [[3.0, 3.0], [4.0, 4.0]]
    stranger.close()
    for bad in (nan, inf):
        with pytest.raises(ValueError, match="wheel speeds"):
            SimDrive(sim.config()).set(bad, 1.0)


@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_simulation_ends_within_a_second_and_the_ports_recover(sim, number, tmp_path):
    camera, drive, lidar = SimCamera(sim.config()), SimDrive(sim.config()), SimRange(sim.config())
    begin_s = time.monotonic()
    sim.process.send_signal(number)
    assert sim.process.wait(10) == 0
    assert time.monotonic() - begin_s < 1.0
    assert not list(tmp_path.glob("*.sock"))
    for use in (lambda: camera.read(0.1), lambda: drive.set(1.0, 1.0), drive.wheels, lidar.read):
        with pytest.raises(HardwareError, match="start it with `sightline sim`"):
            use()
    again = started(tmp_path)
    try:
        drive.set(1.0, 1.0)
        assert camera.read(2.0) is not None
        lidar.read()
    finally:
        again.process.kill()
        again.process.wait(10)


@pytest.mark.slow
def test_a_dead_simulations_sockets_are_replaced_and_a_living_ones_are_not(sim, tmp_path):
    with pytest.raises(ConfigError, match=f"process {sim.process.pid}"):
        run(SimConfig(socket_dir=str(tmp_path)))
    sim.process.kill()
    sim.process.wait(10)
    assert (tmp_path / "motion.sock").exists()
    again = started(tmp_path, seconds=0.2)
    assert "simulation ready" in again.ready
    assert again.process.wait(10) == 0


def test_missing_simulation_gives_one_line_with_the_command(tmp_path):
    for port in (SimCamera, SimDrive, SimRange):
        with pytest.raises(HardwareError) as caught:
            port(port.Config(socket_dir=str(tmp_path)))
        assert str(caught.value) == f"nothing simulates a robot in {tmp_path}; start it with `sightline sim`"


@pytest.mark.parametrize("is_late", [False, True])
def test_robot_waits_for_a_simulation_that_starts_with_it(tmp_path, caplog, monkeypatch, is_late):
    caplog.set_level("INFO")
    monkeypatch.setattr("sightline.sim.bus._ANNOUNCED_AFTER_S", 0.1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(str(tmp_path / MOTION))
        waiting = threading.Thread(target=await_simulation, args=(str(tmp_path), 60.0), daemon=True)
        if is_late:
            waiting.start()
            eventually(lambda: caplog.messages)
        listener.listen()
        if not is_late:
            waiting.start()
        waiting.join(10)
        assert not waiting.is_alive()
    assert caplog.messages == [f"waiting for `sightline sim` in {tmp_path} ..."] * is_late


@pytest.mark.parametrize("seconds", [0.0, 0.2])
def test_wait_for_a_missing_simulation_ends(tmp_path, seconds):
    began_s = time.monotonic()
    await_simulation(str(tmp_path), seconds)
    assert time.monotonic() - began_s >= seconds


def test_bad_settings_are_one_line(tmp_path):
    with pytest.raises(ConfigError, match="did you mean 'circle'"):
        run(SimConfig(scenario="cicle", socket_dir=str(tmp_path)))
    with pytest.raises(ConfigError, match="motor_log"):
        run(SimConfig(socket_dir=str(tmp_path), motor_log=str(tmp_path / "no" / "log.csv")))
    SocketFolder(str(tmp_path)).close()  # the failed run let go of the lock
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="socket_dir"):
        SocketFolder(str(tmp_path / "file"))


@pytest.mark.parametrize(("given", "expected"), [
    ({"TMPDIR": "first", "TMP": "second"}, "first"), ({"TMPDIR": "absent", "TMP": "second"}, "second"),
    ({"TMPDIR": "", "TEMP": "first"}, "first"), ({"TMPDIR": "absent"}, "/tmp"), ({}, "/tmp"),
])  # fmt: skip
def test_robot_and_simulation_look_in_the_same_folder_also_on_a_full_disk(tmp_path, monkeypatch, given, expected):
    for name in ("TMPDIR", "TEMP", "TMP"):
        monkeypatch.delenv(name, raising=False)
    for name, folder in given.items():
        monkeypatch.setenv(name, folder and str(tmp_path / folder))
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        found = default_socket_dir()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert found == str(tmp_path / expected / f"sightline-sim-{os.getuid()}")


@pytest.mark.parametrize("step", ["os.open", "os.ftruncate", "os.write"])
def test_full_disk_names_the_folder_of_the_sockets(tmp_path, monkeypatch, step):
    def fail(*_given):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(step, fail)
        with pytest.raises(ConfigError, match=f"^socket_dir {tmp_path}: No space left on device; choose another with"):
            SocketFolder(str(tmp_path))
    SocketFolder(str(tmp_path)).close()  # the failed one let go of the lock


def test_the_robots_plug_ins_import_no_numpy_and_no_pybullet():
    code = "import sys, sightline.sim.bus; print(sorted({'numpy', 'pybullet', 'cv2', 'simplejpeg'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
