"""The kit's cases with sockets of their own: ours passes, and a plain client passes."""

import json
import socket
import threading
import time
from contextlib import contextmanager, nullcontext

import pytest

from sightline.conformance.raw_peers import RawFrame, take_frame
from sightline.conformance.runner import Outcome, run_case
from sightline.conformance.vision.cases import CASES
from sightline.conformance.vision.websocket import RawServer
from sightline.operator_side.cli import app as cli
from sightline.protocol.text import format_twist
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving import service
from sightline.vision_side.serving.process import serve
from tests.conformance.mutants.sockets import our_vision, plain_vision, played_robot
from tests.conformance.vision.sockets import SocketVision
from tests.fixtures.ports import free_endpoint

REAL = [case for case in CASES if case.real]


@contextmanager
def started_before(endpoint):
    """The service in a thread that waits for the kit to listen."""
    ending = threading.Event()

    def run():
        with open_link("r1", connect=[endpoint], role="vision", timeout_s=20) as link:
            serve(VisionConfig(), link, ending, lambda line: None)

    running = threading.Thread(target=run, daemon=True)
    running.start()
    yield
    ending.set()
    running.join(2)


@pytest.mark.waits
@pytest.mark.parametrize("vision", [our_vision, plain_vision], ids=["ours", "plain"])
def test_a_good_vision_passes_them_all(vision):
    with played_robot(vision) as (bench, _prepare):
        results = [run_case(case, bench) for case in REAL]
    assert {one.case.id: one.reason for one in results if one.outcome is not Outcome.PASSED} == {}


@pytest.mark.parametrize(("name", "message"), [
    ("V-HEAD-02", (700).to_bytes(2) + b"{" + b" " * 698 + b"}0.0000|0.0000"), ("V-SOCK-06", "0.0000|0.0000")])
def test_answer_with_a_long_block_or_as_a_text_fails(monkeypatch, name, message):
    monkeypatch.setattr(SocketVision, "answer", lambda self, link, frame: link.send(message))
    case = next(case for case in CASES if case.id == name)
    with played_robot(plain_vision) as (bench, _prepare):
        assert bench.wait(lambda: bench._links["robot"].connected, 5_000_000)
        result = run_case(case, bench)
    assert result.outcome is Outcome.FAILED, result.reason


@pytest.mark.parametrize("kit_waits_s", [0.0, 0.1, 0.25])
def test_pause_before_a_try_is_right_while_the_kit_has_no_processor(kit_waits_s):
    endpoint, pauses_s = free_endpoint("ws://"), []
    host, port = endpoint.removeprefix("ws://").split(":")
    with RawServer(host, int(port)) as server:
        tries = threading.Thread(target=lambda: [pauses_s.append(server.turn_away(1.0)) or time.sleep(kit_waits_s)
                                                 for _ in range(3)])
        tries.start()
        for _ in range(3):
            with socket.create_connection((host, int(port))) as client:
                client.sendall(b"GET / HTTP/1.1\r\n\r\n")
                assert client.recv(100).startswith(b"HTTP/1.1 503")
            time.sleep(0.2)
        tries.join()
    assert min(pauses_s[1:]) >= 0.2


def test_vision_service_that_swaps_the_axes_exits_with_5(capsys, monkeypatch):
    monkeypatch.setattr(service, "format_twist", lambda twist: b"|".join(reversed(format_twist(twist).split(b"|"))))
    endpoint, names = free_endpoint("ws://"), ("V-STEER-01", "V-STEER-09")
    only = [part for name in names for part in ("--only", name)]
    with started_before(endpoint):
        code = cli.run(("conform", "vision", endpoint, *only, "--json"))
    report = json.loads(capsys.readouterr().out)
    assert (code, report["ok"]) == (5, False)
    assert {(one["name"], one["level"], one["value"]) for one in report["checks"]} == {
        (name, "MUST", "failed") for name in names}  # fmt: skip


def test_over_zenoh_they_are_not_applicable():
    with played_robot(lambda endpoint: nullcontext()) as (bench, _prepare):
        bench.endpoint = "tcp/127.0.0.1:7447"
        outcomes = {run_case(case, bench).outcome for case in REAL}
    assert outcomes == {Outcome.SKIPPED}


@pytest.mark.parametrize("size", [0, 5, 125, 126, 300, 65_535, 65_536])
def test_the_raw_codec_reads_frames_of_any_length_at_any_cut(size):
    payload = bytes(number * 7 % 256 for number in range(size))
    mask = bytes((1, 2, 3, 4))
    masked = bytes(one ^ mask[place % 4] for place, one in enumerate(payload))
    length = bytes((0x80 | size,)) if size < 126 else (
        b"\xfe" + size.to_bytes(2) if size < 65_536 else b"\xff" + size.to_bytes(8))
    whole = b"\x82" + length + mask + masked
    for cut in {0, 1, 2, 3, 5, 9, 13, len(whole) // 2, len(whole) - 1} & set(range(len(whole))):
        assert take_frame(whole[:cut]) is None
    assert take_frame(whole + b"next") == (RawFrame(True, 2, payload), b"next")
