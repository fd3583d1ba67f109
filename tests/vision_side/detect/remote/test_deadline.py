"""Newest only, by the deadline, and what drives while the remote does not answer."""

import math
import threading
import time

import pytest

from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError
from sightline.vision_side.config import HsvConfig
from sightline.vision_side.detect.color.detectors import Hsv
from sightline.vision_side.detect.per_robot import MAX_DECODERS, DecoderPool
from sightline.vision_side.detect.port import Detection, Maker, result_of
from sightline.vision_side.detect.remote.deadline import FAILED, DeadlineDetector
from sightline.vision_side.detect.remote.fallback import GOOD_ANSWERS, RESERVE_US, Fallback
from tests.fixtures.links import until
from tests.fixtures.vision.remote import GREY_JPEG, frame, within


class Held:
    """Answers on release, and records its requests."""

    def __init__(self, name="remote"):
        self.name, self.asked, self.deadlines = name, [], []
        self.free = threading.Event()
        self.free.set()
        self.good, self.raises, self.closed = True, False, False

    def detect(self, frames, deadline_us):
        self.asked.append([one.header.seq for one in frames])
        self.deadlines.append(deadline_us)
        self.free.wait(10)
        if self.raises:
            raise RuntimeError("a plug-in's fault")
        found = (Detection(1, 2, 3, 4, 0.9, "ball"),)
        return [result_of(one, found, Maker(self.name)) if self.good else None for one in frames]

    def close(self):
        self.closed = True


@pytest.fixture
def held():
    one = Held()
    yield one
    one.free.set()


@pytest.fixture
def by_deadline(held):
    one = DeadlineDetector(held)
    yield one
    held.free.set()
    one.close()


# --- by deadline -----------------------------------------------------------------------------------------------------


def test_an_answer_in_time_is_given_in_the_frames_order(by_deadline, held):
    results = by_deadline.detect([frame(1), frame(2, robot="r2")], within(2))
    assert [(one.robot, one.seq) for one in results] == [("r1", 1), ("r2", 2)] and held.asked == [[1, 2]]


def test_hanging_detector_delays_no_longer_than_the_deadline(by_deadline, held):
    held.free.clear()
    times_s = []
    for seq in (1, 2, 3):
        began_s = time.monotonic()
        assert by_deadline.detect([frame(seq)], within(0.05)) == [None]
        times_s.append(time.monotonic() - began_s)
    assert min(times_s) < 0.15, "the least, since a busy machine delays some"
    assert by_deadline.detect([frame(4), frame(5)], within(-1)) == [None, None]


def test_frame_past_its_deadline_is_skipped(by_deadline, held):
    by_deadline.request([frame(1)], within(-1))
    time.sleep(0.05)
    assert by_deadline.detect([frame(2)], within(2))[0].seq == 2 and held.asked == [[2]]


def test_only_the_newest_frame_waits_and_a_late_answer_is_dropped(by_deadline, held):
    held.free.clear()
    first = by_deadline.request([frame(1)], within(10))
    assert until(lambda: held.asked == [[1]])
    for seq in range(2, 6):
        by_deadline.detect([frame(seq)], within(0.02))
    first.deadline_us = 0
    held.free.set()
    assert by_deadline.detect([frame(6)], within(2))[0].seq == 6
    assert held.asked == [[1], [6]], "2 to 5 waited in one place, and their time is over"
    assert by_deadline.overtaken >= 3 and first.take(wait=False) is None


def test_detector_error_counts_as_no_answer_and_the_next_frame_is_answered(by_deadline, held):
    held.raises = True
    assert by_deadline.detect([frame(1)], within(2)) == [None]
    held.raises = False
    assert by_deadline.detect([frame(2)], within(2))[0].seq == 2
    assert by_deadline.rejected == {FAILED: 1}
    (line,) = by_deadline.notices()
    assert "RuntimeError: a plug-in's fault" in line


def test_invalid_reply_counts_as_no_answer_and_the_first_is_logged():
    class Strange:
        def detect(self, frames, deadline_us):
            beyond = (Detection(1, 2, math.nan, 4, 0.9, "ball"),)
            return [result_of(one, beyond, Maker("strange")) for one in frames]

    own = Held("own")
    fallback = Fallback(Strange(), own)
    assert [_who(fallback, seq) for seq in range(1, 20)] == [["own"]] * 19, "and none of it is a good answer"
    assert [line for line in fallback.notices() if "nan or infinite" in line], "the reason is reported"
    assert fallback.notices() == []
    fallback.close()


def test_pixels_of_an_abandoned_frame_do_not_reach_the_next():
    """The caller decodes its next frame while the detector still looks at the last frame."""
    looking, go_on, seen = threading.Event(), threading.Event(), []

    class Slow:
        def detect(self, frames, deadline_us):
            picture = frames[0].picture().bgr
            before = picture.copy()
            looking.set()
            go_on.wait(5)
            seen.append((before == picture).all())
            return [None]

    one = DeadlineDetector(Slow())
    first = frame(1)
    assert one.detect([first], within(0.5)) == [None] and looking.is_set()
    grey = type(first)("r1", frame(2).header, GREY_JPEG, first._decoder)
    assert grey.picture().bgr.std() < 2
    go_on.set()
    one.close()
    assert seen == [True]


def test_detector_on_its_own_thread_receives_what_the_mission_expects(by_deadline, held, monkeypatch):
    received = []
    monkeypatch.setattr(held, "detect", lambda frames, _deadline_us: received.extend(frames) or [None])
    asked = frame(1)
    asked.goes_by, asked.expected_px, asked.looks_once = "legs".__eq__, (12.0, 34.0), True
    by_deadline.detect([asked], within(2))
    (one,) = received
    assert (one.goes_by, one.expected_px, one.looks_once) == (asked.goes_by, asked.expected_px, True)


def test_many_robots_need_a_bounded_number_of_decoders():
    decoders = DecoderPool(10**7)
    for number in range(2 * MAX_DECODERS):
        assert decoders.again(frame(1, robot=f"r{number}")).picture().bgr.shape == (240, 320, 3)
    assert len(decoders._decoders) == MAX_DECODERS


def test_failed_close_is_reported_by_the_caller(held, monkeypatch):
    monkeypatch.setattr(type(held), "close", lambda _self: 1 / 0)
    with pytest.raises(ConfigError, match=r"close\(\) raises ZeroDivisionError"):
        DeadlineDetector(held).close()


def test_close_ends_the_thread_and_the_inner_detector(held):
    before = set(threading.enumerate())
    one = DeadlineDetector(held)
    one.detect([frame(1)], within(2))
    one.close()
    assert held.closed
    assert until(lambda: all(some.name != "detector" for some in set(threading.enumerate()) - before))


# --- fallback --------------------------------------------------------------------------------------------------------


class Asked:
    """The requests of `FakeRemote`."""

    def __init__(self, results, over, begun=True):
        self._results, self.over, self.begun = results, over, begun

    def take(self, wait):
        results, self._results = self._results, None
        return results


class FakeRemote(Held, DeadlineDetector):
    """Requested without waiting; `state` is good, none (no answer that counts), late, overtaken, or under way."""

    state = "good"

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.besides = []
        self.detected_us = 0

    def detect(self, frames, deadline_us):
        self.detected_us = monotonic_us()
        self.good = self.state == "good"
        return super().detect(frames, deadline_us)

    def notices(self):
        return []

    def request(self, frames, deadline_us):
        self.besides.append(deadline_us)
        results = self.detect(frames, deadline_us) if self.state in ("good", "none") else None
        return Asked(results, self.state in ("late", "overtaken"), self.state != "overtaken")


def _who(fallback, seq, count=1, robot="r1"):
    results = fallback.detect([frame(seq + one, robot=robot) for one in range(count)], within(2))
    return [one and one.detector for one in results]


def test_late_remote_answer_is_replaced_by_the_local_detector_in_the_same_frame():
    remote, own = FakeRemote(), Held("own")
    fallback = Fallback(remote, own)
    assert _who(fallback, 1) == ["remote"] and own.asked == []
    remote.state = "none"
    deadline_us = within(2)
    assert fallback.detect([frame(2)], deadline_us)[0].detector == "own"
    assert remote.deadlines[-1] == deadline_us - RESERVE_US and own.deadlines == [deadline_us]
    (line,) = fallback.notices()
    assert "the fallback drives on" in line


def test_shadow_of_a_remote_detector_has_the_same_deadline():
    """Or one that takes most of the deadline would be good beside, late when it drives, and change each second."""
    remote = FakeRemote()
    fallback = Fallback(remote, Held("own"))
    remote.state = "none"
    _who(fallback, 1)
    deadline_us = within(2)
    fallback.detect([frame(2)], deadline_us)
    assert remote.besides == [deadline_us - RESERVE_US]


def test_remote_detector_gets_half_of_a_short_deadline():
    remote = FakeRemote()
    began_us, deadline_us = monotonic_us(), within(0.01)
    Fallback(remote, Held("own")).detect([frame()], deadline_us)
    halves_us = [(deadline_us - at_us) // 2 for at_us in (remote.detected_us, began_us)]
    assert halves_us[0] <= deadline_us - remote.deadlines[0] <= halves_us[1] + 1


def test_remote_detector_steers_again_after_ten_good_answers():
    remote, own = FakeRemote(), Held("own")
    fallback = Fallback(remote, own)
    remote.state = "none"
    _who(fallback, 1)
    for states in (["good"] * (GOOD_ANSWERS - 1) + ["none"], ["late"] * 3, ["good"] * 4 + ["late"]):
        for seq, state in enumerate(states):
            remote.state = state
            assert _who(fallback, 10 + seq) == ["own"]
    remote.state = "good"
    assert [_who(fallback, 50 + seq)[0] for seq in range(GOOD_ANSWERS + 1)] == ["own"] * GOOD_ANSWERS + ["remote"]
    assert "drives again" in fallback.notices()[-1]


def test_late_answer_serves_later_frames_only():
    remote, own = FakeRemote(), Held("own")
    fallback = Fallback(remote, own)
    remote.state = "none"
    _who(fallback, 1)
    remote.state = "under way"
    before = len(remote.asked)
    assert all(_who(fallback, seq) == ["own"] for seq in range(2, 30)) and len(remote.asked) == before


def test_local_detector_examines_only_frames_without_a_remote_answer():
    class Half(FakeRemote):
        def detect(self, frames, deadline_us):
            results = super().detect(frames, deadline_us)
            return [one if one.seq % 2 else None for one in results]

    own = Held("own")
    assert _who(Fallback(Half(), own), 1, 4) == ["remote", "own", "remote", "own"] and own.asked == [[2, 4]]


def test_detector_that_blocks_runs_on_its_own_thread(held):
    fallbacks, times_s = [Fallback(held, Hsv(Hsv.Config(hsv=HsvConfig()))) for _ in range(3)], []
    held.free.clear()
    for fallback in fallbacks:
        began_s = time.monotonic()
        result = fallback.detect([frame(1)], within(0.1))[0]
        times_s.append(time.monotonic() - began_s)
        assert result.detector == "hsv" and result.detections
    assert min(times_s) < 0.2, "the least, since a busy machine delays some"
    held.free.set()
    assert until(lambda: fallbacks[0].detect([frame(2)], within(0.5))[0].detector == "remote")
    for fallback in fallbacks:
        fallback.close()
    assert held.closed
