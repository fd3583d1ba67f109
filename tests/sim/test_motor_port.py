"""The simulated motors: a command is applied, whatever becomes of its line in the log."""

import pytest

from sightline.evaluation.faults.evidence import measure_stop, read_motors
from sightline.protocol.errors import ConfigError
from sightline.sim import process
from sightline.sim.bus import MOTION_SET
from sightline.sim.process import LOG_HEADER, MotorPort


def test_a_full_disk_costs_lines_and_no_command(caplog):
    motors = MotorPort("/dev/full")
    for number in range(5):
        motors.take(MOTION_SET.pack(number, -number))
        assert motors.speeds_rad_s == (number, -number)
    assert motors.lines_lost == 5
    assert caplog.messages == ["motor log: No space left on device; commands are applied without a line"]
    motors.close()
    assert caplog.messages[1:] == ["motor log: 5 commands have no line"]


def test_lines_are_whole_again_when_the_disk_has_room(tmp_path, monkeypatch):
    motors = MotorPort(str(tmp_path / "motors.csv"))
    motors.take(MOTION_SET.pack(1, 1))
    log = motors._log
    monkeypatch.setattr(motors, "_log", Short(log))
    motors.take(MOTION_SET.pack(2, 2))
    monkeypatch.setattr(motors, "_log", log)
    motors.take(MOTION_SET.pack(3, 3))
    motors.close()
    header, first, cut, last = (tmp_path / "motors.csv").read_text().splitlines()
    assert header.encode() + b"\n" == LOG_HEADER
    assert [line.split(",")[1:3] for line in (first, last)] == [["1.00000", "1.00000"], ["3.00000", "3.00000"]]
    assert len(cut) == 4


def test_log_replaces_an_earlier_log_and_no_other_file(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    MotorPort("~/home.csv").close()
    assert (tmp_path / "home.csv").read_bytes() == LOG_HEADER
    (tmp_path / "empty.csv").touch()
    (tmp_path / "notes.txt").write_text("t_us, my notes\n")
    for name in ("new.csv", "new.csv", "empty.csv"):
        MotorPort(str(tmp_path / name)).close()
        assert (tmp_path / name).read_bytes() == LOG_HEADER
    with pytest.raises(ConfigError, match=r"notes\.txt: exists and is not a motor log; name another file"):
        MotorPort(str(tmp_path / "notes.txt"))
    assert (tmp_path / "notes.txt").read_text() == "t_us, my notes\n"


class Short:
    """A disk that has room for four bytes."""

    def __init__(self, log):
        self.log = log

    def write(self, line):
        return self.log.write(line[:4])


@pytest.mark.parametrize("time_constant_s", [0.03, 0.1, 0.3])
def test_wheels_that_roll_out_without_an_owner_are_logged_until_they_stand(tmp_path, monkeypatch, time_constant_s):
    """Else a stop seems to last until the next driver starts."""
    log, now_us, speed_rad_s = tmp_path / "motors.csv", 1_000_000, 15.0
    monkeypatch.setattr(process, "monotonic_us", lambda: now_us)
    motors = MotorPort(str(log))
    motors.coast()
    assert log.read_bytes() == LOG_HEADER, "no wheel has turned yet"
    motors.take(MOTION_SET.pack(speed_rad_s, speed_rad_s))
    now_us += 100_000
    motors.coast()
    assert len(read_motors(log.read_text())) == 1, "a motor that turns is in the log until it is set otherwise"
    motors.take(MOTION_SET.pack(0.0, 0.0))
    stands_ms = 0.0
    for step in range(500):
        now_us += 4_000
        speed_rad_s *= 1 - 0.004 / time_constant_s
        angle_rad = motors.angles_rad[0] + speed_rad_s * 0.004
        motors.angles_rad = (angle_rad, angle_rad)
        motors.coast()
        stands_ms = 4.0 * step if speed_rad_s * 0.033 > 0.01 else stands_ms
    rows = read_motors(log.read_text())
    motors.close()
    assert measure_stop(rows, 1_100_000).zero_ms == pytest.approx(stands_ms, abs=30)
    assert len(rows) < 2 + 50 * 10 * time_constant_s + 3, "and no line after that"
