"""The cases with sockets of their own, in real time: our own links and a small server pass; and the raw client."""

from pathlib import Path
from threading import Timer

import pytest

from sightline.conformance.raw_peers import LOST, PING, TEXT, RawStopPort, RawWebSocket, split_url, xor
from sightline.conformance.robot.cases import CASES
from sightline.conformance.runner import Outcome, run_cases
from sightline.protocol.errors import ConfigError, LinkError
from tests.conformance.mutants.sockets import kit_at, small_server
from tests.conformance.robot.broken.websocket import BEHIND_TOKENS
from tests.conformance.robot.small_server import SmallServer
from tests.fixtures.links import until
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess

REAL = [case for case in CASES if case.real]


def bad(results):
    return {one.case.id: one.reason for one in results if one.outcome is not Outcome.PASSED}


@pytest.mark.parametrize("guarded", [
    pytest.param(False, marks=pytest.mark.long, id="open"), pytest.param(True, id="behind tokens"),
])
def test_a_small_server_without_defect_passes(guarded):
    cases = [case for case in REAL if not guarded or case.id in BEHIND_TOKENS]
    with small_server(guarded=guarded) as (bench, prepare):
        results = run_cases(cases, bench, prepare)
    assert {one.case.id: one.reason for one in results if one.outcome is Outcome.FAILED} == {}


@pytest.mark.parametrize(("name", "outcome"), [("R-STOP-22", Outcome.PASSED), ("R-STOP-24", Outcome.SKIPPED)])
def test_stop_port_whose_secret_the_kit_lacks_is_not_a_failure(name, outcome):
    with small_server(guarded=True) as (bench, prepare):
        (Path(bench.access.folder) / "stop.secret").unlink()
        [result] = run_cases([case for case in REAL if case.id == name], bench, prepare)
    assert result.outcome is outcome, result.reason


@pytest.mark.waits
@pytest.mark.parametrize("name", ["R-STOP-23", "R-STOP-24"])
def test_stop_by_datagram_passes_while_the_kit_has_no_processor(monkeypatch, name):
    with small_server(guarded=True) as (bench, prepare):
        rest = bench.rest
        monkeypatch.setattr(bench, "rest", lambda for_us: rest(for_us + 1_000_000 * (for_us == 20_000)))
        [result] = run_cases([case for case in REAL if case.id == name], bench, prepare)
    assert result.outcome is Outcome.PASSED, result.reason


@pytest.mark.waits
def test_stop_port_passes_over_a_slow_link(monkeypatch):
    send = RawStopPort.send
    monkeypatch.setattr(RawStopPort, "send", lambda *arguments: Timer(0.16, send, arguments).start())
    with small_server(guarded=True) as (bench, prepare):
        results = run_cases([case for case in REAL if "R-STOP-22" <= case.id <= "R-STOP-26"], bench, prepare)
    assert len(results) == 5 and bad(results) == {}


@pytest.mark.long
def test_our_own_robot_passes(tmp_path):
    ends = [free_endpoint(scheme) for scheme in ("ws://", "ws-legacy://")]
    with RobotProcess(tmp_path, listen=ends, safety={"guests": True}):
        cases = [case for case in REAL if case.id not in BEHIND_TOKENS]
        with kit_at(*ends) as (bench, prepare):
            assert bad(run_cases(cases, bench, prepare)) == {}


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
        with pytest.raises(ConfigError, match="invalid WebSocket endpoint"):
            split_url(none)


def test_no_answer_is_one_clear_line():
    with pytest.raises(LinkError, match="no answer from ws"):
        RawWebSocket("ws://127.0.0.1:1")


def test_pings_are_answered_and_an_end_without_a_word_is_seen():
    with SmallServer() as server, RawWebSocket(server.endpoint) as raw:
        assert raw.status == 101
        raw.send(TEXT, b'{"v":1,"robot":"r1","session":"5eed5eed","wants":[]}')
        assert raw.frame(2.0).opcode == TEXT
        assert until(lambda: raw.end(0.5) is None and raw.pings)
        for client in server.clients:
            client.connection.shutdown(2)
        assert raw.end(2.0) == LOST
        raw.send(PING, b"nobody hears this")
