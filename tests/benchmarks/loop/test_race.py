"""`sightline bench loop`: its figures, its bounds and its options."""

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from itertools import count, cycle, pairwise
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sightline.benchmarks.loop import race
from sightline.benchmarks.loop.counters import Reading, high_water_mb, read_machine, resident_mb, taken_percent
from sightline.benchmarks.loop.figures import (
    FLOOR,
    MAX_FPS,
    OURS,
    PEERS,
    ZENOH,
    Course,
    LoopSample,
    LoopSetting,
    WheelCommand,
    changes_us,
    course_of_headers,
    course_of_tally,
    figures_of,
    joined,
    loop_checks,
    peers_of,
    percentile,
    repeats_us,
    size_of,
    wheel_ages,
)
from sightline.benchmarks.loop.ours import Ours
from sightline.benchmarks.loop.pictures import write_pictures
from sightline.benchmarks.loop.race import run_race
from sightline.benchmarks.loop.vision import overloaded, with_overload
from sightline.operator_side.cli import bench
from sightline.protocol.channels import TWIST
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.messages import AnswerHeader, Echo, FrameHeader
from sightline.protocol.transports.link import Message
from sightline.robot_side.config import PluginChoice, RobotConfig
from sightline.robot_side.driver.core import DriverCore
from sightline.robot_side.safety.limits import SafetyConfig
from sightline.vision_side.pipeline import FrameLoss

SMALL = LoopSetting(Path(), 160, 120, fps=30.0, seconds=2.0, tries=1)
MS = 1000


def sample(name, ages_ms, cpu_s=0.1, answered_percent=100.0, taken=0.0, waits_ms=(0.0,), robot_s=0.0,
           seconds=0.0):
    ages_us = tuple((at * 33 * MS, round(age_ms * MS)) for at, age_ms in enumerate(ages_ms))
    validated_us = tuple(age_us - round(wait_ms * MS) for (_, age_us), wait_ms in zip(ages_us, cycle(waits_ms)))
    course = Course(len(ages_us), answered_percent, ages_us, validated_us)
    cpu = {"driver": robot_s, "network": robot_s, "vision": cpu_s}
    return LoopSample(name, course, seconds or len(ages_us) / SMALL.fps or 10.0, cpu, {"vision": 60.0}, 1000, taken)


def judged(setting=SMALL, **samples):
    figures = {name: figures_of(one, setting) for name, one in samples.items()}
    return {check.name: check.ok for check in loop_checks(figures, setting)}


# --- figures -----------------------------------------------------------------------------------------------------


@given(st.lists(st.integers(0, 10_000), min_size=1), st.integers(1, 100))
def test_a_percentile_is_a_value_that_so_many_do_not_exceed(values, percent):
    found = percentile(values, percent)
    assert found in values
    assert 100 * sum(value <= found for value in values) >= percent * len(values)
    assert 100 * sum(value < found for value in values) < percent * len(values)


@given(st.lists(st.integers(0, 10**6), unique=True, min_size=1), st.data())
def test_every_image_of_a_tally_counts_once(captured_us, data):
    answered = data.draw(st.sets(st.sampled_from(captured_us)))
    begin_us, end_us = sorted(data.draw(st.tuples(st.integers(0, 10**6), st.integers(0, 10**6))))
    commands_us = sorted((t_us + 5, t_us) for t_us in answered)
    course = course_of_tally(captured_us, [(t_us, at_us) for at_us, t_us in commands_us], begin_us, end_us)
    inside = [t_us for t_us in captured_us if begin_us <= t_us < end_us]
    assert course.captured == len(inside)
    assert course.answered_percent == pytest.approx(100 * len(answered & set(inside)) / max(1, len(inside)))
    assert len(course.ages_us) == sum(begin_us <= t_us + 5 < end_us for t_us in answered)
    assert all(age_us == 5 for _, age_us in course.ages_us)


def header_rows(count, refused=()):
    """Frames 33 ms apart; each header contains the age of the last command accepted, some of which were not."""
    rows, latency_us = [], None
    for seq in range(count):
        rows.append((seq, seq * 33 * MS, latency_us))
        if seq not in refused:
            latency_us = 2 * MS + seq
    return rows


def statuses(rows, refused=()):
    """Every 100 ms, how many commands were accepted up to then."""
    for t_us in range(0, rows[-1][1], 100 * MS):
        yield t_us, sum(at_us + 2 * MS <= t_us and seq not in refused for seq, at_us, _ in rows)


SETS_US = range(0, 300 * 33 * MS, 250)
"""Times of `drive.set`."""


@given(st.lists(st.integers(1, 300 * MS), unique=True), st.integers(0, 20 * MS))
def test_age_at_the_wheels_is_that_of_the_first_command_after_the_validation(latencies_us, wait_us):
    headers = [(seq, seq * 350 * MS, latency_us) for seq, latency_us in enumerate([None, *latencies_us])]
    validated_us = [seq * 350 * MS + latency_us for seq, latency_us in enumerate(latencies_us)]
    sets_us = sorted(at_us + later_us for at_us in validated_us for later_us in (-1, wait_us))
    assert list(wheel_ages(headers, sets_us)) == [
        (at_us + wait_us, latency_us + wait_us, latency_us)
        for at_us, latency_us in zip(validated_us, latencies_us, strict=True)]


def test_image_of_a_command_is_the_newest_one_that_is_so_old():
    headers = [(0, 0, None), (1, 33, None), (2, 66, None), (3, 99, 70), (4, 132, 36), (5, 165, 36)]
    assert list(wheel_ages(headers, range(0, 200, 10))) == [(70, 70, 70), (110, 44, 36)]
    assert list(wheel_ages(headers, range(0, 80, 10))) == [(70, 70, 70)], "the wheels never received the second one"


@pytest.mark.parametrize(("turned", "late_ms"), [(True, [0, 0, 0]), (False, [20, 20, 20])])
def test_wheels_count_from_the_line_that_carries_the_new_command(turned, late_ms):
    """A driver that sets the former speeds when a command arrives, and the new ones 20 ms later, is late."""
    headers = [(seq, seq * 33 * MS, 3 * MS + seq if seq else None) for seq in range(1, 5)]
    headers.insert(0, (0, 0, None))
    lines, speed = [WheelCommand(0, 0.0, 0.0)], 0.0
    for seq in range(4):
        at_us = seq * 33 * MS + 3 * MS + seq + 1
        first = WheelCommand(at_us, seq + 1.0 if turned else speed, 1.0)
        lines += [first, WheelCommand(at_us + 20 * MS, seq + 1.0, 1.0)]
        speed = seq + 1.0
    ages = list(wheel_ages(headers, changes_us(lines)))
    assert [round((age.age_us - age.validated_us) / MS) for age in ages[1:]] == late_ms


@given(st.lists(st.integers(0, 2), min_size=3, max_size=40), st.sampled_from([400, 7 * MS]))
def test_wait_of_a_command_that_repeats_the_one_before_is_unknown(numbers, wait_us):
    """No line of the motor log shows it: the next change is that of a later command. All others have their own wait."""
    commands = [(seq * 33 * MS, f"0.5000|{number}.0000") for seq, number in enumerate([*numbers, 3])]
    headers = [(0, 0, None), *((seq + 1, (seq + 1) * 33 * MS, 3 * MS + seq) for seq in range(len(commands)))]
    lines = [WheelCommand(-1, -1.0, 0.0)]
    for seq, (t_us, text) in enumerate(commands):
        lines.append(WheelCommand(t_us + 3 * MS + seq + wait_us, float(text.partition("|")[2]), 0.0))
    course = course_of_headers(headers, [], changes_us(lines), 0, headers[-1][1], copies=1.0,
                               repeated_us=repeats_us(commands))
    waits_us = [age_us - validated_us for (_, age_us), validated_us in
                zip(course.ages_us, course.validated_us, strict=True)]
    repeats = sum(one[1] == other[1] for one, other in pairwise(commands))
    assert waits_us == [wait_us] * (len(commands) - repeats)


@pytest.mark.parametrize(("tick_us", "ok"), [(1, True), (20 * MS, False)])
def test_driver_whose_commands_wait_for_its_tick_fails(tick_us, ok):
    """900 commands that arrive at any phase of the tick; a driver that wakes for a command has a tick of 1 us."""
    rows = header_rows(900)
    validated_us = [t_us + latency_us for (_, t_us, _), (_, _, latency_us) in pairwise(rows)]
    sets_us = [-(-at_us // tick_us) * tick_us for at_us in validated_us]
    course = course_of_headers(rows, list(statuses(rows)), sets_us, 0, rows[-1][1] + 1, copies=1.0)
    ours = replace(sample(OURS, []), course=course, seconds=30.0)
    found = judged(**{FLOOR: sample(FLOOR, [2.0] * 900), OURS: ours})
    assert found["longest wait for the wheels"] is ok
    assert found["commands with a known wait"]


@pytest.mark.parametrize(("known", "ok"), [(90, True), (89, False)])
def test_longest_wait_of_few_commands_does_not_count(known, ok):
    ours = sample(OURS, [1.5] * known)
    ours = replace(ours, course=replace(ours.course, captured=100))
    assert judged(**{FLOOR: sample(FLOOR, [1.0] * 100), OURS: ours})["commands with a known wait"] is ok


@pytest.mark.parametrize(("radius", "ages"), [(1.0, 99), (0.0, 0)])
def test_dead_wheels_have_no_course(tmp_path, radius, ages):
    rows = header_rows(100)
    ours = Ours({}, (), "", tmp_path / "tally", tmp_path / "wheels", list(statuses(rows)))
    ours.tally.write_text(json.dumps({"headers": rows, "copies": 1.0, "commands": []}))
    ours.wheels.write_text("".join(f"{t_us},{radius * t_us},0.0\n" for t_us in SETS_US))
    assert len(ours.course(0, rows[-1][1] + 1).ages_us) == ages


@given(st.sets(st.integers(5, 85), max_size=30))
def test_rejected_commands_are_missing_from_the_headers(refused):
    rows = header_rows(100, refused)
    course = course_of_headers(rows, list(statuses(rows, refused)), SETS_US, 0, rows[-1][1] + 1, copies=1.0)
    assert course.captured == 100
    assert len(course.ages_us) == 99 - len(refused)
    assert course.validated_us == tuple(2 * MS + seq for seq in range(99) if seq not in refused)
    assert course.answered_percent == pytest.approx(100 - len(refused), abs=2.5)


def test_frames_that_the_vision_service_did_not_receive_are_unanswered():
    rows = header_rows(100)
    kept = [row for row in rows if not 40 <= row[0] < 60]
    accepted = list(statuses(rows, range(40, 60)))
    course = course_of_headers(kept, accepted, SETS_US, 0, rows[-1][1] + 1, copies=1.0)
    assert course.captured == 100
    assert course.answered_percent == pytest.approx(80, abs=2.5)


def test_command_that_is_sent_twice_answers_one_image():
    """The real driver accepts both copies. Every second image is lost."""
    safety = SafetyConfig(auto_arm=True)
    core = DriverCore(RobotConfig(safety=safety, range_sensor=PluginChoice(kind="none")), "0000aaaa")
    loss, headers, accepted, sent = FrameLoss(), [], [], 0
    for seq in range(300):
        frame = FrameHeader(session="0000aaaa", seq=seq, t_us=(seq + 1) * 33 * MS)
        core.on_issued(seq, frame.t_us, 0)
        if seq % 2:
            accepted.append((frame.t_us, core.gate.accepted))
            continue
        headers.append((seq, frame.t_us, core.gate.latency_us))
        loss.update(frame, 0)
        for copy in range(loss.copies):
            sent += 1
            header = AnswerHeader(source="vision", session="0000bbbb", seq=sent, echo=Echo.of(frame))
            at_us = frame.t_us + 4 * MS + copy + seq
            core.on_twist(Message(TWIST, "vision", encode(header), b"0.1000|0.0000"), at_us)
        core.tick(frame.t_us + 5 * MS, None, None)
    assert core.gate.accepted > 280, "of 150 images"
    course = course_of_headers(headers, accepted, SETS_US, 40 * 33 * MS, 280 * 33 * MS, copies=sent / 150)
    assert course.answered_percent == pytest.approx(50, abs=1)


def test_without_an_answer_there_are_no_figures_and_no_check_holds():
    silent = figures_of(sample(OURS, []), SMALL)
    assert (silent.p50_ms, silent.p95_ms, silent.first_ms, silent.most_wait_ms) == (None, None, None, None)
    found = judged(**{OURS: sample(OURS, [], answered_percent=0), FLOOR: sample(FLOOR, [1.0] * 100)})
    assert not found["p50, times the floor"]
    assert not found["p50 over floor"] and not found["p95 over floor"]
    assert not found["longest wait for the wheels"]
    assert not found["not accepted"]


def test_the_bounds_are_held_against_the_floor_of_the_same_run():
    floor = sample(FLOOR, [1.0] * 100, cpu_s=0.1)
    assert all(judged(**{FLOOR: floor, OURS: sample(OURS, [1.5] * 95 + [5.9] * 5, cpu_s=0.15)}).values())
    for changes, bound in (
        ({"ages_ms": [1.51] * 100}, "p50, times the floor"), ({"ages_ms": [2.6] * 100}, "p50 over floor"),
        ({"ages_ms": [1.5] * 94 + [6.1] * 6}, "p95 over floor"),
        ({"cpu_s": 0.17}, "vision CPU over floor"), ({"cpu_s": 0.151}, "vision CPU"),
        ({"robot_s": 0.0751}, "robot CPU"), ({"answered_percent": 98.9}, "not accepted"),
        ({"ages_ms": [1.5] * 99 + [7.0], "waits_ms": [0.0] * 99 + [5.1]}, "longest wait for the wheels"),
    ):
        one = sample(**{"name": OURS, "ages_ms": [1.5] * 100, **changes})
        assert not judged(**{FLOOR: floor, OURS: one})[bound], bound


def test_few_images_fail_although_each_is_answered():
    floor, ours = sample(FLOOR, [1.0] * 450), sample(OURS, [1.0] * 15, seconds=15.0)
    assert not judged(**{FLOOR: floor, OURS: ours})["answered per second"]
    figures = figures_of(ours, SMALL)
    assert (figures.fps, figures.answered_percent, figures.accepted_percent) == (1.0, pytest.approx(100 / 30), 100.0)


@pytest.mark.parametrize(("rival", "fps", "ok"), [
    ("lekiwi", 11.0, True), ("lekiwi", 12.0, False), ("tcp", 30.0, True), ("callback", 30.0, True),
])
def test_overloaded_sightline_answers_nearly_as_many_images_as_a_rival_without_a_queue(rival, fps, ok):
    slow = replace(SMALL, detector_delay_ms=80.0)
    others = {rival: sample(rival, [90.0] * 600, seconds=600 / fps), "ring": sample("ring", [90.0] * 100, seconds=10.0)}
    ours = sample(OURS, [85.0] * 100, seconds=10.0)
    found = judged(slow, **{FLOOR: sample(FLOOR, [81.0] * 100), OURS: ours}, **others)
    assert found["answered per second"] is ok


@given(st.lists(st.lists(st.integers(1, 90), min_size=1, max_size=9), min_size=1, max_size=4), st.data())
def test_turns_joined_are_as_one_sample_of_all_their_pictures(turns, data):
    parts = [replace(sample(OURS, ages_ms, data.draw(st.floats(0, 9)), data.draw(st.floats(0, 100)), at), tries=at + 1)
             for at, ages_ms in enumerate(turns)]
    whole = joined(parts)
    assert [age_us // MS for _, age_us in whole.course.ages_us] == [age for ages_ms in turns for age in ages_ms]
    answered = sum(len(ages) * part.course.answered_percent for ages, part in zip(turns, parts, strict=True))
    assert whole.course.answered_percent == pytest.approx(answered / whole.course.captured)
    assert len(whole.course.validated_us) == len(whole.course.ages_us)
    assert whole.cpu_s["vision"] == pytest.approx(sum(part.cpu_s["vision"] for part in parts))
    assert (whole.seconds, whole.carried_bytes) == (
        pytest.approx(sum(map(len, turns)) / SMALL.fps), 1000 * len(parts))
    assert whole.taken_percent == len(parts) - 1  # a turn that was disturbed is not hidden by the others
    assert whole.tries == sum(part.tries for part in parts)


def test_missing_count_of_one_turn_stays_missing():
    assert joined([sample(OURS, [1]), replace(sample(OURS, [1]), carried_bytes=None)]).carried_bytes is None


def test_age_with_a_slow_detector_has_separate_bounds_and_does_not_grow():
    slow = replace(SMALL, detector_delay_ms=80.0)
    floor = sample(FLOOR, [81.0] * 100)
    rival = {"tcp": sample("tcp", [86.0] * 100), "ring": sample("ring", [84.0] * 50 + [90.0] * 50)}
    assert all(judged(slow, **{FLOOR: floor, OURS: sample(OURS, [85.0] * 100)}, **rival).values())
    assert not judged(slow, **{FLOOR: floor, OURS: sample(OURS, [85.7] * 100)}, **rival)["p50, times the best rival"]
    growing = [80 + at / 10 for at in range(100)]
    found = judged(slow, **{FLOOR: floor, OURS: sample(OURS, [*growing, *[121.0] * 5])})
    assert not found["drift of age"]
    assert not found["age p99"]


def test_drift_is_from_the_first_ten_seconds_to_the_last():
    late = [80.0] * 310 + [200.0] * 1400 + [84.0] * 310  # 33 ms each: a minute, bad in its middle
    ours = figures_of(sample(OURS, late), SMALL)
    assert (ours.first_ms, ours.last_ms) == (80.0, 84.0)
    short = figures_of(sample(OURS, [80.0] * 60 + [200.0] * 180 + [84.0] * 60), SMALL)
    assert (short.first_ms, short.last_ms) == (80.0, 84.0)


def test_overload_by_rate_has_the_ages_of_an_80_ms_detector():
    over = replace(SMALL, fps=60.0, overload=2.0)
    floor = sample(FLOOR, [36.0] * 100)
    assert all(judged(over, **{FLOOR: floor, OURS: sample(OURS, [90.0] * 99 + [120.0])}).values())
    assert not judged(over, **{FLOOR: floor, OURS: sample(OURS, [90.1] * 100)})["age p50"]
    assert not judged(over, **{FLOOR: floor, OURS: sample(OURS, [60.0] * 98 + [120.1] * 2)})["age p99"]
    beaten = {FLOOR: floor, OURS: sample(OURS, [60.0] * 99), "tcp": sample("tcp", [50.0])}
    assert not judged(over, **beaten)["p95 behind tcp"]


@pytest.mark.parametrize("rival", ZENOH)
def test_fastest_rival_over_zenoh_may_be_so_much_faster(rival):
    others = {name: sample(name, [9.0] * 100) for name in ZENOH if name != rival} | {"tcp": sample("tcp", [1.0] * 100)}
    for age_ms, ok in ((2.3, True), (2.31, False)):
        samples = {FLOOR: sample(FLOOR, [2.0] * 100), OURS: sample(OURS, [age_ms] * 100), **others}
        assert judged(**samples, **{rival: sample(rival, [2.0] * 100)})["p50 behind the fastest over Zenoh"] is ok


@pytest.mark.parametrize("rival", PEERS)
def test_every_peer_is_a_rival(rival):
    ours, floor = sample(OURS, [2.0] * 100), sample(FLOOR, [1.0] * 100)
    assert judged(**{FLOOR: floor, OURS: ours, rival: sample(rival, [2.1] * 100)})[f"p95 behind {rival}"]
    beaten = judged(**{FLOOR: floor, OURS: ours, rival: sample(rival, [1.9] * 100)})
    assert not beaten[f"p95 behind {rival}"] and not beaten[f"p99 behind {rival}"]


@pytest.mark.parametrize("rival", PEERS)
@pytest.mark.parametrize("load", [{"detector_delay_ms": 80.0}, {"fps": 60.0, "overload": 2.0}])
def test_loaded_sightline_is_compared_with_every_rival(rival, load):
    """The best rival decides, whichever it is: 2 % at the median, and ahead at p95."""
    slow, others = replace(SMALL, **load), {name: sample(name, [200.0] * 100) for name in PEERS if name != rival}
    for ours_ms, rival_ms, failed in (
        ([51.0] * 100, [50.0] * 90 + [52.0] * 10, set()),
        ([51.1] * 100, [50.0] * 90 + [52.0] * 10, {"p50, times the best rival"}),
        ([51.0] * 90 + [52.1] * 10, [50.0] * 90 + [52.0] * 10, {f"p95 behind {rival}"}),
    ):
        found = judged(slow, **{FLOOR: sample(FLOOR, [36.0] * 100), OURS: sample(OURS, ours_ms)}, **others,
                       **{rival: sample(rival, rival_ms)})
        assert {name for name, ok in found.items() if not ok} == failed


def test_a_disturbed_sample_fails_the_run():
    found = judged(**{FLOOR: sample(FLOOR, [1.0] * 9, taken=50.0), OURS: sample(OURS, [2.0] * 9)})
    assert not found["samples disturbed by others"]


@pytest.mark.parametrize(("left_s", "taken"), [(60.0, [9.0, 8.0, 7.0]), (0.0, [9.0])])
def test_disturbed_sample_is_taken_again_while_there_is_time(monkeypatch, left_s, taken):
    others, said = iter([9.0, 8.0, 7.0]), []
    monkeypatch.setattr(race, "_take_one", lambda *_given: sample(OURS, [1.0], taken=next(others)))
    budget = race.Budget(time.monotonic() + left_s, 1)
    least = race.take_sample(OURS, replace(SMALL, tries=3), Path(), budget, said.append)
    assert (least.taken_percent, len(said)) == (taken[-1], len(taken))


@pytest.mark.parametrize(("start_s", "seconds", "least_s"), [
    (2.0, 10.0, 10.0), (5.0, 10.0, 7.0), (9.0, 10.0, 2.0), (20.0, 10.0, 2.0), (5.0, 60.0, 60.0),
])
def test_run_ends_within_four_minutes_and_marks_what_it_shortened(monkeypatch, start_s, seconds, least_s):
    """Others have 50 % of the machine, and each contestant needs `start_s` to start and end."""
    now = [1000.0]
    monkeypatch.setattr(race.time, "monotonic", lambda: now[0])

    def take(name, setting, *_given):
        now[0] += start_s + setting.seconds
        return sample(name, [1.0] * round(setting.seconds * 30), taken=50.0)

    monkeypatch.setattr(race, "_take_one", take)
    setting = replace(SMALL, seconds=seconds, tries=3)
    samples = race._samples(setting, Path(), lambda _line: None)
    assert set(samples) == set(setting.contestants)
    assert now[0] - 1000.0 <= 235 * seconds / 10
    assert min(one.seconds for one in samples.values()) >= least_s
    assert any(figures_of(one, setting).is_short for one in samples.values()) is (least_s < seconds)


def small_race():
    floor = replace(sample(FLOOR, [1.0] * 60), hot_us=1234.0)
    samples = {FLOOR: floor, OURS: sample(OURS, [2.0] * 60, taken=9.0)}
    figures = {name: figures_of(one, SMALL) for name, one in samples.items()}
    return race.Race(SMALL, 1.0, samples, figures, loop_checks(figures, SMALL))


def test_results_are_printed_although_their_folder_cannot_be_made(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(race, "run_race", lambda *_: small_race())
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="choose a folder"):
        bench.loop(peers="none", out=tmp_path / "file" / "new")
    assert "samples disturbed by others" in capsys.readouterr().out


def test_table_shows_unpaced_figures_and_marks_disturbed_samples():
    head, *rows = bench._table(small_race())
    assert [row[head.index("unpaced"):][:7].strip() for row in rows] == ["1.2", ""]
    assert ["!" in row for row in rows] == [False, True]


def test_shortened_sample_is_marked():
    whole = figures_of(sample(OURS, [1.0] * 60), SMALL)
    cut = figures_of(sample(OURS, [1.0] * 58), SMALL)
    assert (whole.is_disturbed, cut.is_disturbed, cut.taken_percent) == (False, True, 0.0)


def test_time_of_other_processes_excludes_idle_and_own_time(monkeypatch):
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    before = Reading({"vision": 1.0}, own_s=1.0, busy_s=10.0, steal_s=0.0)
    after = Reading({"vision": 3.0}, own_s=2.0, busy_s=14.0, steal_s=0.5)
    assert taken_percent(before, after, 10.0) == pytest.approx(100 * (1.0 + 0.5) / 20)


# --- options -----------------------------------------------------------------------------------------------------


def test_process_that_ends_in_the_measurement_is_one_clear_error():
    process = subprocess.Popen([sys.executable, "-c", ""])
    os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
    for held_mb in (high_water_mb, resident_mb):
        with pytest.raises(HardwareError, match=f"process {process.pid} ended while it was measured"):
            held_mb(process.pid)  # its parent has not noticed yet
    process.wait()
    for measured in (high_water_mb, resident_mb, lambda pid: read_machine({"network": pid})):
        with pytest.raises(HardwareError, match=f"process {process.pid} ended while it was measured"):
            measured(process.pid)
    assert 0 < resident_mb(os.getpid()) <= high_water_mb(os.getpid())


@pytest.mark.parametrize("text", ["640", "x480", "640x", "a640x480", "640x480x3", "６４０x480", "-1x4", ""])
def test_a_size_that_is_invalid_is_rejected(text):
    with pytest.raises(ConfigError, match="WIDTHxHEIGHT"):
        size_of(text)


def test_sizes_and_peers_are_read():
    assert size_of("640x480") == (640, 480)
    assert (peers_of("all"), peers_of("none"), peers_of("older,openpi")) == (PEERS, (), ("older", "openpi"))
    with pytest.raises(ConfigError, match="zmqq"):
        peers_of("older,zmqq")


def test_contestants_are_the_floor_sightline_and_the_chosen_peers():
    assert replace(SMALL, peers=()).contestants == (FLOOR, OURS)
    assert replace(SMALL, peers=("older", "callback")).contestants == (FLOOR, OURS, "older", "callback")


@given(st.floats(0.3, 100), st.floats(1.1, 10), st.sampled_from([15.0, 30.0, 60.0, 240.0]))
def test_overload_means_so_many_times_more_pictures_than_can_be_detected(step_ms, overload, fps):
    asked = replace(SMALL, fps=fps, overload=overload)
    found = with_overload(asked, step_ms)
    assert found.is_loaded and found.fps <= MAX_FPS
    assert max(found.busy_ms, step_ms) * found.fps / 1000 == pytest.approx(overload, rel=0.05)
    assert found.busy_ms == 0 or found.fps == fps


def test_small_pictures_are_overloaded_by_a_slower_detector(tmp_path, monkeypatch):
    """A step takes 1 ms; on a busy machine it might take so long that more pictures overload it."""
    write_pictures(tmp_path, 160, 120)
    clock = SimpleNamespace(perf_counter_ns=count(0, 1_000_000).__next__)
    monkeypatch.setattr("sightline.benchmarks.loop.vision.time", clock)
    said = []
    found = overloaded(replace(SMALL, pictures=tmp_path, fps=60.0, overload=2.0), said.append)
    assert (found.fps, found.busy_ms) == (60.0, pytest.approx(33.3, abs=0.1))
    assert "33.3 ms" in said[0]


@pytest.mark.parametrize(
    "change",
    [{"fps": 0.5}, {"seconds": 1}, {"detector_delay_ms": 301}, {"width_px": 63}, {"overload": 1.0}, {"overload": 11.0},
     {"overload": 2.0, "detector_delay_ms": 80.0}],
)
def test_impossible_setting_is_rejected(change):
    with pytest.raises(ConfigError):
        replace(SMALL, **change)


def test_an_unknown_transport_is_rejected_before_anything_starts():
    with pytest.raises(ConfigError, match="carrier"):
        run_race(replace(SMALL, transport="carrier"), print)
