"""The fallback while a remote does not answer one robot of several: nothing changes for the others."""

import time
from itertools import pairwise

import pytest

from sightline.protocol.channels import DETECTIONS
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import DetectedBox, Detections, DetectionsHeader, Echo
from sightline.protocol.transports.link import Message
from sightline.protocol.transports.zenoh.link import MAX_ROBOTS as MOST_AT_A_SITE
from sightline.vision_side.detect.per_robot import MAX_ROBOTS, PerSession
from sightline.vision_side.detect.port import Maker, result_of
from sightline.vision_side.detect.remote import fallback as fallback_module
from sightline.vision_side.detect.remote.fallback import GOOD_ANSWERS, Fallback
from sightline.vision_side.detect.remote.zenoh_detector import ROLE, ZenohDetector
from tests.fixtures.vision.remote import frame, within
from tests.vision_side.detect.remote.test_deadline import FakeRemote, Held, _who


class Partly(FakeRemote):
    """Answers all robots but those that it does not know."""

    def __init__(self, *unknown):
        super().__init__()
        self.unknown = set(unknown)

    def detect(self, frames, deadline_us):
        return [None if one.robot in self.unknown else result_of(one, (), Maker("remote")) for one in frames]


def test_a_robot_that_is_not_answered_changes_nothing_for_another():
    remote = Partly("r2")
    fallback = Fallback(remote, Held("own"))
    for seq in range(1, 30):
        assert (_who(fallback, seq), _who(fallback, seq, robot="r2")) == (["remote"], ["own"])
    (line,) = fallback.notices()
    assert "for r2: the fallback drives on" in line
    remote.unknown.clear()
    drove = [_who(fallback, seq, robot="r2")[0] for seq in range(30, 42)]
    assert drove == ["own"] * GOOD_ANSWERS + ["remote"] * 2, "one beside was under way and not good"


def test_remote_that_is_late_now_and_then_is_few_lines_and_the_last_one_is_right(monkeypatch):
    """It was two lines each time, for ever."""
    remote, now_us, lines = FakeRemote(), 1_000_000, []
    monkeypatch.setattr(fallback_module, "monotonic_us", lambda: now_us)
    fallback = Fallback(remote, Held("own"))

    def steered(frames, late_each):
        nonlocal now_us
        for seq in frames:
            now_us += 33_333
            remote.state = "none" if seq % late_each == 0 else "good"
            (detector,) = _who(fallback, seq)
            lines.extend((now_us, line) for line in fallback.notices())
        return detector

    steered(range(1, 1800), late_each=12)  # a minute
    returns_us = [at_us for at_us, line in lines if "it drives again" in line]
    late = sum("the fallback drives on" in line for _, line in lines)
    assert len(returns_us) <= 7 and 0 <= late - len(returns_us) <= 1
    assert all(after - before > 1_000_000 * 2**number for number, (before, after) in enumerate(pairwise(returns_us)))
    assert steered(range(1801, 4000), late_each=5000) == "remote" and "it drives again" in lines[-1][1]
    assert steered([5000, 5001], late_each=5000) == "own" and "the fallback drives on" in lines[-1][1]


def test_each_robot_of_a_batch_gets_its_result():
    remote = Partly("r2", "r4")
    fallback = Fallback(remote, Held("own"))
    robots = ["r1", "r2", "r3", "r4"]
    for seq in range(1, 5):
        results = fallback.detect([frame(seq, robot=robot) for robot in robots], within(2))
        assert [one.detector for one in results] == ["remote", "own", "remote", "own"]
        assert [one.robot for one in results] == robots
    remote.unknown = {"r4"}
    for seq in range(5, 17):
        results = fallback.detect([frame(seq, robot=robot) for robot in robots], within(2))
    assert [one.detector for one in results] == ["remote", "remote", "remote", "own"]


def test_unexamined_frame_does_not_count_as_a_bad_answer():
    remote = FakeRemote()
    fallback = Fallback(remote, Held("own"))
    remote.state = "none"
    _who(fallback, 1)
    for seq in range(2, 1 + 2 * GOOD_ANSWERS):
        remote.state = "overtaken" if seq % 2 else "good"
        assert _who(fallback, seq) == ["own"]
    assert _who(fallback, 90) == ["remote"]


def test_many_robots_need_bounded_memory():
    remote = FakeRemote()
    remote.state = "none"
    fallback = Fallback(remote, Held("own"))
    for number in range(3 * MAX_ROBOTS):
        _who(fallback, 1, robot=f"r{number}")
        _who(fallback, 2, robot=f"r{number}")
    assert len(fallback._good) <= MAX_ROBOTS and len(fallback._beside) <= 1
    assert len(fallback._logged) <= MAX_ROBOTS


def test_session_state_is_stored_for_each_robot():
    kept = PerSession(list)
    robots = [f"r{number}" for number in range(MOST_AT_A_SITE)]
    memories = [kept.of(robot, "0000abcd") for robot in robots]
    assert all(kept.of(robot, "0000abcd") is memory for robot, memory in zip(robots, memories, strict=True))


def test_both_detectors_are_closed_if_one_close_fails():
    class Failing(Held):
        def close(self):
            raise OSError("the port is gone")

    second = Held("own")
    with pytest.raises(ConfigError, match=r"close\(\) raises OSError"):
        Fallback(Failing("first"), second).close()
    assert second.closed


class Heard:
    """A link that delivers boxes immediately."""

    def __init__(self, robot):
        self.robot = robot

    def subscribe(self, channel, callback):
        self.put = callback

    def say(self, asked):
        echo = Echo(channel="frame", session=asked.header.session, seq=asked.header.seq, t_us=asked.header.t_us)
        box = DetectedBox(label="ball", score=0.9, x1_px=10.0, y1_px=10.0, x2_px=30.0, y2_px=30.0)
        header = DetectionsHeader(source=ROLE, session="00000009", seq=1, echo=echo)
        said = Detections(width_px=320, height_px=240, boxes=(box,), detector="far")
        self.put(Message(DETECTIONS, ROLE, encode(header), encode(said)))


def test_returning_boxes_are_used_again():
    link, far = Heard("r1"), ZenohDetector(ZenohDetector.Config())
    fallback = Fallback(far, Held("own"))
    fallback.attach(link)
    assert fallback.detect([frame(1)], within(0.03))[0].detector == "own"
    drove = []
    for seq in range(2, 100):
        asked = frame(seq)
        link.say(asked)
        drove.append(fallback.detect([asked], within(0.5))[0].detector)
        if drove[-1] == "far":
            break
        time.sleep(0.01)
    assert drove[-1] == "far" and drove.count("own") >= GOOD_ANSWERS
    fallback.close()
