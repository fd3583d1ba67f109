"""Ten thousand random and mutated messages on each protocol: documented rejections only, no growth, no disturbance."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sightline.protocol.channels import STATUS, TWIST
from sightline.protocol.errors import RejectReason
from sightline.protocol.transports.link import INEXACT_KEY, OVERSIZE
from sightline.protocol.transports.websocket.framing import BAD_FRAMING, BAD_HELLO, OTHER_ROBOT
from sightline.protocol.transports.websocket.link import open_websocket
from sightline.protocol.transports.websocket.peer import SILENT
from sightline.protocol.transports.websocket.server import CROSS_SITE, TOO_MANY_CLIENTS, WRONG_SUBPROTOCOL
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.websocket import address_of

STRANGERS = Path(__file__).parent.parent.parent.parent / "e2e" / "third_party"
COUNT = 10_000
DOCUMENTED = {BAD_FRAMING, BAD_HELLO, OTHER_ROBOT, OVERSIZE, INEXACT_KEY, CROSS_SITE, TOO_MANY_CLIENTS}
DOCUMENTED |= {WRONG_SUBPROTOCOL, SILENT, *RejectReason}


class EchoingRobot:
    """The robot, in a process of its own."""

    def __init__(self, log) -> None:
        self.endpoints = {"v1": free_endpoint("ws://"), "older": free_endpoint("ws-legacy://")}
        command = [sys.executable, str(STRANGERS / "echoing_robot.py"), *self.endpoints.values()]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=log, text=True)
        assert self._process.stdout.readline() == "up\n"

    def ask(self) -> dict:
        print("?", file=self._process.stdin, flush=True)
        return json.loads(self._process.stdout.readline())

    def close(self) -> None:
        self._process.stdin.close()
        assert self._process.wait(5) == 0


def round_trips_s(link, slot, seconds: float, ends=lambda: False) -> list[float]:
    """A twist each 10 ms, and how long until it came back."""
    took, number, end_s = [], 0, time.monotonic() + seconds
    while time.monotonic() < end_s and not ends():
        number += 1
        begin_s = time.monotonic()
        link.publish(TWIST, b"{}", b"%d|0" % number)
        while (got := slot.take(1.0)) and got.payload != b"%d|0" % number:
            pass
        took.append(time.monotonic() - begin_s)
        time.sleep(max(0.0, 0.01 - took[-1]))
    return sorted(took)


@pytest.mark.alone
@pytest.mark.parametrize(("dialect", "seed"), [("v1", 1), ("older", 3), pytest.param("v1", 2, marks=pytest.mark.long)])
def test_ten_thousand_hostile_messages_do_no_harm(tmp_path, dialect, seed):
    with (tmp_path / "robot.log").open("w") as log:
        robot = EchoingRobot(log)
        host, port = address_of(robot.endpoints[dialect])
        hostile = [sys.executable, str(STRANGERS / "hostile_peer.py"), str(port)]
        with open_websocket("r1", connect=robot.endpoints["v1"], role="teleop") as good:
            status = good.latest(STATUS)
            assert until(lambda: good.has_listener(TWIST))
            subprocess.run([*hostile, "500", "99", dialect], check=True, capture_output=True)  # all code paths warm
            quiet = round_trips_s(good, status, 3.0)
            before = robot.ask()
            attack = [*hostile, str(COUNT), str(seed), dialect]
            with subprocess.Popen(attack, stdout=subprocess.PIPE, text=True) as peer:
                took = round_trips_s(good, status, 120.0, lambda: peer.poll() is not None)
                assert int(peer.stdout.readline()) == COUNT
            after = robot.ask()
            assert took[int(0.99 * len(took))] - quiet[int(0.99 * len(quiet))] <= 0.02
            assert after["kib"] - before["kib"] < 5_000
            assert after["raised"] == 0
            assert set(after["refused"]) <= DOCUMENTED
            assert sum(after["refused"].values()) > COUNT / 20  # it was hostile indeed
            assert good.rejected == {}
        robot.close()
    assert host == "127.0.0.1"
    assert "Traceback" not in (tmp_path / "robot.log").read_text()
