"""Remote detectors against real servers: an ASGI server over HTTP, and Triton itself."""

import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from sightline.vision_side.config import DetectorConfig, HsvConfig, VisionConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.contract import check_detector
from sightline.vision_side.detect.registry import build_detector
from tests.fixtures import demanded
from tests.fixtures.links import until
from tests.fixtures.ports import free_port
from tests.fixtures.vision import triton_server
from tests.fixtures.vision.remote import (
    GREY_JPEG,
    frame,
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
    """Start `examples/http_detector.py` as its first lines describe."""

    def __init__(self):
        self.port = free_port()

    def start(self):
        command = [sys.executable, "-m", "uvicorn", "--app-dir", str(ROOT / "examples"), "http_detector:app", "--port",
                   str(self.port), "--log-level", "warning"]
        self._process = subprocess.Popen(command, start_new_session=True)

    def kill(self):
        self._process.kill()
        self._process.wait()


@pytest.fixture(scope="module")
def uvicorn():
    demanded.module("uvicorn", "dev")
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


def test_killed_asgi_server_gives_no_answer_and_recovers_within_three_seconds(uvicorn):
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


# --- Triton ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def triton(tmp_path_factory):
    why = triton_server.why_impossible()
    if why:
        demanded.do_without("triton", why)
    with triton_server.TritonServer(tmp_path_factory.mktemp("triton")) as server:
        yield server


def _triton_detector(server, model):
    return _detector(f"oip+http://127.0.0.1:{server.http}/{model}", labels=("ball",))


@pytest.mark.slow
@pytest.mark.parametrize("model", ["ball_jpeg", "ball_pixels"])
def test_triton_finds_the_ball_from_jpegs_and_from_pixels(triton, model):
    with _closing(_triton_detector(triton, model)) as detector:
        assert until(lambda: detector.detect([frame()], within(1.0))[0], 10), detector.notices()
        result = detector.detect([frame(5)], within(1.0))[0]
        assert _is_the_ball(result) and result.seq == 5 and result.detector == f"oip+http:{model} 1"
        assert detector.detect([frame(jpeg=GREY_JPEG)], within(1.0))[0].detections == ()


@pytest.mark.slow
def test_unknown_model_of_triton_is_counted(triton):
    with _closing(_triton_detector(triton, "cat")) as detector:
        assert until(lambda: not detector.detect([frame()], within(1.0))[0] and detector.rejected["REJECTED"])
        assert "cat" in " ".join(detector.notices())


@pytest.mark.slow
def test_a_detector_over_triton_keeps_the_contract(triton):
    verdicts = check_detector(lambda: _triton_detector(triton, "ball_jpeg"))
    assert not [one for one in verdicts if one.wrong]


@pytest.mark.slow
def test_killed_triton_gives_no_answer_by_the_deadline_and_recovers_within_three_seconds(triton):
    with _closing(_triton_detector(triton, "ball_jpeg")) as detector:
        assert until(lambda: detector.detect([frame()], within(1.0))[0], 10)
        triton.kill()
        for seq in range(20):
            began_s = time.monotonic()
            assert detector.detect([frame(seq)], within(0.1)) == [None]
            assert time.monotonic() - began_s < 0.25
        triton.start()
        assert until(lambda: detector.detect([frame()], within(0.1))[0], 3.0), detector.notices()


def test_the_page_shows_the_configuration_that_was_run():
    page = (ROOT / "docs" / "how-to" / "remote-detectors.md").read_text()
    shown = page.partition("<!-- triton -->\n```text\n")[2].partition("```")[0]
    assert shown == (triton_server.MODELS / "ball_jpeg" / "config.pbtxt").read_text()
