"""`sightline detector --serve` as users start it: a process that is found, answers, reports errors, and ends."""

import signal
import subprocess
import time

import pytest

from sightline.benchmarks.detector import DEADLINE_MS, LONGEST_GAP_MS, StreamPlan, measure_streams
from sightline.evaluation.processes import SIGHTLINE, Processes
from sightline.operator_side.cli import app as cli
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.vision_side.detect.remote.zenoh_detector import ZenohDetector
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.vision.remote import within
from tests.vision_side.detect.remote.test_zenoh_detector import Robot


@pytest.mark.parametrize(("arguments", "what"), [
    (["--serve", "boxes"], "is remote"), (["--serve", "zenoh"], "is remote"),
    (["--serve", "hvs"], "did you mean 'hsv'"), (["--serve", "http+jpeg://"], "http+jpeg://127.0.0.1:8080/detect"),
    (["--serve", "oip+http://127.0.0.1"], "names no model"), (["--serve", "hsv", "--device", "gpu"], "device"),
    (["--serve", "hsv", "--connect", "ws://127.0.0.1:9"], "Zenoh"), (["--serve", "hsv", "--deadline-ms", "0"], "5"),
    (["--serve", "hsv", "--set", "detector.optoins.x=1"], "options"),
    (["--serve", "hsv", "check", "hsv"], "exclude each other"),
])  # fmt: skip
def test_invalid_service_is_one_line_and_exit_code_2(capsys, arguments, what):
    assert cli.run(["detector", *arguments]) == 2
    error = capsys.readouterr().err
    assert what in error and error.count("\n") == 1 and error.startswith("error: ")


@pytest.mark.waits
def test_endpoint_without_a_peer_exits_with_4(capsys):
    assert cli.run(["detector", "--serve", "hsv", "--connect", free_endpoint()]) == 4
    assert capsys.readouterr().err.count("\n") == 1


def test_detector_process_is_found_answers_and_ends_on_request(tmp_path, capsys):
    endpoint = free_endpoint()
    robot = Robot("r1", endpoint, listens=True)
    with robot.link, Processes(tmp_path) as processes, open_zenoh("r1", connect=[endpoint]) as link:
        detector = ZenohDetector(ZenohDetector.Config())
        detector.attach(link)
        processes.start("detector", ["detector", "--serve", "hsv", "--connect", endpoint])
        processes.wait_line("detector", "hsv for robots *", 20)
        assert until(lambda: (robot.here(), detector.detect([robot.frame()], within(0.1))[0])[1], 5)
        assert cli.run(["robots", "--connect", endpoint]) == 0
        assert "detector  of *" in (said := capsys.readouterr().out) and "hsv on cpu: 1 robots" in said
        assert processes.end() == []
        assert "detector: ended; hsv on cpu" in processes.log("detector").read_text()


def test_detector_service_ends_within_a_second_of_a_signal(tmp_path):
    endpoint = free_endpoint()
    command = [*SIGHTLINE, "detector", "--serve", "hsv", "--listen", endpoint]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert "for robots" in process.stdout.readline()
        began_s = time.monotonic()
        process.send_signal(signal.SIGTERM)
        assert process.wait(5) == 0 and time.monotonic() - began_s < 2.0
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.slow
def test_robots_of_a_killed_service_move_to_another_and_no_frame_is_examined_twice(tmp_path):
    plan = StreamPlan(streams=8, seconds=4, services=2, batch_us=5_000, arguments=("--share",), kill=True)
    load = measure_streams(free_endpoint(), tmp_path, plan)
    assert len(load.answered) == 8 and load.repeated == 0 and load.overload < 1.5
    # A wide bound, because other tests load this machine. `sightline bench streams --kill` has the strict one.
    assert load.gap_us < 4_000 * LONGEST_GAP_MS


@pytest.mark.alone
def test_overloaded_service_serves_streams_fairly_and_in_time(tmp_path):
    load = measure_streams(free_endpoint(), tmp_path, StreamPlan(streams=8, seconds=4))
    assert len(load.answered) == 8 and load.overload > 1.5
    # Wide bounds for a slow machine. `sightline bench streams` has the strict ones.
    assert load.p95_ms <= 2 * DEADLINE_MS and load.unfair_percent <= 25
