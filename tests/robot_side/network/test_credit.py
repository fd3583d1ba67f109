"""The stream's credit, step by step: when a frame may leave, whose answer counts, what an answer measures, timeouts."""

from typing import ClassVar

import pytest
from pydantic import ValidationError

from sightline.protocol.messages import Holder
from sightline.robot_side.network import stream as module
from sightline.robot_side.network.bitrate_control import EncodingTarget
from sightline.robot_side.network.congestion_window import AckSample, LinkCapacity
from sightline.robot_side.network.stream import LossRecord, Stream, StreamConfig

VISION, VIEWER = Holder(source="vision", session="0000bbbb"), Holder(source="viewer", session="0000cccc")
FIRST_TIMEOUT_US = 120_000
DUE_US = 29_999
"""From the capture of a frame to the next one at 30 fps: nine tenths of 33,333 us."""


class FarLink:
    """A stream, a camera and an owner behind a link of constant delay, in steps of 1 ms."""

    def __init__(self):
        self.stream = Stream(StreamConfig())
        self.now_us = self.seq = 0
        self.flying = []

    def run(self, who, seconds, delay_us):
        until_us = self.now_us + round(seconds * 1e6)
        while self.now_us < until_us:
            self.now_us += 1_000
            while self.flying and self.flying[0][0] <= self.now_us:
                self.stream.on_answer(who, self.flying.pop(0)[1], 0, self.now_us)
            if self.stream.may_capture(self.now_us, listening=True):
                self.stream.on_sent(self.seq, self.now_us, self.now_us, 10_000)
                self.flying.append((self.now_us + delay_us, self.seq))
                self.seq += 1
        return self


def test_released_credit_returns_at_once_and_counts_as_no_timeout():
    stream = Stream(StreamConfig(max_fps=30))
    stream.on_sent(1, 0, 0)
    assert not stream.may_capture(50_000, True)
    stream.release()
    assert stream.may_capture(50_000, True) and stream.credit_timeouts == 0
    assert stream.wait_us(50_000) == 0


@pytest.mark.parametrize("silent", [False, True])
def test_new_owner_of_the_credit_begins_with_one_frame_in_flight(silent):
    """The width that a far owner needs would be a queue at its successor: after a hand-over, and after silence."""
    link = FarLink().run(VISION, 3.0, 100_000)
    assert link.stream.window == 4
    if silent:
        assert link.stream.on_answer(VIEWER, link.seq, 0, link.now_us + 1_000_000)
    else:
        link.stream.on_holder(VIEWER, link.now_us)
    assert link.stream.window == 1


# --- with a window and a control of the encoding that only note ---------------------------------------------------


class NotedWindow:
    """Stands for the congestion window: `frames` in flight, and what reached it."""

    made: ClassVar = []

    def __init__(self, interval_us, most):
        self.given = (interval_us, most)
        self.frames, self.full = 1, None
        self.floor_us, self.jitters_us = -1, []
        self.answers, self.timeouts = [], []
        NotedWindow.made.append(self)

    def on_answer(self, answered, now_us):
        self.answers.append((answered, now_us))
        return self.full

    def on_timeout(self, now_us):
        self.timeouts.append(now_us)

    def is_floor(self, delay_us, jitter_us):
        self.jitters_us.append(jitter_us)
        return delay_us <= self.floor_us


class NotedBitrate:
    """Stands for the control of the encoding."""

    def __init__(self):
        self.target = EncodingTarget(80, 50)
        self.calls = []

    def __getattr__(self, name):
        return lambda *arguments: self.calls.append((name, *arguments))


@pytest.fixture(autouse=True)
def noted(request, monkeypatch):
    if "silent" not in request.fixturenames:
        NotedWindow.made = []
        monkeypatch.setattr(module, "CongestionWindow", NotedWindow)
        monkeypatch.setattr(module, "BitrateControl", NotedBitrate)


def stream_of(frames=1, **config):
    made = Stream(StreamConfig(**config))
    made._congestion_window.frames = frames
    return made


def answered_once(answer_us, *, frames=1, **config):
    """Return a stream whose first frame, sent at 0, was answered after that time."""
    made = stream_of(frames, **config)
    made.on_sent(0, 0, 0)
    assert made.on_answer(VISION, 0, 0, answer_us)
    return made


def credit(stream, now_us):
    """Return True if the stream has credit at a time when a frame is due."""
    return stream.may_capture(now_us, listening=True)


@pytest.mark.parametrize(("field", "valid", "invalid"), [
    ("max_fps", (1e-9, 240), (0, 240.1)), ("max_window", (1, 32), (0, 33)),
    ("max_credit_timeout_ms", (20, 5_000), (19, 5_001)), ("owner_life_ms", (100, 10_000), (99, 10_001)),
])  # fmt: skip
def test_bounds_of_the_configuration(field, valid, invalid):
    for value in valid:
        assert getattr(StreamConfig(**{field: value}), field) == value
    for value in invalid:
        with pytest.raises(ValidationError):
            StreamConfig(**{field: value})


def test_defaults_of_the_configuration():
    expected = {
        "max_fps": 30.0, "max_window": 12, "max_credit_timeout_ms": 500, "owner_life_ms": 1_000, "adapt": True
    }
    assert StreamConfig().model_dump() == expected


@pytest.mark.parametrize(("max_fps", "interval_us"), [(30.0, 33_333), (10.0, 100_000), (240.0, 4_167)])
def test_window_has_the_interval_of_the_camera_and_the_most_frames(max_fps, interval_us):
    stream_of(max_fps=max_fps, max_window=5)
    assert NotedWindow.made[0].given == (interval_us, 5)


def test_target_of_the_encoding_is_the_full_image_without_adaptation():
    assert stream_of().encoding_target == (80, 50)
    assert stream_of(adapt=False).encoding_target == (100, 100)


# --- when a frame may leave --------------------------------------------------------------------------------------


def test_first_frame_may_leave_at_the_start_of_the_clock():
    assert credit(stream_of(), 0) is True
    assert stream_of().wait_us(0) == 0
    assert stream_of().may_capture(0, listening=False) is False


def test_next_frame_is_due_nine_tenths_of_an_interval_after_the_capture():
    stream = stream_of(frames=3)
    stream.on_sent(0, 5_000, 20_000)
    assert stream.wait_us(21_000) == stream.early_us(21_000) == 5_000 + DUE_US - 21_000
    assert credit(stream, 5_000 + DUE_US - 1) is False
    assert credit(stream, 5_000 + DUE_US) is True
    assert stream.wait_us(5_000 + DUE_US) == stream.wait_us(50_000) == stream.early_us(50_000) == 0


def test_as_many_frames_are_in_flight_as_the_window_allows():
    stream = stream_of(frames=3)
    for seq in range(3):
        assert credit(stream, 40_000 * seq)
        stream.on_sent(seq, 40_000 * seq, 40_000 * seq)
    assert not credit(stream, 119_999)
    assert stream.wait_us(115_000) == 5_000, "the credit of the first returns after 120 ms"
    assert credit(stream, 120_000), "it has timed out"
    assert stream.credit_timeouts == 1
    assert stream.window == 3


def test_wait_is_the_longer_one_of_the_interval_and_the_credit():
    stream = stream_of()
    stream.on_sent(0, 200_000, 100_000)
    assert stream.wait_us(100_000) == 100_000 + DUE_US, "the interval"
    stream = stream_of()
    stream.on_sent(0, 100_000, 100_000)
    assert stream.wait_us(100_000) == FIRST_TIMEOUT_US, "the credit"
    assert stream.wait_us(300_000) == 0


def test_counters_and_the_rate_of_the_last_second():
    stream = stream_of(frames=32)
    for seq in range(300):
        stream.on_sent(seq, seq * 1_000, seq * 1_000)
    assert stream.sent == 300 and stream.overtaken == 0
    assert stream.fps(299_000) == 256, "it remembers so many"
    assert stream.fps(1_289_000) == 11 and stream.fps(1_289_001) == 10


# --- who may answer ----------------------------------------------------------------------------------------------


def test_first_peer_that_answers_owns_the_credit():
    stream = stream_of()
    stream.on_sent(0, 0, 0)
    assert stream.on_answer(VIEWER, 0, 0, 0) is True
    stream.on_sent(1, 40_000, 40_000)
    assert stream.on_answer(VISION, 1, 0, 50_000) is False
    assert stream.on_answer(VIEWER, 1, 0, 60_000) is True


@pytest.mark.parametrize(("silence_us", "taken"), [(999_999, False), (1_000_000, True)])
def test_owner_that_is_silent_for_its_life_loses_the_credit(silence_us, taken):
    stream = stream_of()
    stream.on_sent(0, 0, 0)
    stream.on_answer(VISION, 0, 0, 10_000)
    stream.on_answer(VISION, 0, 0, 20_000)  # once more: no credit, but a sign of life
    stream.on_sent(1, 30_000, 30_000)
    assert stream.on_answer(VIEWER, 1, 0, 20_000 + silence_us) is taken


@pytest.mark.parametrize(("silence_us", "taken"), [(699_999, False), (700_000, True)])
def test_life_of_a_new_holder_begins_with_its_lease(silence_us, taken):
    stream = stream_of(owner_life_ms=700)
    stream.on_holder(VISION, 10_000)
    stream.on_sent(1, 30_000, 30_000)
    assert stream.on_answer(VIEWER, 1, 0, 10_000 + silence_us) is taken


def test_holder_takes_the_credit_in_flight_and_no_holder_takes_none():
    stream = stream_of()
    stream.on_holder(VIEWER, 0)
    stream.on_sent(0, 0, 0)
    for holder in (None, VIEWER):
        stream.on_holder(holder, 10_000)
        assert not credit(stream, 50_000)
    stream.on_holder(VISION, 20_000)
    assert credit(stream, 50_000)
    assert stream.on_answer(VIEWER, 0, 0, 60_000) is False
    assert [window.given for window in NotedWindow.made] == [(33_333, 12)] * 3, "a new one for each owner"


def test_new_owner_begins_with_the_first_timeout():
    """The times of a quick owner would make a slow successor overdue."""
    stream = answered_once(5_000)
    stream.on_sent(1, 40_000, 40_000)
    assert stream.wait_us(40_000) == DUE_US, "19.5 ms"
    stream.on_holder(VIEWER, 50_000)
    stream.on_sent(2, 80_000, 80_000)
    assert stream.wait_us(80_000) == FIRST_TIMEOUT_US


def test_new_owner_uses_its_window_though_answers_of_the_former_were_overdue():
    stream = answered_once(40_000)
    sent_and_overdue(stream, 100_000)
    stream.on_holder(VIEWER, 200_000)
    NotedWindow.made[-1].frames = 2
    stream.on_sent(200, 200_000, 200_000)
    assert credit(stream, 240_000)


def test_first_answer_of_a_new_owner_forgets_when_the_former_was_overdue():
    """However late it is. A frame from before is then the first overdue one of the new owner."""
    stream = answered_once(400_000, frames=3, owner_life_ms=100, max_credit_timeout_ms=5_000)
    stream.on_sent(1, 410_000, 410_000)
    stream.on_sent(2, 600_000, 600_000)
    assert credit(stream, 410_000 + 612_000), "the first is overdue"
    assert stream.on_answer(VIEWER, 1, 0, 1_100_000) is False, "taken over, without credit"
    assert credit(stream, 600_000 + 612_000), "the second is overdue"
    late_us = sent_and_overdue(stream, 1_300_000)
    assert NotedWindow.made[-1].timeouts == [late_us], "the second in a row"


# --- what an answer measures -------------------------------------------------------------------------------------


def sample(**changes):
    usual = {
        "delay_us": 40_000, "behind": False, "followed": False, "held_back": False, "gap_us": 40_000, "gap_frames": 1,
        "gap_bytes": 0, "compute_us": 0,
    }
    return AckSample(**{**usual, **changes})


def answers(stream):
    """Return the samples that reached the window, with their times."""
    return NotedWindow.made[-1].answers


def test_frame_alone_has_its_whole_time_on_the_link_without_the_computing():
    stream = stream_of(frames=2)
    stream.on_holder(VISION, 0)
    stream.on_sent(0, 500, 1_000, 9_000)
    stream.on_answer(VISION, 0, 15_000, 41_000)
    assert answers(stream) == [(sample(delay_us=25_000, gap_bytes=9_000, compute_us=15_000), 41_000)]


def test_computing_that_is_longer_than_the_answer_took_leaves_no_delay():
    stream = stream_of()
    stream.on_holder(VISION, 0)
    stream.on_sent(0, 0, 0)
    stream.on_answer(VISION, 0, 40_001, 40_000)
    assert answers(stream)[0][0].delay_us == 0


def test_gap_begins_with_the_answer_before_it_or_with_the_frame():
    stream = stream_of(frames=3)
    stream.on_holder(VISION, 0)
    for seq, (sent_us, size_bytes) in enumerate([(0, 1_000), (10_000, 2_000), (100_000, 4_000)]):
        stream.on_sent(seq, sent_us, sent_us, size_bytes)
    stream.on_answer(VISION, 0, 0, 30_000)
    stream.on_answer(VISION, 1, 0, 50_000)
    stream.on_answer(VISION, 2, 0, 140_000)
    gaps = [(one.gap_us, one.gap_frames, one.gap_bytes) for one, _ in answers(stream)]
    assert gaps == [(30_000, 1, 1_000), (20_000, 1, 2_000), (40_000, 1, 4_000)]


def test_answer_counts_for_the_frames_that_the_answered_one_overtook():
    stream = stream_of(frames=4)
    stream.on_holder(VISION, 0)
    for seq in range(4):
        stream.on_sent(seq, seq * 10_000, seq * 10_000, 1_000 * (seq + 1))
    assert stream.on_answer(VISION, 2, 0, 60_000) is True
    assert answers(stream) == [
        (sample(behind=True, followed=True, gap_us=60_000, gap_frames=3, gap_bytes=6_000), 60_000)
    ]
    assert stream.overtaken == 2
    assert stream.on_answer(VISION, 1, 0, 61_000) is False, "answered already"
    assert len(answers(stream)) == 1
    assert stream.on_answer(VISION, 3, 0, 62_000) is True
    assert stream.overtaken == 2


def test_answer_to_a_frame_that_was_not_sent_measures_nothing_and_returns_the_older_credit():
    stream = stream_of(frames=2)
    stream.on_holder(VISION, 0)
    stream.on_sent(0, 0, 0)
    stream.on_sent(2, 40_000, 40_000)
    assert stream.on_answer(VISION, 1, 0, 50_000) is True
    assert answers(stream) == []
    assert stream.on_answer(VISION, 1, 0, 50_000) is False


@pytest.mark.parametrize(("apart_us", "together"), [(1_000_000, True), (1_000_001, False)])
def test_frame_waits_behind_one_without_an_answer_for_a_second(apart_us, together):
    """After that the older one was lost, and the link is free."""
    stream, start_us = stream_of(frames=9), 7_000_000
    stream.on_holder(VISION, start_us)
    stream.on_sent(0, start_us, start_us)
    stream.on_sent(1, start_us + apart_us, start_us + apart_us)
    stream.on_answer(VISION, 0, 0, start_us + apart_us + 1_000)
    stream.on_answer(VISION, 1, 0, start_us + apart_us + 2_000)
    assert [(one.behind, one.followed) for one, _ in answers(stream)] == [(False, together), (together, False)]


def test_frames_without_an_answer_are_remembered_up_to_64():
    stream = stream_of(frames=99)
    stream.on_holder(VISION, 0)
    for seq in range(70):
        stream.on_sent(seq, 0, 0)
    stream.on_answer(VISION, 69, 0, 10_000)
    assert stream.overtaken == 63


def test_frame_that_waited_for_credit_is_noted_once():
    stream = stream_of(frames=1)
    stream.on_holder(VISION, 0)
    stream.on_sent(0, 0, 0)
    assert not stream.may_capture(DUE_US - 1, listening=True), "not due: it does not wait"
    assert not stream.may_capture(DUE_US, listening=False), "no peer: neither"
    stream.on_answer(VISION, 0, 0, 40_000)
    for now_us in (100_000, 200_000):
        stream.on_sent(now_us, now_us, now_us)
        if now_us == 100_000:
            assert not credit(stream, 140_000), "due, and no credit"
        stream.on_answer(VISION, now_us, 0, now_us + 50_000)
        assert credit(stream, now_us + 60_000)
    stream.on_sent(300_000, 300_000, 300_000)
    stream.on_answer(VISION, 300_000, 0, 310_000)
    assert [one.held_back for one, _ in answers(stream)] == [False, False, True, False]


def test_control_of_the_encoding_gets_each_size_and_each_delay_or_the_capacity():
    stream = stream_of(frames=2)
    stream.on_holder(VISION, 0)
    stream.on_sent(0, 0, 500, 9_000)
    stream.on_answer(VISION, 0, 10_000, 40_500)
    full = NotedWindow.made[-1].full = LinkCapacity(1e5, 70_000)
    stream.on_sent(1, 50_000, 50_000)
    stream.on_answer(VISION, 1, 0, 90_000)
    assert stream._bitrate_control.calls == [
        ("on_sent", 9_000, 500), ("on_delay", 30_000, 40_500), ("on_sent", 0, 50_000), ("on_full", full, 90_000)
    ]  # fmt: skip


@pytest.mark.parametrize(("compute_us", "now_us"), [(-30_000, 40_000), (0, -5_000), (-30_000, -5_000)])
def test_negative_times_count_as_zero(compute_us, now_us):
    """A peer that claims them, or a clock that jumped back, would widen the window."""
    stream = stream_of()
    stream.on_holder(VISION, 0)
    stream.on_sent(0, 0, 0)
    stream.on_answer(VISION, 0, compute_us, now_us)
    assert (answers(stream)[0][0].delay_us, answers(stream)[0][0].compute_us) == (max(0, now_us), 0)
    assert timeout_us(stream, 1_000_000) == 12_000 + max(0, now_us) * 3 // 2


# --- loss or queue -----------------------------------------------------------------------------------------------

LOSSY_TIMEOUT_US = 52_000
"""Of a link with losses whose answers take 40 ms: 12 ms more. Without losses it is 72 ms."""


def lossy_link(*runs, frames=3, answer_us=40_000, floor_us=1_000_000, **config):
    """Return a stream whose link lost as many frames in a row as each of `runs`, and the time of its last answer.

    All answers take `answer_us`, at most `floor_us` of which is the link's own delay.
    """
    stream = stream_of(frames, max_fps=100, **config)
    stream.on_holder(VISION, 0)
    now_us = seq = 0
    NotedWindow.made[-1].floor_us, NotedWindow.made[-1].frames = floor_us, frames
    for lost in (0, *(one for run in runs for one in (run, 0))):
        for _ in range(lost + 1):
            seq, now_us = seq + 1, now_us + 20_000
            stream.on_sent(seq, now_us, now_us)
        now_us += answer_us
        stream.on_answer(VISION, seq, 0, now_us)
    return stream, now_us


def timeout_of(stream, now_us):
    """Return the timeout of a frame that is sent now, whatever else is in flight."""
    stream.on_sent(5_000, now_us, now_us)
    return stream._in_flight[5_000] - now_us


def silent_frames(stream, now_us):
    """Let answers stop, and return how many frames are overdue when the stream notices it."""
    for seq in range(10_000, 10_064):
        stream.on_sent(seq, now_us, now_us)
        now_us = max(stream._in_flight.values())
        stream.may_capture(now_us, listening=True)
        if stream._overdue:
            return seq - 9_999
    return None


@pytest.mark.parametrize(("runs", "overdue"), [
    ((), 1),  # nothing was lost before
    ((1,), 6), ((2,), 6),  # limited by the silence of 300 ms
    ((1, 1, 1), 5), ([1] * 20, 3), ([1] * 100, 2), ([1, 2] * 20, 6),
])  # fmt: skip
def test_silence_that_the_losses_of_the_link_explain_is_not_a_queue(runs, overdue):
    stream, now_us = lossy_link(*runs)
    assert silent_frames(stream, now_us) == overdue


def test_lost_frame_returns_its_credit_and_changes_nothing_else():
    stream, now_us = lossy_link(2, 1)
    window, bitrate = NotedWindow.made[-1], stream._bitrate_control
    bitrate.calls.clear()
    for seq in (901, 902, 903):
        stream.on_sent(seq, now_us, now_us)
    assert not credit(stream, now_us + LOSSY_TIMEOUT_US - 1)
    timeouts = stream.credit_timeouts
    assert credit(stream, now_us + LOSSY_TIMEOUT_US) and stream.credit_timeouts == timeouts + 3
    for seq in (904, 905, 906):
        stream.on_sent(seq, now_us + LOSSY_TIMEOUT_US, now_us + LOSSY_TIMEOUT_US)
        assert credit(stream, now_us + 2 * LOSSY_TIMEOUT_US - 1) is (seq < 906), "as many as the window allows"
    assert window.timeouts == [] and not [call for call in bitrate.calls if call[0] == "on_overdue"]


def test_silence_of_300_ms_is_an_outage():
    stream, now_us = lossy_link(*[5] * 9)
    for late_us, overdue in ((300_000, 0), (300_001, 1)):
        stream.on_sent(900 + overdue, now_us, now_us)
        stream._in_flight = {900 + overdue: now_us + late_us}
        stream.may_capture(now_us + late_us, listening=True)
        assert stream._overdue == overdue


@pytest.mark.parametrize(("floors", "lossy"), [((1, 1), True), ((-1, 1), False), ((1, -1), False), ((-1, -1), False)])
def test_loss_is_proven_by_answers_at_floor_delay_before_and_after_it(floors, lossy):
    stream = stream_of(max_fps=100)
    stream.on_holder(VISION, 0)
    window = NotedWindow.made[-1]
    for seq, floor in zip((1, 4), floors, strict=True):
        window.floor_us = floor * 1_000_000
        stream.on_sent(seq - 1, seq * 50_000, seq * 50_000)
        stream.on_sent(seq, seq * 50_000, seq * 50_000)
        stream.on_answer(VISION, seq, 0, seq * 50_000 + 40_000)
    window.floor_us = 1_000_000
    for seq in (10, 11):  # two more at floor delay, with nothing lost
        stream.on_sent(seq, seq * 50_000, seq * 50_000)
        stream.on_answer(VISION, seq, 0, seq * 50_000 + 40_000)
    assert timeout_of(stream, 1_000_000) == (LOSSY_TIMEOUT_US if lossy else 72_000)


@pytest.mark.parametrize(("silence_us", "lossy"), [(300_000, True), (300_001, False)])
def test_frames_of_an_outage_prove_no_loss(silence_us, lossy):
    stream, now_us = lossy_link()
    for seq in (900, 901):
        stream.on_sent(seq, now_us, now_us + silence_us - 40_000)
    stream.on_answer(VISION, 901, 0, now_us + silence_us)
    assert timeout_of(stream, now_us + 500_000) == (LOSSY_TIMEOUT_US if lossy else 72_000)


def test_queue_ends_the_patience_with_losses():
    stream, now_us = lossy_link(2, 2)
    NotedWindow.made[-1].floor_us = 39_999
    stream.on_sent(900, now_us, now_us)
    stream.on_answer(VISION, 900, 0, now_us + 40_000)
    assert silent_frames(stream, now_us + 50_000) == 1


@pytest.mark.parametrize(("later_us", "lossy"), [(29_999_999, True), (30_000_000, False)])
def test_losses_are_forgotten_after_30_s_without_one(later_us, lossy):
    stream, now_us = lossy_link(2)
    proven_us = now_us - 60_000  # the last frame was answered without a loss
    assert timeout_of(stream, proven_us + later_us) == (LOSSY_TIMEOUT_US if lossy else 72_000)


def record_of(*runs):
    """Return the record after as many frames were lost in a row as each of `runs`, at 0."""
    record = LossRecord()
    for lost in (0, *runs):
        record.add(lost, at_floor=True, silence_us=0, now_us=0)
    return record


@pytest.mark.parametrize(("runs", "again"), [
    ((1,), 0.49 / 1.49), ((2,), 1.49 / 2.49), ((2, 1), (0.98 * 1.49) / (0.98 * 2.49 + 1)),
])  # fmt: skip
def test_share_of_lost_frames_of_which_the_next_is_lost_too(runs, again):
    """The newest count most, and the first one is as if half a frame more had been lost."""
    record = record_of(*runs)
    for overdue in range(1, 12):
        assert record.explains(overdue, 0, 0) is (again**overdue >= 1e-4)
    assert 1 - record._runs / record._frames == pytest.approx(again, rel=1e-12)


@pytest.mark.parametrize(("more", "explained"), [(1e-6, True), (-1e-6, False)])
def test_loss_explains_what_happens_once_in_10_000_losses(more, explained):
    record = record_of(1)
    record._frames, record._runs = 1.0, 0.9 - more
    assert record.explains(4, 0, 0) is explained
    assert record.explains(3, 0, 0) and not record.explains(5, 0, 0)


def test_losses_that_happen_exactly_so_often_explain_a_silence(monkeypatch):
    monkeypatch.setattr(module, "_LOSSES_PER_SILENCE", 8)
    record = record_of(1)
    record._frames, record._runs = 2.0, 1.0
    assert record.explains(3, 0, 0) is True and record.explains(4, 0, 0) is False


def test_link_that_lost_nothing_explains_nothing():
    assert LossRecord().explains(1, 0, 0) is False
    assert record_of().explains(1, 0, 0) is False


def test_frames_in_flight_are_not_overdue():
    stream, now_us = lossy_link(*[1] * 20)
    for seq in (901, 902, 903):
        stream.on_sent(seq, now_us, now_us + (seq - 901) * 5_000)
    for late_us, overdue in ((0, 0), (5_000, 0), (10_000, 1)):
        assert credit(stream, now_us + LOSSY_TIMEOUT_US + late_us)
        assert stream._overdue == overdue


def test_new_owner_begins_without_losses():
    stream, now_us = lossy_link(2)
    stream.on_holder(VIEWER, now_us)
    NotedWindow.made[-1].floor_us = 1_000_000
    stream.on_sent(900, now_us, now_us)
    stream.on_sent(901, now_us, now_us)
    stream.on_answer(VIEWER, 901, 0, now_us + 40_000)
    assert timeout_of(stream, now_us + 100_000) == 72_000, "its first answer has none before it"


def test_timeout_of_a_lossy_link_follows_the_spread_and_is_bounded():
    stream, now_us = lossy_link(2)
    stream.on_sent(900, now_us, now_us)
    stream.on_answer(VISION, 900, 0, now_us + 80_000)
    mean_us, spread_us = stream._answer_us, stream._spread_us
    assert timeout_of(stream, now_us + 100_000) == round(mean_us + 2 * spread_us) > mean_us + 12_000
    assert NotedWindow.made[-1].jitters_us[-1] == spread_us
    stream, now_us = lossy_link(2, max_credit_timeout_ms=45)
    assert timeout_of(stream, now_us) == 45_000


def test_overdue_stream_of_a_lossy_link_waits_longer_and_longer():
    stream, now_us = lossy_link(2, *[1] * 20)
    silent_frames(stream, now_us)
    usual_us = timeout_of(stream, now_us + 1_000_000)
    assert usual_us > LOSSY_TIMEOUT_US and stream._overdue == 1


# --- timeouts ----------------------------------------------------------------------------------------------------


def timeout_us(stream, now_us):
    """Return the timeout of a frame that is sent now, the only one in flight."""
    stream.on_sent(1_000 + now_us, 0, now_us)
    return stream.wait_us(now_us)


@pytest.mark.parametrize(("answers_us", "expected_us"), [
    ((), 120_000),
    ((40_000,), 72_000),  # 1.5 times the mean, and 12 ms
    ((40_000, 40_000), 72_000), ((40_000, 60_000), 89_500),  # the mean of 42.5 ms and four times the spread of 8.75 ms
    ((60_000, 40_000), 57_500 + 4 * 10_625 + 12_000),
    ((40_000, 100_000), 2 * 47_500 + 12_000),  # at most twice the mean
    ((400_000,), 500_000),
])  # fmt: skip
def test_timeout_follows_the_mean_and_the_spread_of_the_answers(answers_us, expected_us):
    stream, now_us = stream_of(max_credit_timeout_ms=500), 0
    for seq, answer_us in enumerate(answers_us):
        stream.on_sent(seq, now_us, now_us)
        stream.on_answer(VISION, seq, 0, now_us + answer_us)
        now_us += 1_000_000
        stream.on_holder(VISION, now_us)
    assert timeout_us(stream, now_us) == expected_us


def test_longest_timeout_is_configured():
    assert timeout_us(answered_once(400_000, max_credit_timeout_ms=300), 1_000_000) == 300_000


def test_credit_returns_at_its_timeout_and_is_counted():
    stream = answered_once(40_000)
    stream.on_sent(1, 100_000, 100_000)
    assert not credit(stream, 171_999) and stream.credit_timeouts == 0
    assert credit(stream, 172_000) and stream.credit_timeouts == 1
    assert stream.on_answer(VISION, 1, 0, 180_000) is False, "the late answer returns none"


def sent_and_overdue(stream, now_us, seq=100):
    """Send a frame and let its credit time out; return that time."""
    stream.on_sent(seq, now_us, now_us)
    late_us = min(stream._in_flight.values())
    stream.may_capture(late_us, listening=True)
    return late_us


def test_second_overdue_answer_in_a_row_is_a_queue():
    stream = answered_once(40_000)
    window, bitrate = NotedWindow.made[-1], stream._bitrate_control
    bitrate.calls.clear()
    late_us = sent_and_overdue(stream, 100_000)
    assert window.timeouts == [] and ("on_overdue", late_us) not in bitrate.calls
    again_us = sent_and_overdue(stream, late_us, 101)
    assert window.timeouts == [again_us] and ("on_overdue", again_us) in bitrate.calls
    third_us = sent_and_overdue(stream, again_us, 102)
    assert window.timeouts == [again_us, third_us]


def test_timeouts_before_the_first_answer_are_not_overdue():
    """The time of the link is not known yet."""
    stream, now_us = stream_of(), 0
    for seq in range(5):
        late_us = sent_and_overdue(stream, now_us, seq)
        assert late_us == now_us + FIRST_TIMEOUT_US
        now_us = late_us
    assert NotedWindow.made[-1].timeouts == []


def test_frames_in_flight_at_a_timeout_do_not_count_again():
    """One loss of several frames is not a queue; a frame that was sent after the timeout is evidence."""
    stream = answered_once(40_000, frames=3)
    for seq in (1, 2):
        stream.on_sent(seq, 60_000 + 40_000 * seq, 60_000 + 40_000 * seq)
    assert stream.may_capture(172_000, listening=True)
    assert stream.may_capture(212_000, listening=True)
    assert stream.credit_timeouts == 2 and NotedWindow.made[-1].timeouts == []
    late_us = sent_and_overdue(stream, 220_000)
    assert NotedWindow.made[-1].timeouts == [late_us]


def test_frame_sent_at_the_moment_of_a_timeout_counts():
    stream = answered_once(40_000)
    late_us = sent_and_overdue(stream, 100_000)
    assert sent_and_overdue(stream, late_us, 101) == NotedWindow.made[-1].timeouts[0]


def test_frame_that_is_not_remembered_counts_as_sent_at_the_start():
    stream = answered_once(40_000, frames=99)
    stream.on_sent(1, 100_000, 100_000)
    for seq in range(2, 66):
        stream.on_sent(seq, 110_000, 110_000)
    stream.may_capture(172_000, listening=True)
    assert stream.credit_timeouts == 1 and stream._overdue == 1


@pytest.mark.parametrize(("answer_us", "over"), [(72_000, True), (72_001, False)])
def test_answer_in_time_ends_the_overdue_state(answer_us, over):
    """Usual are at most 72 ms after a first answer of 40 ms."""
    stream = answered_once(40_000, frames=2)
    late_us = sent_and_overdue(stream, 100_000)
    stream.on_sent(101, late_us, late_us)
    NotedWindow.made[-1].timeouts.clear()
    stream.on_answer(VISION, 101, 0, late_us + answer_us)
    sent_and_overdue(stream, 500_000, 102)
    assert (NotedWindow.made[-1].timeouts == []) == over


def test_answer_that_ends_the_overdue_state_forgets_when_it_began():
    """A frame that was in flight before it is then the first overdue one of the next loss."""
    stream = answered_once(40_000, frames=9)
    stream.on_sent(1, 100_000, 100_000)
    stream.on_sent(3, 140_000, 140_000)
    stream.may_capture(172_000, listening=True)
    stream.on_sent(2, 172_000, 172_000)
    stream.on_answer(VISION, 2, 0, 180_000)
    stream.may_capture(212_000, listening=True)
    assert stream._overdue == 1


def test_while_answers_are_overdue_one_frame_per_timeout_probes_the_link():
    stream = answered_once(40_000, frames=4)
    for seq in (1, 2):
        stream.on_sent(seq, 100_000 + 40_000 * (seq - 1), 100_000 + 40_000 * (seq - 1))
    assert credit(stream, 172_000), "the first is overdue: a probe, though the second is in flight"
    stream.on_sent(3, 172_000, 172_000)
    assert not credit(stream, 211_999), "one at a time, whatever the window allows"
    assert stream.wait_us(210_000) == 2_000
    assert not credit(stream, 212_000), "the second was in flight already: it permits no further probe"
    assert credit(stream, 172_000 + 72_000), "the probe is overdue"


def test_without_a_frame_in_flight_an_overdue_stream_may_send():
    stream = answered_once(40_000, frames=4)
    late_us = sent_and_overdue(stream, 100_000)
    assert credit(stream, late_us)
    stream.on_sent(101, late_us, late_us)
    assert not credit(stream, late_us + 50_000)
    stream.on_answer(VISION, 101, 0, late_us + 71_999 + 12_000)
    assert credit(stream, late_us + 90_000)


def test_timeout_doubles_with_each_further_overdue_answer_up_to_256_times():
    stream, now_us, timeouts_us = answered_once(0, max_credit_timeout_ms=5_000), 100_000, []
    for seq in range(11):
        late_us = sent_and_overdue(stream, now_us, 100 + seq)
        timeouts_us.append(late_us - now_us)
        now_us = late_us
    assert timeouts_us == [12_000 * times for times in (1, 1, 2, 4, 8, 16, 32, 64, 128, 256, 256)]
