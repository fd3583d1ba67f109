"""`sightline stop` against a real robot, direct and behind a router, with and without keys; each STOP also by UDP."""

import json
import subprocess
from contextlib import ExitStack, contextmanager

import pytest

from sightline.evaluation.processes import SIGHTLINE
from sightline.operator_side.setup import keys
from tests.fixtures.links import START_S, until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess, Vision

CASES = [part for number in range(22, 27) for part in ("--only", f"R-STOP-{number}")]


@contextmanager
def running_robot(folder, routed, secured):
    """The robot, its endpoint or that of its router, and the options that name the keys."""
    endpoint, changes, secure = free_endpoint(), {}, []
    if secured:
        keys.make(folder / "keys", [])
        endpoint, secure = endpoint.replace("tcp/", "tls/"), ["--secure", str(folder / "keys")]
        changes["secure"] = str(folder / "keys")
    if routed:
        changes |= {"listen": [], "connect": [endpoint]}
    with ExitStack() as ending:
        if routed:
            router = ending.enter_context(
                subprocess.Popen([*SIGHTLINE, "router", "--listen", endpoint, *secure],
                                 stdout=subprocess.PIPE, text=True)
            )
            ending.callback(router.terminate)
            assert " info router: on " in router.stdout.readline()
        robot = ending.enter_context(RobotProcess(folder, endpoint=endpoint, **changes))
        robot.wait_until_on()
        yield robot, endpoint, secure


@pytest.mark.slow
@pytest.mark.parametrize("secured", [False, True])
@pytest.mark.parametrize("routed", [False, True])
def test_stop_ends_with_zero_wheels_and_a_latch_on_disk(tmp_path, routed, secured):
    with running_robot(tmp_path, routed, secured) as (robot, endpoint, secure), \
            Vision(endpoint, secure="".join(secure[1:])):
        assert until(lambda: robot.speed() > 0, START_S)
        done = subprocess.run(
            [*SIGHTLINE, "stop", "r1", "--connect", endpoint, *secure], capture_output=True, text=True, timeout=30,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert "STOPPED" in done.stdout and "not on its disk" not in done.stderr
        assert robot.speed() == 0 and (tmp_path / "state" / "r1.stopped").exists()
        assert "STOP by a datagram" in robot.output(), "the datagram was first"


@pytest.mark.slow
@pytest.mark.parametrize(("routed", "secured"), [(False, False), (True, True)])
def test_robot_passes_the_cases_about_its_stop_port(tmp_path, routed, secured):
    with running_robot(tmp_path, routed, secured) as (_robot, endpoint, secure):
        done = subprocess.run([*SIGHTLINE, "conform", "robot", endpoint, *secure, *CASES, "--json"],
                              capture_output=True, text=True, timeout=60, check=False)
    outcomes = {one["name"]: one["value"] for one in json.loads(done.stdout)["checks"]}
    keyed = "passed" if secured else "not applicable"
    assert outcomes == {f"R-STOP-{number}": "passed" if number < 26 else keyed for number in range(22, 27)}, done.stderr
