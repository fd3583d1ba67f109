"""The reports about a remote without answers, and the repeated query for the model of a server."""

import json
import time
from dataclasses import asdict

import numpy as np
import pytest

from sightline.vision_side.detect.remote.client import (
    ErrorCounters,
    NoAnswerError,
    NoAnswerReason,
    ServerDetector,
    parse_address,
)
from sightline.vision_side.detect.remote.oip import Inferred, OipSettings, detections_of
from sightline.vision_side.detect.remote.oip_http import HttpServer
from tests.fixtures.vision.remote import COLUMNS, JPEG_INPUT, OUTPUTS, Server, frame, http_reply, within


def _refuse(tally, count):
    for _ in range(count):
        tally.reject(NoAnswerError(NoAnswerReason.LATE, "nothing by the deadline"))


def _tally_after(answered, refused, good):
    tally = ErrorCounters("far")
    for _ in range(answered):
        tally.good()
    _refuse(tally, refused)
    for _ in range(good):
        tally.good()
    return tally


@pytest.mark.parametrize("between", [NoAnswerReason.REJECTED, None])
def test_rejection_is_logged_at_the_1st_10th_100th_of_its_kind(between):
    tally, told = ErrorCounters("far"), []
    for count in range(1, 1001):
        tally.reject(NoAnswerError(NoAnswerReason.LATE, "nothing by the deadline"))
        if between and count < 10:
            tally.reject(NoAnswerError(between, "status 503"))
        told += [(count, line) for line in tally.notices.take() if "LATE" in line]
    assert [count for count, _ in told] == [1, 10, 100, 1000]
    assert "LATE: nothing by the deadline (1000 so far)" in told[-1][1]


@pytest.mark.parametrize(("good", "bad"), [(10, 1), (3, 10), (500, 1)])
def test_repeated_failure_is_reported_again(good, bad):
    tally = _tally_after(1, 12, good)
    tally.notices.take()
    _refuse(tally, bad - 1)
    assert not [line for line in tally.notices.take() if "LATE" in line]
    _refuse(tally, 1)
    assert "no answer: LATE" in tally.notices.take()[0]


def test_one_robot_of_two_that_is_not_answered_is_not_two_lines_for_each_frame():
    tally, told = ErrorCounters("far"), []
    for _ in range(1000):
        _refuse(tally, 1)
        tally.good()
        told += tally.notices.take()
    assert [line for line in told if "1000 so far" in line] and len(told) == 8


def test_server_that_is_late_now_and_then_is_few_lines_in_an_hour_and_a_later_failure_is_reported():
    tally, told = ErrorCounters("far"), []
    for frame_number in range(1, 100_000):
        _refuse(tally, frame_number % 12 == 0)
        tally.good()
        told += tally.notices.take()
    assert len(told) <= 2 * 8
    for _ in range(1800):
        tally.good()
    _refuse(tally, 1)
    assert "no answer: LATE" in tally.notices.take()[0]


class ModelServer(Server):
    """A server of one model, which it may change; with `closes`, it ends every connection after one answer."""

    def __init__(self, closes):
        self.headers = ["Connection: close"] if closes else []
        self.slots, self.told, self.status, self.takes_s = OUTPUTS, 0, "200 OK", 0.0
        super().__init__(self._answer)

    def _answer(self, request):
        head, body = request
        time.sleep(self.takes_s)
        if head.startswith("GET"):
            self.told += 1
            said = {"name": "ball", "versions": ["1"], "platform": "x", "inputs": [asdict(JPEG_INPUT)],
                    "outputs": [asdict(one) for one in self.slots]}
        else:
            asked, _ = json.JSONDecoder().raw_decode(body.decode("latin-1"))
            said = {"id": asked["id"], "outputs": [_column(one["name"]) for one in asked["outputs"]]}
        return http_reply(json.dumps(said).encode(), self.status, self.headers)


def _column(name):
    column = COLUMNS[name]
    kind = {one.name: one.datatype for one in OUTPUTS}[name]
    return {"name": name, "datatype": kind, "shape": column.shape, "data": column.reshape(-1).tolist()}


@pytest.mark.parametrize("closes", [False, True])
def test_a_model_is_requested_once_and_again_after_an_error(closes):
    with ModelServer(closes) as server:
        address = f"oip+http://127.0.0.1:{server.port}/ball"
        settings = OipSettings(address=address, labels=("ball", "box"))
        detector = ServerDetector(address, HttpServer(parse_address(address), settings))

        def label(seq):
            result = detector.detect([frame(seq)], within(2))[0]
            return result and result.detections[0].label

        assert [label(seq) for seq in range(1, 6)] == ["box"] * 5 and server.told == 1
        server.status = "500 Internal Server Error"
        assert label(6) is None
        server.status, server.slots = "200 OK", OUTPUTS[:2]
        assert [label(7), label(8)] == ["ball"] * 2 and server.told == 2, "the model became another"
        port = server.port
        server.kill()
        server.start(port)
        server.slots = OUTPUTS
        assert label(9) in ("ball", "box") and (closes or label(10) == "box"), "another server, unnoticed if it closes"
        detector.close()


def test_late_server_is_not_delayed_by_another_model_query():
    """Each request takes 0.6 of 1 s. That is enough for a known model, but not with a metadata request."""
    with ModelServer(closes=False) as server:
        settings = OipSettings(address=f"oip+http://127.0.0.1:{server.port}/ball", labels=("b",))
        detector = ServerDetector("oip", HttpServer(parse_address(settings.address), settings))
        assert detector.detect([frame(1)], within(2)) != [None]
        server.takes_s = 0.2
        assert detector.detect([frame(2)], within(0.1)) == [None]
        server.takes_s = 0.6
        time.sleep(0.2)
        seen = [detector.detect([frame(seq)], within(1.0))[0] for seq in range(3, 6)]
        assert sum(one is not None for one in seen) >= 2 and server.told == 1
        detector.close()


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.float16, np.int64])
def test_numbers_of_labels_may_be_written_as_floats(kind):
    outputs = {"boxes": np.float32([[10, 20, 30, 40], [50, 60, 70, 80]]), "scores": np.float32([0.9, 0.8]),
               "labels": np.array([1, 7], kind)}
    found = detections_of(Inferred(outputs), OipSettings(address="", labels=("ball", "box")), (1.0, 1.0), (320, 240))
    assert [one.label for one in found] == ["box", "7"]


@pytest.mark.parametrize("bad", [0.5, float("nan"), float("inf"), -1e300])
def test_label_that_is_not_a_whole_number_is_ignored(bad):
    outputs = {"boxes": np.float32([[10, 20, 30, 40]]), "scores": np.float32([0.9]), "labels": np.float64([bad])}
    with pytest.raises(NoAnswerError) as error:
        detections_of(Inferred(outputs), OipSettings(address="", labels=("ball",)), (1.0, 1.0), (320, 240))
    assert error.value.reason is NoAnswerReason.MALFORMED
