"""`sightline stop` against a real robot, direct and behind a router, with and without keys; each STOP also by UDP."""

import subprocess
import sys
from contextlib import ExitStack

import pytest

from sightline.operator_side.setup import keys
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision

COMMAND = [sys.executable, "-P", "-m", "sightline.operator_side.cli.app"]


@pytest.mark.slow
@pytest.mark.parametrize("secured", [False, True])
@pytest.mark.parametrize("routed", [False, True])
def test_stop_ends_with_zero_wheels_and_a_latch_on_disk(tmp_path, routed, secured):
    endpoint, changes, secure = free_endpoint(), {}, []
    if secured:
        keys.make(tmp_path / "keys", [])
        endpoint, secure = endpoint.replace("tcp/", "tls/"), ["--secure", str(tmp_path / "keys")]
        changes["secure"] = str(tmp_path / "keys")
    if routed:
        changes |= {"listen": [], "connect": [endpoint]}
    with ExitStack() as ending:
        if routed:
            router = ending.enter_context(
                subprocess.Popen([*COMMAND, "router", "--listen", endpoint, *secure], stdout=subprocess.PIPE, text=True)
            )
            ending.callback(router.terminate)
            assert " info router: on " in router.stdout.readline()
        robot = ending.enter_context(RobotProcess(tmp_path, endpoint=endpoint, **changes))
        robot.wait_until_on()
        ending.enter_context(Vision(endpoint, secure=changes.get("secure", "")))
        assert until(lambda: robot.speed() > 0, START_S)
        done = subprocess.run(
            [*COMMAND, "stop", "r1", "--connect", endpoint, *secure], capture_output=True, text=True, timeout=30,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "STOPPED" in done.stdout and "not on its disk" not in done.stderr
        assert robot.speed() == 0 and (tmp_path / "state" / "r1.stopped").exists()
        assert "STOP by a datagram" in robot.output(), "the datagram was first"
