"""The simulated motors: a command is applied, whatever becomes of its line in the log."""

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


class Short:
    """A disk that has room for four bytes."""

    def __init__(self, log):
        self.log = log

    def write(self, line):
        return self.log.write(line[:4])
