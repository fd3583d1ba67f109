"""The cases with sockets of their own, in real time: our own links, a small server, and that server with one defect."""

from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from sightline.conformance.benches import FROM_ROBOT, LiveBench
from sightline.conformance.case import Access
from sightline.conformance.raw_peers import LOST, PING, TEXT, RawWebSocket, split_url, xor
from sightline.conformance.robot.cases import CASES, prepare
from sightline.conformance.runner import Outcome, run_cases
from sightline.protocol.errors import ConfigError, LinkError
from sightline.protocol.transports.open import open_link
from tests.conformance.robot.broken.websocket import BEHIND_TOKENS, DEFECTS
from tests.conformance.robot.small_server import SmallServer
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess

REAL = [case for case in CASES if case.real]
TOKENS = {"vision": "vision-0123456789abcdef", "operator": "operator-0123456789abcdef"}
DEFECTS_BEHIND_TOKENS = {DEFECTS[name]: True for name in BEHIND_TOKENS}
MOST_S = 900.0
"""One defect at all cases takes two minutes, and waits for those before it."""
AT_ONCE = 8
"""Servers at a time: they wait far more than they compute."""


def run_at(endpoint, older="", folder="", cases=REAL):
    """The results of `cases`; with a `folder` of keys the kit comes in with those."""
    tokens = {role: (Path(folder) / f"{role}.token").read_text().strip() for role in TOKENS} if folder else {}

    def open_it(role):
        return open_link("r1", connect=[endpoint], role=role, timeout_s=20, secure=folder)

    roles = tuple(TOKENS) if folder else ("vision",)
    options = {"roles": roles, "endpoint": endpoint, "legacy": older, "access": Access(tokens, folder)}
    with LiveBench("r1", open_it, FROM_ROBOT, **options) as bench:
        return run_cases(cases, bench, prepare)


def bad(results):
    return {one.case.id: one.reason for one in results if one.outcome is not Outcome.PASSED}


def failures_at(defect, cases=REAL, guarded=None):
    """The cases that fail at a small server with `defect`: all, or those that a defect behind tokens can concern."""
    guarded = DEFECTS_BEHIND_TOKENS.get(defect) if guarded is None else guarded
    with TemporaryDirectory() as folder, SmallServer({defect} if defect else (), TOKENS if guarded else None) as server:
        for role, token in TOKENS.items():
            (Path(folder) / f"{role}.token").write_text(token)
        results = run_at(server.endpoint, server.older, folder if guarded else "", cases)
    return {one.case.id: one.reason for one in results if one.outcome is Outcome.FAILED}


@pytest.fixture(scope="module")
def matrix():
    """Case -> what its defect will make fail, so that each is reported when it is done."""
    pool = ProcessPoolExecutor(AT_ONCE)
    yield {name: pool.submit(failures_at, defect) for name, defect in DEFECTS.items()}
    pool.shutdown(cancel_futures=True)


def test_every_case_has_its_defect():
    assert sorted(DEFECTS) == sorted(case.id for case in REAL)
    assert len(set(DEFECTS.values())) == len(DEFECTS)


@pytest.mark.long
@pytest.mark.parametrize("guarded", [False, True], ids=["open", "behind tokens"])
def test_a_small_server_without_defect_passes(guarded):
    assert failures_at("", guarded=guarded) == {}


@pytest.mark.parametrize("case_id", BEHIND_TOKENS)
def test_a_defect_behind_tokens_is_found(case_id):
    cases = [case for case in REAL if case.id == case_id]
    assert set(failures_at(DEFECTS[case_id], cases)) == {case_id}
    assert failures_at("", cases, guarded=True) == {}


@pytest.mark.long
def test_our_own_robot_passes(tmp_path):
    ends = [free_endpoint(scheme) for scheme in ("ws://", "ws-legacy://")]
    with RobotProcess(tmp_path, listen=ends, safety={"guests": True}):
        assert bad(run_at(*ends, cases=[case for case in REAL if case.id not in BEHIND_TOKENS])) == {}


@pytest.mark.long
@pytest.mark.parametrize("case_id", DEFECTS, ids=lambda name: f"{name} {DEFECTS[name]}")
def test_a_defect_fails_exactly_its_case(matrix, case_id):
    failed = matrix[case_id].result(timeout=MOST_S)
    assert set(failed) == {case_id}, failed


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
        assert raw.end(1.5) is None
        assert raw.pings >= 1
        for client in server.clients:
            client.connection.shutdown(2)
        assert raw.end(2.0) == LOST
        raw.send(PING, b"nobody hears this")
