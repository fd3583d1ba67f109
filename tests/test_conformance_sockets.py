"""The cases with sockets of their own, in real time: our own links, a small server, and that server with one defect."""

from concurrent.futures import ProcessPoolExecutor

import pytest

from protocol.conformance.live import LiveBench
from protocol.conformance.raw_websocket import LOST, PING, TEXT, RawWebSocket, split_url, xor
from protocol.conformance.robot import CASES, prepare
from protocol.conformance.runner import Outcome, run_cases
from protocol.conformance.virtual import FROM_ROBOT
from protocol.errors import ConfigError, LinkError
from protocol.transports.opening import open_link
from tests.conformance.broken_sockets import DEFECTS
from tests.conformance.small_server import SmallServer
from tests.link_rigs import free_endpoint
from tests.robot_process import RobotProcess

REAL = [case for case in CASES if case.real]
AT_ONCE = 8
"""Servers at a time: they wait far more than they compute."""


def run_at(endpoint, older=""):
    def open_it():
        return open_link("r1", connect=[endpoint], role="vision", timeout_s=20)

    with LiveBench("r1", open_it, FROM_ROBOT, endpoint=endpoint, older=older) as bench:
        return run_cases(REAL, bench, prepare)


def bad(results):
    return {one.case.id: one.reason for one in results if one.outcome is not Outcome.PASSED}


def failures_at(defect):
    with SmallServer({defect} if defect else ()) as server:
        results = run_at(server.endpoint, server.older)
    return {one.case.id: one.reason for one in results if one.outcome is Outcome.FAILED}


@pytest.fixture(scope="module")
def matrix():
    with ProcessPoolExecutor(AT_ONCE) as pool:
        return dict(zip(DEFECTS, pool.map(failures_at, DEFECTS.values()), strict=True))


def test_every_case_has_its_defect():
    assert sorted(DEFECTS) == sorted(case.id for case in REAL)
    assert len(set(DEFECTS.values())) == len(DEFECTS)


@pytest.mark.kit
def test_a_small_server_without_defect_passes():
    assert failures_at("") == {}


@pytest.mark.kit
def test_our_own_robot_passes(tmp_path):
    ends = [free_endpoint().replace("tcp/", scheme) for scheme in ("ws://", "ws-legacy://")]
    with RobotProcess(tmp_path, listen=ends, safety={"guests": True}):
        assert bad(run_at(*ends)) == {}


@pytest.mark.kit
@pytest.mark.parametrize("case_id", DEFECTS, ids=lambda name: f"{name} {DEFECTS[name]}")
def test_a_defect_fails_exactly_its_case(matrix, case_id):
    assert set(matrix[case_id]) == {case_id}, matrix[case_id]


# --- the client of bytes ---------------------------------------------------------------------------------------------


def test_masking_is_its_own_inverse_at_every_length():
    mask = b"\x01\x80\xff\x00"
    for size in (*range(9), 125, 126, 1000):
        data = bytes(number % 251 for number in range(size))
        assert xor(xor(data, mask), mask) == data
    assert xor(b"\0\0\0\0\0", mask) == b"\x01\x80\xff\x00\x01"


def test_endpoints_are_taken_apart():
    assert split_url("ws://127.0.0.1:9090") == (False, "127.0.0.1", 9090)
    assert split_url("wss://[::1]:9/") == (True, "::1", 9)
    assert split_url("ws-legacy://host:9091?dashed") == (False, "host", 9091)
    for none in ("tcp/127.0.0.1:7447", "ws://host", "http://host:80"):
        with pytest.raises(ConfigError, match="none of WebSocket"):
            split_url(none)


def test_nobody_there_is_one_clear_line():
    with pytest.raises(LinkError, match="nobody answers at ws"):
        RawWebSocket("ws://127.0.0.1:1")


def test_pings_are_answered_and_an_end_without_a_word_is_seen():
    with SmallServer() as server, RawWebSocket(server.endpoint) as raw:
        assert raw.status == 101
        raw.send(TEXT, b'{"v":1,"robot":"r1","session":"5eed5eed","wants":[]}')
        assert raw.frame(2.0).opcode == TEXT
        assert raw.end(1.5) is None
        assert raw.pings >= 1
        for client in server.clients:
            client.connection.shutdown(2)
        assert raw.end(2.0) == LOST
        raw.send(PING, b"nobody hears this")
