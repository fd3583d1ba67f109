"""The kit's cases with sockets of their own: ours passes, a plain client passes, each broken one fails its own case."""

import json
import threading
from contextlib import contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

from sightline.conformance.benches import TO_ROBOT, LiveBench
from sightline.conformance.case import Access
from sightline.conformance.raw_peers import RawFrame, take_frame
from sightline.conformance.runner import Outcome, run_case
from sightline.conformance.vision.cases import CASES
from sightline.operator_side.cli import app as cli
from sightline.protocol.text import format_twist
from sightline.protocol.transports.open import open_link
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.serving import service
from sightline.vision_side.serving.process import serve
from tests.conformance.vision.sockets import SOCKETS, SocketVision
from tests.fixtures.ports import free_endpoint

REAL = [case for case in CASES if case.real]
TOKEN = "0123456789abcdefABCDEF_-"


@contextmanager
def bench_with(vision, endpoint=None):
    """A kit that listens, and `vision(endpoint)`, a context that connects; the kit checks a token but requires none."""
    endpoint = endpoint or free_endpoint("ws://")

    def open_it(role):
        return open_link("r1", listen=[endpoint], role=role)

    options = {"roles": ("robot",), "endpoint": endpoint, "access": Access({"vision": TOKEN})}
    with LiveBench("r1", open_it, TO_ROBOT, **options) as bench, vision(endpoint):
        yield bench


@contextmanager
def our_vision(endpoint):
    """The service as the command runs it, in a thread."""
    ending = threading.Event()
    with folder_of(TOKEN) as folder, open_link("r1", connect=[endpoint], role="vision", secure=folder) as link:
        running = threading.Thread(target=serve, args=(VisionConfig(), link, ending, lambda line: None), daemon=True)
        running.start()
        yield
        ending.set()
        running.join(2)


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


@contextmanager
def folder_of(token):
    with TemporaryDirectory() as folder:
        (Path(folder) / "vision.token").write_text(token)
        yield folder


def plain_vision(endpoint, broken=""):
    return SocketVision(endpoint, broken, TOKEN)


@pytest.mark.parametrize("vision", [our_vision, plain_vision], ids=["ours", "plain"])
def test_a_good_vision_passes_them_all(vision):
    with bench_with(vision) as bench:
        results = [run_case(case, bench) for case in REAL]
    assert {one.case.id: one.reason for one in results if one.outcome is not Outcome.PASSED} == {}


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


def failed_of(broken, cases):
    """Run each case on its own bench, because a vision service that gives up fails all later cases."""
    found = set()
    for case in cases:
        with bench_with(lambda endpoint: plain_vision(endpoint, broken)) as bench:
            if run_case(case, bench).outcome is Outcome.FAILED:
                found.add(case.id)
    return found


def test_every_case_has_its_broken_vision():
    assert set(SOCKETS) == {case.id for case in REAL}


@pytest.mark.parametrize("name", sorted(SOCKETS))
def test_a_broken_vision_fails_its_case(name):
    assert failed_of(name, [case for case in REAL if case.id == name]) == {name}


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(SOCKETS))
def test_a_broken_vision_fails_no_other_case(name):
    assert failed_of(name, REAL) == {name}


def test_over_zenoh_they_are_not_applicable():
    with bench_with(lambda endpoint: nullcontext()) as bench:
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
