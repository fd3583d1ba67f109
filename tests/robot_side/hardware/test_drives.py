"""Every drive we ship, and the one to copy, keeps what a drive promises; `gpio` has its own file."""

import time

import pytest

from examples.my_drive import MyDrive
from sightline.evaluation.processes import Processes
from sightline.protocol.errors import HardwareError
from sightline.robot_side.hardware.log_drive import LogDrive
from sightline.robot_side.ports import WheelAngles
from tests.contracts.drives import check_drive
from tests.fixtures import demanded

pytestmark = pytest.mark.waits


def test_the_log_drive(tmp_path):
    config = LogDrive.Config(path=tmp_path / "drive.csv")
    check_drive(lambda: LogDrive(config), lambda: LogDrive.zero(config.model_dump(mode="json")))


def test_the_drive_to_copy(tmp_path):
    config = MyDrive.Config(port=tmp_path / "port")
    config.port.touch()
    check_drive(lambda: MyDrive(config), lambda: MyDrive.zero(config.model_dump(mode="json")))


def test_drive_to_copy_creates_no_file_for_a_missing_port(tmp_path):
    port = tmp_path / "ttyUSB0"
    with pytest.raises(HardwareError, match=f"motor controller {port}: No such file or directory; is it plugged in"):
        MyDrive(MyDrive.Config(port=port))
    with pytest.raises(HardwareError, match=f"motor controller {port}: No such file or directory; is it plugged in"):
        MyDrive.zero({"port": str(port)})
    assert not port.exists()


@pytest.mark.slow
def test_the_simulated_drive(tmp_path):
    demanded.module("pybullet", "sim")
    from sightline.sim.bus import SimDrive

    with Processes(tmp_path) as processes:
        processes.start("sim", ["sim", "--scenario", "static", "--socket-dir", str(tmp_path)])
        processes.wait_line("sim", "simulation ready", 20.0)
        config = SimDrive.Config(socket_dir=str(tmp_path))
        check_drive(lambda: SimDrive(config), lambda: SimDrive.zero(config.model_dump(mode="json")))


class Broken(LogDrive):
    """A drive with one thing wrong."""

    def __init__(self) -> None:
        super().__init__(LogDrive.Config())


class Slow(Broken):
    def set(self, left_rad_s, right_rad_s):
        time.sleep(0.06)
        super().set(left_rad_s, right_rad_s)


class Forgets(Broken):
    """Its speeds last a tenth of a second."""

    def wheels(self):
        reading = super().wheels()
        if reading.t_us - self._angles.t_us > 100_000:
            self._angles, self._speeds = reading, (0.0, 0.0)
        return reading


class Crossed(Broken):
    def set(self, left_rad_s, right_rad_s):
        super().set(right_rad_s, left_rad_s)


class Coasts(Broken):
    def set(self, left_rad_s, right_rad_s):
        super().set(left_rad_s or 0.5, right_rad_s or 0.5)


class Ahead(Broken):
    def wheels(self):
        reading = super().wheels()
        return WheelAngles(reading.left_rad, reading.right_rad, reading.t_us + 1_000_000)


class ClosesOnce(Broken):
    def close(self):
        assert not hasattr(self, "closed"), "closed twice"
        self.closed = True


@pytest.mark.parametrize("broken", [Slow, Forgets, Crossed, Coasts, Ahead, ClosesOnce])
def test_drive_contract_finds_each_broken_promise(broken):
    with pytest.raises(AssertionError):
        check_drive(broken, lambda: LogDrive.zero({"path": None}))
