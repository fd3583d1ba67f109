"""Whose frame is looked at next: newest only, fair, never too old, and a batch that fits into the deadline."""

import random

import pytest

from sightline.vision_side.serving.detector_queue import BatchClock, FairQueue, QueuedFrame

DEADLINE_US = 100_000


def test_the_newest_takes_the_place_of_the_one_before_and_is_counted():
    turns = FairQueue(8, DEADLINE_US)
    for item in range(5):
        turns.offer("r1", item, item)
    assert [(turn.robot, turn.item) for turn in turns.take(5)] == [("r1", 4)] and turns.take(6) == []
    tally = turns.counters["r1"]
    assert (tally.offered, tally.overtaken, tally.dropped) == (5, 4, 4)


def test_waiting_frames_form_one_bounded_batch():
    turns = FairQueue(3, DEADLINE_US)
    for name in "abcde":
        turns.offer(name, name, 0)
    assert [turn.robot for turn in turns.take(1)] == ["a", "b", "c"]
    assert [turn.robot for turn in turns.take(1)] == ["d", "e"]


def test_last_served_robot_is_last_at_any_rate():
    turns = FairQueue(1, DEADLINE_US)
    served = []
    for step in range(30):
        for name in "abc":
            for _ in range(20 if name == "a" else 1):
                turns.offer(name, step, step)
        served.extend(turn.robot for turn in turns.take(step))
    assert served == ["a", "b", "c"] * 10


def test_frame_too_old_for_the_deadline_is_skipped():
    turns = FairQueue(8, DEADLINE_US)
    turns.offer("old", 1, 0)
    turns.offer("young", 2, 60_000)
    assert [turn.robot for turn in turns.take(95_000, each_us=10_000)] == ["young"]
    assert turns.counters["old"].stale == 1
    turns.offer("edge", 3, 0)
    assert [turn.robot for turn in turns.take(DEADLINE_US)] == ["edge"]


@pytest.mark.parametrize(("each_us", "batch"), [(0, 16), (1_000, 16), (5_000, 10), (20_000, 2), (80_000, 1)])
def test_a_batch_takes_half_a_deadline_at_most(each_us, batch):
    turns = FairQueue(16, DEADLINE_US)
    for robot in range(20):
        turns.offer(f"r{robot}", 0, 0)
    assert len(turns.take(0, each_us)) == batch


@pytest.mark.parametrize("each_us", [DEADLINE_US + 1, 3_000_000])
def test_fresh_frame_is_examined_after_a_slow_one(each_us):
    """The first frame on a cold device takes seconds. If that ruled out all others, no new time would be measured."""
    turns = FairQueue(16, DEADLINE_US)
    turns.offer("fresh", 0, 0)
    turns.offer("old", 0, -DEADLINE_US)
    assert [turn.robot for turn in turns.take(0, each_us)] == ["fresh"]


@pytest.mark.parametrize("seed", [21, 22, 23])
def test_twice_the_load_is_shared_fairly_and_nothing_is_answered_late(seed):
    """Forty streams of 30 images per second, at 1.7 ms per image, lose half of their images in equal shares."""
    rng, turns, now_us, each_us = random.Random(seed), FairQueue(16, DEADLINE_US), 0, 1_667
    due = {f"r{robot}": rng.randrange(33_333) for robot in range(40)}
    served, ages = dict.fromkeys(due, 0), []
    while now_us < 20_000_000:
        for robot in sorted(due):
            while due[robot] <= now_us:
                turns.offer(robot, None, due[robot])
                due[robot] += 33_333 + rng.randint(-5_000, 5_000)
        batch = turns.take(now_us, each_us)
        now_us += each_us * len(batch) if batch else 500
        for turn in batch:
            served[turn.robot] += 1
            ages.append(now_us - turn.arrived_us)
    mean = sum(served.values()) / len(served)
    assert max(abs(count - mean) for count in served.values()) <= 0.1 * mean
    assert 0.45 < sum(served.values()) / sum(tally.offered for tally in turns.counters.values()) < 0.55
    assert sorted(ages)[int(len(ages) * 0.95)] <= DEADLINE_US


def batch_of(*arrivals_us):
    return [QueuedFrame(f"r{number}", None, arrived_us) for number, arrived_us in enumerate(arrivals_us)]


def clock_after(prepare_us, detect_us, frames=4, batches=8):
    """Return a clock that has seen equal batches, and the time at which the last one ended."""
    clock, now_us = BatchClock(DEADLINE_US, 0), 0
    for _ in range(batches):
        batch = batch_of(*[now_us] * frames)
        clock.prepared(batch, now_us, now_us + prepare_us)
        clock.begin(batch, now_us + prepare_us)
        now_us += prepare_us + detect_us
        clock.end(frames, now_us)
    return clock, now_us


def test_next_batch_is_taken_when_its_decoding_ends_with_the_detection_before():
    clock, now_us = clock_after(prepare_us=2_000, detect_us=8_000)
    assert clock.wait_us(now_us) == 0, "the detector is free"
    clock.begin(batch_of(now_us), now_us)
    assert clock.wait_us(now_us + 1_000) == 5_000
    assert clock.wait_us(now_us + 6_000) == clock.wait_us(now_us + 60_000) == 0


def test_next_batch_waits_for_the_first_whose_time_is_unknown():
    clock = BatchClock(DEADLINE_US, 0)
    clock.begin(batch_of(0), 0)
    assert clock.wait_us(90_000) == DEADLINE_US


def test_time_of_a_frame_includes_its_decoding():
    clock, _ = clock_after(prepare_us=2_000, detect_us=8_000, frames=4)
    assert clock.each_us == 2_500 and BatchClock(DEADLINE_US, 0).each_us == 0


def test_frame_is_not_computed_after_its_deadline():
    """It was fresh when its turn came, and the detector was busy for longer than expected."""
    clock, now_us = clock_after(prepare_us=0, detect_us=8_000, frames=4)
    ages_us = (DEADLINE_US, DEADLINE_US - 1_999, DEADLINE_US - 2_000, 0)
    fresh, deadline_us = clock.begin(batch_of(*[now_us - age_us for age_us in ages_us]), now_us)
    assert [turn.robot for turn in fresh] == ["r2", "r3"] and deadline_us == now_us + 2_000


def test_batch_without_a_fresh_frame_does_not_begin():
    clock, now_us = clock_after(prepare_us=0, detect_us=8_000)
    assert clock.begin(batch_of(now_us - DEADLINE_US - 1), now_us)[0] == []
    assert clock.wait_us(now_us) == 0


def test_busy_ratio_counts_a_detection_that_goes_on():
    clock = BatchClock(DEADLINE_US, 0)
    clock.begin(batch_of(0), 1_000)
    clock.end(1, 3_000)
    assert clock.busy_ratio(4_000) == 0.5
    clock.begin(batch_of(4_000), 4_000)
    assert clock.busy_ratio(8_000) == clock.busy_ratio(9_000) == 1.0
    clock.end(1, 9_000)
    assert clock.busy_ratio(10_000) == 0.0


def test_ages_in_the_queue_and_of_answers_are_separate_and_bounded():
    clock = BatchClock(DEADLINE_US, 0)
    assert clock.queue_p95_us() is None and clock.answer_p95_us() is None
    for age_us in range(10_000):
        clock.prepared(batch_of(0), age_us, age_us)
        clock.answered(2 * age_us)
    assert 9_960 < clock.queue_p95_us() < 9_990 and clock.answer_p95_us() == 2 * clock.queue_p95_us()
