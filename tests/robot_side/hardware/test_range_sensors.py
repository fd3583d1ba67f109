"""A range sensor may stamp a scan when it is read: such a scan is new, not from the future, and the wheels turn on."""

import pytest

from sightline.protocol.clock import monotonic_us
from tests.e2e.test_missions import FarSensor
from tests.fixtures.links import until
from tests.fixtures.robot_process import RobotProcess, Vision, driving


@pytest.mark.alone
def test_wheels_do_not_falter_with_every_scan(tmp_path):
    sensor = {"kind": f"{FarSensor.__module__}:{FarSensor.__name__}"}
    with RobotProcess(tmp_path, range_sensor=sensor) as robot:
        robot.wait_until_on()
        with Vision(robot.endpoint):
            assert driving(robot), "0.4 m/s"
            since_us = monotonic_us()
            assert until(lambda: robot.motor_rows()[-1][0] > since_us + 1_000_000, 5), "ten scans"
            assert min(left for t_us, left, _ in robot.motor_rows() if t_us > since_us) > 0.0
