"""A battery from its plug-in to the motors' log: full speed, half speed, HOLD; a broken plug-in slows the robot."""

import time

import pytest

from tests.fixtures import demanded

demanded.module("pybullet", "sim")

from sightline.protocol.config import Config
from sightline.protocol.messages import State
from sightline.sim.bus import SimBattery
from tests.contracts.batteries import check_battery
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision, driving
from tests.sim.test_bus import started

FULL_RAD_S, HALF_RAD_S = 0.4 / 0.035, 0.25 / 0.035
RANGE_M = 5.0
LATE_M = 0.8
"""At 0.4 m/s: a reading a second, and the ramp."""
LIMITS = {"auto_arm": True, "low_battery_v": 7.2, "empty_battery_v": 6.6, "battery_hysteresis_v": 0.2}


@pytest.fixture
def sim(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    simulator = started(folder, scenario="static")
    yield simulator
    simulator.process.kill()
    simulator.process.wait(10)


def test_simulated_battery_keeps_the_contract(sim):
    check_battery(lambda: SimBattery(SimBattery.Config(socket_dir=sim.socket_dir)))


@pytest.mark.slow
@pytest.mark.alone  # a command that comes late on a busy machine slows the wheels
def test_battery_drains_on_the_way_slows_the_robot_to_half_and_holds_it(sim, tmp_path):
    drive = {"kind": "sim", "options": {"socket_dir": sim.socket_dir}}
    battery = {"kind": "sim", "options": {"socket_dir": sim.socket_dir, "range_m": RANGE_M}}
    off = {"kind": "none"}
    with RobotProcess(tmp_path, drive=drive, battery=battery, range_sensor=off, safety=LIMITS) as robot:
        robot.wait_until_on()
        with Vision(robot.endpoint, twist=b"0.4000|0.0000") as vision:
            assert until(lambda: "battery low" in robot.output(), 20), robot.output()
            assert until(lambda: "battery empty" in robot.output(), 30), robot.output()
            assert until(lambda: sim.rows()[-1][1:3] == [0.0, 0.0], 5)
            status = vision.status()
            assert (status.state, status.reason) == (State.HOLD, "the battery is empty")
            assert 6.0 < status.battery_v < 6.6
            assert until(lambda: vision.status().state is State.DISARMED, 15), "after ten seconds in HOLD"
        lines = [line for line in robot.output().splitlines() if ": battery " in line]
    assert [line.split()[5] for line in lines] == ["ok", "low", "empty"], lines
    rows = [((left_rad + right_rad) / 2 * 0.035, speed) for _, speed, _, left_rad, right_rad in sim.rows()]
    way_m = rows[-1][0]
    at = {volts: RANGE_M * (8.4 - volts) / 2.4 for volts in (7.2, 6.6)}  # meters driven at that voltage
    assert max(speed for way, speed in rows if way < at[7.2]) == pytest.approx(FULL_RAD_S, rel=0.01)
    slow = [speed for way, speed in rows if at[7.2] + LATE_M < way < at[6.6]]
    assert slow and slow == pytest.approx([HALF_RAD_S] * len(slow), rel=0.01)
    assert at[6.6] - 0.05 < way_m < at[6.6] + LATE_M


class BrokenBattery:
    """Battery that raises on the first read, returns NaN on the second, and hangs on the third."""

    class Config(Config):
        """Nothing to set."""

    def __init__(self, _config):
        self._reads = 0

    def read(self):
        self._reads += 1
        if self._reads == 1:
            raise RuntimeError("the wire is loose")
        if self._reads == 2:
            return float("nan")
        time.sleep(600)
        return 8.0

    def close(self):
        pass


@pytest.mark.slow
def test_battery_that_raises_returns_nan_or_hangs_slows_the_robot_and_delays_nothing(tmp_path):
    battery = {"kind": f"{__name__}:BrokenBattery"}
    with RobotProcess(tmp_path, battery=battery, safety=LIMITS) as robot:
        robot.wait_until_on()
        with Vision(robot.endpoint, twist=b"0.4000|0.0000") as vision:
            assert driving(robot, HALF_RAD_S * 0.99)
            silent = (State.DEGRADED, "the battery is silent; half speed", None)
            assert until(lambda: (got := vision.status()) and (got.state, got.reason, got.battery_v) == silent, 15)
            assert until(lambda: robot.speed() == pytest.approx(HALF_RAD_S, rel=0.01))
            assert until(lambda: robot.output().count("Traceback") == 2, 15), "the second read comes a second later"
        began_s = time.monotonic()
        robot.process.terminate()
        assert robot.process.wait(5) == 0 and time.monotonic() - began_s < 4
        assert robot.output().count("Traceback") == 2 and "the wire is loose" in robot.output()


def test_robot_without_a_battery_has_none_in_its_status(tmp_path):
    with RobotProcess(tmp_path) as robot:
        robot.wait_until_on()
        with Vision(robot.endpoint) as vision:
            assert driving(robot)
            assert vision.status().battery_v is None
            assert b"battery" not in vision.status_slot.take(2.0).payload
        assert ": battery " not in robot.output()
