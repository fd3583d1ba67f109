"""`sightline bench detector`, `bench streams` and `bench pipeline`: their checks on invented runs."""

import json
import time
from collections import Counter
from dataclasses import replace
from itertools import chain, count, groupby, repeat
from types import SimpleNamespace

import pytest

from sightline.benchmarks import detector as detector_bench
from sightline.benchmarks import pipeline
from sightline.benchmarks.detector import (
    OVERLOAD,
    Cost,
    Load,
    SlowDetector,
    StreamPlan,
    _Streams,
    measure_cost,
    stream_checks,
)
from sightline.protocol.channels import DETECTIONS
from sightline.protocol.clock import monotonic_us
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import DetectionsHeader, Echo
from sightline.protocol.transports.link import Message
from sightline.vision_side.detect.port import Maker, result_of
from tests.fixtures.commands import run

ROBOTS = [f"s{index}" for index in range(40)]
SECONDS = 60
BEGIN_US = 5_000_000
ANSWERED_HZ = 30 / OVERLOAD


def load(answered_s=SECONDS):
    """A run whose services answer each robot evenly, for so long; an answer takes 50 ms."""
    one = Load(offered=30 * SECONDS * len(ROBOTS), memory_mb=[0.0] * SECONDS, seconds=SECONDS)
    one.begin(ROBOTS, BEGIN_US)
    one.memory_mb += [80.0] * SECONDS
    for number in range(round(answered_s * ANSWERED_HZ)):
        at_us = BEGIN_US + round(number * 1e6 / ANSWERED_HZ)
        for robot in ROBOTS:
            one.answer(robot, at_us - 50_000, at_us)
    one.end(BEGIN_US + SECONDS * 1_000_000)
    return one


def failed(one):
    return {check.name for check in stream_checks(one, StreamPlan()) if not check.ok}


def test_services_that_answer_to_the_end_pass():
    assert not failed(load())


def test_services_that_stop_to_answer_in_the_middle_fail():
    assert failed(load(SECONDS / 2)) == {"offered per answered frame", "longest time without an answer"}


@pytest.mark.parametrize("streams", [2, 40, 80])
def test_rate_with_a_time_for_a_batch_is_bounded_by_what_the_robots_send(streams):
    plan = StreamPlan(streams=streams, batch_us=5_000)
    for each_fps, is_enough in ((22.6, True), (22.4, False)):
        answered = Load(answered=Counter({"s1": round(each_fps * streams * SECONDS)}), seconds=SECONDS)
        rate = next(check for check in stream_checks(answered, plan) if check.name == "answered per second")
        assert rate.ok is is_enough


@pytest.mark.parametrize("batch_ms", [5, 100])
def test_age_with_a_time_for_a_batch_is_bounded_by_60_ms_beside_two_batches(batch_ms):
    for age_ms, is_young in ((60 + 2 * batch_ms, True), (61 + 2 * batch_ms, False)):
        checks = stream_checks(Load(ages_ms=[age_ms], seconds=1.0), StreamPlan(batch_us=batch_ms * 1000))
        assert next(check for check in checks if check.name == "age of boxes, p95").ok is is_young


class RobotLink:
    """A link that only counts on its subscriber."""

    def __init__(self, robot):
        self.robot = robot

    def subscribe(self, channel, heard):
        self.heard = heard if channel is DETECTIONS else None

    def publish(self, *_):
        pass

    def receive(self, seq, t_us):
        echo = Echo(channel="frame", session="0000abcd", seq=seq, t_us=t_us)
        header = DetectionsHeader(source="guest", session="0000abcd", seq=seq, echo=echo)
        self.heard(Message(DETECTIONS, "guest", encode(header), b""))


def test_answers_count_only_for_frames_of_their_robot_and_by_its_own_clock():
    links = [RobotLink("s0"), RobotLink("s1")]
    robots = _Streams(links, b"")
    robots.load.begin(["s0", "s1"], monotonic_us())
    robots.counting = True
    robots.frame(0)
    links[1].receive(1, monotonic_us())
    links[0].receive(2, monotonic_us())
    assert not robots.load.answered, "another robot's frame, and one that was never sent"
    links[0].receive(1, monotonic_us() + 10_000_000)
    assert robots.load.answered == {"s0": 1} and 0 <= robots.load.ages_ms[0] < 10_000


def test_killing_the_only_service_is_rejected():
    with pytest.raises(ConfigError, match="add --services 2"):
        StreamPlan(kill=True)
    assert StreamPlan(kill=True, services=2).services == 2


@pytest.mark.parametrize("later", ["tracking", "searching"])
def test_pipeline_that_loses_the_ball_after_it_was_warm_shows_that(monkeypatch, later):
    phases = chain(repeat("tracking", pipeline._WARM_UP), repeat(later))
    step = SimpleNamespace(step=lambda _frame: SimpleNamespace(seen=SimpleNamespace(phase=next(phases))))
    monkeypatch.setattr(pipeline, "Pipeline", lambda *_: step)
    monkeypatch.setattr(pipeline, "_pictures", lambda *_: [pipeline._encode(pipeline._drawn(320, 240, 1, 1), 80)])
    assert pipeline._time_size((320, 240), frames=12, paced_frames=1).phase == later


def crash(_frames):
    raise ArithmeticError("no model")


@pytest.mark.parametrize(("detect", "unanswered", "why"), [
    (lambda frames: [result_of(one, (), Maker("x", device="cpu")) for one in frames], 0, ""),
    (lambda _: [None], 4, "no answer in time"), (lambda _: [], 4, "0 results for 1 frames"),
    (lambda _: ["ball"], 4, "AttributeError"), (crash, 4, "ArithmeticError: no model"),
    (lambda frames: [replace(result_of(frames[0], (), Maker("x", device="cpu")), seq=0)], 4, "answers another frame"),
])  # fmt: skip
def test_answer_that_the_vision_service_would_not_use_is_not_an_answer(detect, unanswered, why):
    there = SimpleNamespace(detect=lambda frames, _deadline_us: detect(frames))
    here = SlowDetector(SlowDetector.Config(each_us=0))
    jpeg = pipeline._encode(pipeline._drawn(320, 240, 1, 1), 80)
    cost = measure_cost(here, there, jpeg, (320, 240), frames=4)
    assert cost.unanswered == unanswered and why in cost.why and bool(why) is bool(cost.why)
    assert (cost.added_us is None) is (cost.there_us is None) is bool(why)


@pytest.mark.parametrize("each", [2, 3, 5])
def test_time_of_a_frame_without_an_answer_is_not_counted(each):
    calls = count()

    def detect(frames, _deadline_us):
        if next(calls) % each:
            return [None]
        time.sleep(0.004)
        return [result_of(frames[0], (), Maker("x", device="cpu"))]

    jpeg = pipeline._encode(pipeline._drawn(320, 240, 1, 1), 80)
    cost = measure_cost(SlowDetector(SlowDetector.Config(each_us=0)), SimpleNamespace(detect=detect), jpeg, (320, 240),
                        frames=15)
    assert cost.there_us >= 4000 and cost.added_us > 0 and 0 < cost.unanswered < 15


def test_robot_of_a_bench_stays_present(monkeypatch):
    """Before, a service ended its subscription in the middle of the run, and a third of the frames had no answer."""
    now_s, published = count(step=0.25), []
    clock = SimpleNamespace(monotonic=lambda: next(now_s), sleep=lambda _seconds: None,
                            perf_counter_ns=time.perf_counter_ns)
    monkeypatch.setattr(detector_bench, "time", clock)
    here = SlowDetector(SlowDetector.Config(each_us=0))
    robot = SimpleNamespace(publish=lambda channel, *_: published.append(channel.name))
    measure_cost(here, here, b"", (320, 240), frames=60, robot=robot)
    longest = max(len(list(run)) for name, run in groupby(published) if name == "frame")
    assert published[0] == "status" and longest <= 4


@pytest.mark.parametrize(("answer", "value"), [("", None), ("x", 0.0)])
def test_detector_that_gives_no_answer_has_no_time_that_is_ok(monkeypatch, capsys, answer, value):
    cost = Cost(700.0, 700.0 if answer else None, 0 if answer else 300, answer)
    monkeypatch.setattr(detector_bench, "measure_cost", lambda *_given, **_more: cost)
    code, out, _ = run(capsys, "bench", "detector", "hsv", "--frames", "300", "--json")
    checks = {one["name"].split(",")[0]: one for one in json.loads(out)["checks"]}
    assert code == (0 if answer else 5)
    assert (checks["hsv: added"]["value"], checks["hsv: added"]["ok"]) == (value, bool(answer))
