"""`sightline detector --metrics`: load, ages and outcomes of a detector service, and the probes of a supervisor."""

import urllib.error
import urllib.request

import pytest

from sightline.operator_side.cockpit.detector_metrics import served
from sightline.protocol.errors import ConfigError
from sightline.vision_side.detect.port import Detection
from tests.fixtures.ports import free_port
from tests.vision_side.serving.test_detector_service import Bench, Named

GOOD = Detection(10.0, 10.0, 50.0, 50.0, 0.9, "ball")


def get(port, path):
    """Return status and text."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=5) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_load_ages_and_outcomes_are_served(monkeypatch):
    port, bench = free_port(), Bench(Named(GOOD))
    for jpeg in (b"", *[None] * 3):
        bench.look() if jpeg is None else bench.look(jpeg)
    bench.service._check_load(1e9)
    with served(str(port)) as observe:
        assert get(port, "ready")[0] == 503 and get(port, "live")[0] == 200, "it starts"
        assert "detector" not in get(port, "metrics")[1]
        observe(bench.service)
        assert get(port, "ready")[0] == 503 and get(port, "live")[0] == 200, "its detector is not warm"
        bench.service.warm_up()
        assert get(port, "ready")[0] == get(port, "live")[0] == 200
        text = get(port, "metrics")[1]
        values = dict(line.rsplit(" ", 1) for line in text.splitlines() if line.startswith("sightline_detector"))
        assert float(values["sightline_detector_robots"]) == float(values["sightline_detector_services"]) == 1
        assert float(values["sightline_detector_frames_answered_total"]) == 3
        assert float(values['sightline_detector_frames_dropped_total{reason="rejected"}']) == 1
        assert 0 < float(values["sightline_detector_busy_ratio"]) <= 1
        queue_s = float(values["sightline_detector_queue_age_seconds"])
        assert 0 < queue_s < float(values["sightline_detector_answer_age_seconds"]) < 1
        monkeypatch.setattr("sightline.vision_side.serving.detector_service.LIVE_S", -1.0)
        assert get(port, "ready")[0] == get(port, "live")[0] == 503, "its loop or its detector hangs"


@pytest.mark.parametrize("where", ["", "x", "0", "70000", "host:", "a:b:1"])
def test_invalid_address_is_an_error(where):
    with pytest.raises(ConfigError, match="expected PORT or HOST:PORT"), served(where):
        pass
