"""Remote detectors against real servers: an ASGI server over HTTP, a gRPC server that misbehaves, and Triton itself."""

import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from sightline.vision_side.config import DetectorConfig, HsvConfig, VisionConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.contract import check_detector
from sightline.vision_side.detect.registry import build_detector
from sightline.vision_side.detect.remote.fallback import Fallback
from tests.fixtures import demanded
from tests.fixtures.links import free_endpoint, until
from tests.fixtures.vision import triton_server
from tests.fixtures.vision.remote import (
    BALL_JPEG,
    COLUMNS,
    GREY_JPEG,
    frame,
    grpc_answer,
    grpc_started,
    within,
)

ROOT = Path(__file__).parent.parent.parent.parent.parent
HSV = Hsv(Hsv.Config(hsv=HsvConfig()))
BALL = HSV.detect([frame()], 0)[0].detections[0]


def _detector(kind, **options):
    return build_detector(kind, options, VisionConfig(detector=DetectorConfig(kind=kind)))


@contextmanager
def _closing(detector):
    try:
        yield detector
    finally:
        detector.close()


def _is_the_ball(result):
    one = result.detections[0]
    off = (one.x1_px - BALL.x1_px, one.y1_px - BALL.y1_px, one.x2_px - BALL.x2_px, one.y2_px - BALL.y2_px)
    return one.label == "ball" and max(map(abs, off)) <= 2


# --- ASGI ------------------------------------------------------------------------------------------------------------


class Uvicorn:
    """`examples/http_detector.py`, as its first lines say how it is run."""

    def __init__(self):
        self.port = int(free_endpoint().rpartition(":")[2])

    def start(self):
        command = [sys.executable, "-m", "uvicorn", "--app-dir", str(ROOT / "examples"), "http_detector:app", "--port",
                   str(self.port), "--log-level", "warning"]
        self._process = subprocess.Popen(command, start_new_session=True)

    def kill(self):
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def uvicorn():
    pytest.importorskip("uvicorn")
    server = Uvicorn()
    server.start()
    yield server
    server.kill()


def test_a_real_asgi_server_answers(uvicorn):
    with _closing(_detector(f"http+jpeg://127.0.0.1:{uvicorn.port}/detect")) as detector:
        assert until(lambda: detector.detect([frame()], within(1.0))[0], 15)
        assert _is_the_ball(detector.detect([frame()], within(1.0))[0])
        assert detector.detect([frame(jpeg=GREY_JPEG)], within(1.0))[0].detections == ()
        assert detector.detect([frame()], within(1.0))[0].detector == "yellow"


def test_a_killed_asgi_server_is_no_answer_and_back_within_three_seconds_of_its_return(uvicorn):
    with _closing(_detector(f"http+jpeg://127.0.0.1:{uvicorn.port}/detect")) as detector:
        assert until(lambda: detector.detect([frame()], within(1.0))[0], 15)
        uvicorn.kill()
        for seq in range(20):
            began_s = time.monotonic()
            assert detector.detect([frame(seq)], within(0.1)) == [None] and time.monotonic() - began_s < 0.2
        uvicorn.start()
        assert until(lambda: _listens(uvicorn.port), 15)
        assert until(lambda: detector.detect([frame()], within(0.1))[0], 3.0)


def _listens(port):
    import socket

    try:
        socket.create_connection(("127.0.0.1", port), 0.2).close()
    except OSError:
        return False
    return True


# --- gRPC ------------------------------------------------------------------------------------------------------------


@contextmanager
def _grpc_server(infer, metadata=None):
    server, port = grpc_started(infer, metadata=metadata)
    try:
        with _closing(_detector(f"oip+grpc://127.0.0.1:{port}/ball", labels=("box", "ball"))) as detector:
            yield detector
    finally:
        server.stop(0)


def test_a_grpc_server_is_asked_and_understood():
    asked = []

    def infer(request, context):
        asked.append(request)
        return grpc_answer(COLUMNS)

    with _grpc_server(infer) as detector:
        result = detector.detect([frame()], within(2))[0]
    assert BALL_JPEG in asked[0] and result.detections[0].label == "ball" and result.detector == "oip+grpc:ball"


def _bomb():
    import grpc

    def infer(request, context):
        return grpc_answer(COLUMNS) + bytes(16 << 20)

    infer.compression = grpc.Compression.Gzip
    return infer


def _abort(request, context):
    import grpc

    context.abort(grpc.StatusCode.NOT_FOUND, "no such model")


@pytest.mark.parametrize(("infer", "reason"), [
    (lambda request, context: b"\xff", "MALFORMED"), (lambda request, context: b"", "MALFORMED"),
    (lambda request, context: grpc_answer(COLUMNS, "0000abcd-77"), "OTHER_FRAME"),
    (lambda request, context: bytes(2 << 20), "TOO_LARGE"), ("bomb", "TOO_LARGE"), (_abort, "REFUSED"),
    (lambda request, context: time.sleep(1.0) or grpc_answer(COLUMNS), "LATE"),
])  # fmt: skip
def test_a_hostile_grpc_answer_is_refused_and_counted(infer, reason):
    pytest.importorskip("grpc")
    with _grpc_server(_bomb() if infer == "bomb" else infer) as detector:
        began_s = time.monotonic()
        assert detector.detect([frame()], within(0.8)) == [None] and time.monotonic() - began_s < 0.95
        assert until(lambda: dict(detector.refused) == {reason: 1}), detector.refused


def test_own_eyes_drive_on_while_a_grpc_server_is_gone_and_it_drives_again_within_three_seconds_of_its_return():
    server, port = grpc_started(lambda request, context: grpc_answer(COLUMNS))
    with _closing(Fallback(_detector(f"oip+grpc://127.0.0.1:{port}/ball", labels=("box", "ball")), HSV)) as both:
        assert until(lambda: both.detect([frame()], within(1.0))[0].detector == "oip+grpc:ball")
        server.stop(0).wait()
        for _ in range(20):
            began_s = time.monotonic()
            (result,) = both.detect([frame()], within(0.1))
            assert result.detector == "hsv" and time.monotonic() - began_s < 0.2
        server, _ = grpc_started(lambda request, context: grpc_answer(COLUMNS), port)
        assert until(lambda: both.detect([frame()], within(0.1))[0].detector == "oip+grpc:ball", 3.0), both.news()
    server.stop(0)


def test_grpc_without_its_package_is_said_with_the_command(monkeypatch):
    from sightline.protocol.errors import ConfigError

    monkeypatch.setitem(sys.modules, "grpc", None)
    with pytest.raises(ConfigError, match=r"pip install 'sightline-robot\[grpc\]'"):
        _detector("oip+grpc://127.0.0.1/ball")


# --- Triton ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def triton(tmp_path_factory):
    why = triton_server.why_impossible()
    if why:
        demanded.do_without("triton", why)
    with triton_server.TritonServer(tmp_path_factory.mktemp("triton")) as server:
        yield server


def test_triton_may_be_missing_but_not_where_it_is_demanded(monkeypatch):
    monkeypatch.delenv(demanded.NAME, raising=False)
    with pytest.raises(pytest.skip.Exception, match="no wheel"):
        demanded.do_without("triton", "no wheel")
    monkeypatch.setenv(demanded.NAME, "cuda,triton")
    with pytest.raises(pytest.fail.Exception, match="'triton', and it cannot be had: no wheel") as failed:
        demanded.do_without("triton", "no wheel")
    assert "\n" not in str(failed.value)
    assert f"export {demanded.NAME}=triton " in (ROOT / ".ci" / "run").read_text()


KINDS = ("oip+http", "oip+grpc")


def _triton_detector(server, scheme, model):
    if scheme == "oip+grpc":
        pytest.importorskip("grpc")
    port = server.http if scheme == "oip+http" else server.grpc
    return _detector(f"{scheme}://127.0.0.1:{port}/{model}", labels=("ball",))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["ball_jpeg", "ball_pixels"])
@pytest.mark.parametrize("scheme", KINDS)
def test_triton_finds_the_ball_from_jpegs_and_from_pixels(triton, scheme, model):
    with _closing(_triton_detector(triton, scheme, model)) as detector:
        assert until(lambda: detector.detect([frame()], within(1.0))[0], 10), detector.news()
        result = detector.detect([frame(5)], within(1.0))[0]
        assert _is_the_ball(result) and result.seq == 5 and result.detector == f"{scheme}:{model} 1"
        assert detector.detect([frame(jpeg=GREY_JPEG)], within(1.0))[0].detections == ()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", KINDS)
def test_triton_says_no_to_a_model_it_has_not_and_that_is_counted(triton, scheme):
    with _closing(_triton_detector(triton, scheme, "cat")) as detector:
        assert until(lambda: not detector.detect([frame()], within(1.0))[0] and detector.refused["REFUSED"])
        assert "cat" in " ".join(detector.news())


@pytest.mark.slow
@pytest.mark.parametrize("scheme", KINDS)
def test_a_detector_over_triton_keeps_the_contract(triton, scheme):
    verdicts = check_detector(lambda: _triton_detector(triton, scheme, "ball_jpeg"))
    assert not [one for one in verdicts if one.wrong]


@pytest.mark.slow
def test_a_killed_triton_is_no_answer_by_the_deadline_and_back_within_three_seconds_of_its_return(triton):
    """Both protocols at one server: it is killed once for both."""
    with ExitStack() as ending:
        detectors = [ending.enter_context(_closing(_triton_detector(triton, one, "ball_jpeg"))) for one in KINDS]
        assert all(until(lambda one=one: one.detect([frame()], within(1.0))[0], 10) for one in detectors)
        triton.kill()
        for seq in range(20):
            began_s = time.monotonic()
            assert detectors[seq % 2].detect([frame(seq)], within(0.1)) == [None]
            assert time.monotonic() - began_s < 0.25
        triton.start()
        back_s = time.monotonic()
        for one in detectors:
            left_s = 3.0 - (time.monotonic() - back_s)
            assert until(lambda one=one: one.detect([frame()], within(0.1))[0], left_s), one.news()


def test_the_page_shows_the_configuration_that_was_run():
    page = (ROOT / "docs" / "detectors.md").read_text()
    shown = page.partition("<!-- triton -->\n```\n")[2].partition("```")[0]
    assert shown == (triton_server.MODELS / "ball_jpeg" / "config.pbtxt").read_text()
