"""The checks of the rows with several vision services: each finds the failure that it is for."""

from itertools import pairwise

import pytest

from sightline.benchmarks.network.cases import CASES
from sightline.benchmarks.network.sharing import (
    BOUNDS,
    HARMS,
    LOADED_FPS,
    LOADED_ROBOTS,
    changes_of_driver,
    drivers_that_return,
    least_harms,
    loaded_checks,
    longest_stand_s,
    looks_per_frame,
    sharing_checks,
    worst_gap_ms,
)

MS = 1_000
STEP_US = 66 * MS
SECOND_US = 1_000 * MS


def record(drivers, step_us=STEP_US, holds=(), answers_per_frame=1.0):
    """A robot that accepts a command of each of `drivers` in turn."""
    accepted = [(number * step_us, driver, number * step_us) for number, driver in enumerate(drivers)]
    sent_us = [captured_us for _, _, captured_us in accepted]
    answers = round(len(sent_us) * answers_per_frame)
    return {"accepted": accepted, "holds": list(holds), "sent_us": sent_us, "answers": answers}


def failed(bounds, records, ends_us=(6_000 * MS,), each=1):
    """Names of the checks that fail."""
    full = {f"r{number}": records.get(f"r{number}", record("a" * 45 + "b" * 46)) for number in range(bounds.robots)}
    return [check.name for check in sharing_checks(bounds, full, list(pairwise((0, *ends_us))), each) if not check.ok]


KILLED = BOUNDS["shared-killed"]


def test_a_healthy_site_passes_every_row():
    for bounds in BOUNDS.values():
        assert failed(bounds, {"r3": record("a" * 50 + "b" * 41)}) == []


@pytest.mark.parametrize("at", [1, 20, 60])
def test_a_planted_second_driver_is_found(at):
    both = record("a" * at + "b" + "a" * (90 - at))
    assert drivers_that_return({"r1": both}) == 1
    assert failed(KILLED, {"r7": both}) == ["two drivers at once, in 21 changes"]
    alternating = record("ab" * 45 + "a")
    assert drivers_that_return({"r1": alternating}) == 89
    assert changes_of_driver({"r1": alternating, "r2": record("aabbcc")}) == 92


def test_a_gap_is_found_in_the_middle_at_the_end_and_for_a_robot_without_commands():
    gap = record("a" * 91)
    del gap["accepted"][40:45]
    assert worst_gap_ms({"r1": gap}, 0, 6_000 * MS) == pytest.approx(6 * 66)
    assert failed(KILLED, {"r2": gap}) == ["between two commands, worst robot"]
    assert worst_gap_ms({"r1": record("a" * 10)}, 0, 6_000 * MS) == pytest.approx(6_000 - 9 * 66)
    assert worst_gap_ms({"r1": record("")}, 1_000 * MS, 3_000 * MS) == 2_000
    assert "robots that drive at the end" in failed(KILLED, {"r2": record("")})


def test_a_gap_counts_for_the_span_that_it_reaches_into():
    gap = record("a" * 91)
    del gap["accepted"][40:45]
    assert worst_gap_ms({"r1": gap}, 0, 30 * STEP_US) == pytest.approx(66)
    assert worst_gap_ms({"r1": gap}, 0, 42 * STEP_US) >= 3 * 66 - 1


def test_a_gap_counts_only_after_the_last_harm_of_several():
    gap, parted = record("a" * 91), BOUNDS["shared-parted"]
    del gap["accepted"][20:25]
    assert failed(parted, {"r1": gap}, (3_000 * MS, 6_000 * MS), each=2) == []
    assert failed(parted, {"r1": gap}, (1_000 * MS, 6_000 * MS), each=2) == ["between two commands, worst robot"]
    assert failed(parted, {"r1": gap}, (2_500 * MS, 3_000 * MS, 4_000 * MS, 6_000 * MS), each=2) == []


def test_a_robot_that_joined_and_was_forgotten_is_found():
    both = ["robots that drive at the end", "between two commands, worst robot"]
    assert failed(BOUNDS["shared-200"], {"r150": record("a" * 20)}) == both
    assert failed(BOUNDS["shared-200"], {"r150": record("")}) == both


def test_standing_is_found_also_until_the_end():
    stood = record("a" * 91, holds=[(1_000 * MS, 1_600 * MS), (2_000 * MS, 2_100 * MS)])
    assert longest_stand_s({"r1": stood}, 0, 6_000 * MS) == pytest.approx(0.6)
    assert longest_stand_s({"r1": stood}, 1_600 * MS, 6_000 * MS) == pytest.approx(0.1)
    assert longest_stand_s({"r1": stood}, 0, 1_000 * MS) == 0
    assert longest_stand_s({"r1": record("a", holds=[(1_000 * MS, 0)])}, 0, 6_000 * MS) == pytest.approx(5.0)
    assert failed(BOUNDS["shared-frozen"], {"r1": stood}) == ["a robot stands, worst of 1 times"]


STANDS = [name for name, bounds in BOUNDS.items() if bounds.stands_s is not None]


@pytest.mark.parametrize("name", STANDS)
@pytest.mark.parametrize(("begin_ms", "end_ms"), [(1_000, 0), (1_000, 50_000), (13_600, 0), (13_600, 59_000)])
def test_standing_counts_in_full_whatever_harm_it_begins_before(name, begin_ms, end_ms):
    stuck = record("a" * 908, holds=[(begin_ms * MS, end_ms * MS)])
    spans_us = [(4_000 * MS, 14_000 * MS), (14_000 * MS, 60_000 * MS)]
    records = {f"r{number}": record("a" * 450 + "b" * 458) for number in range(BOUNDS[name].robots - 1)}
    found = [check for check in sharing_checks(BOUNDS[name], {**records, "stuck": stuck}, spans_us) if not check.ok]
    assert [check.name for check in found] == ["a robot stands, worst of 2 times"]
    assert found[0].value == pytest.approx((end_ms or 60_000) / 1000 - begin_ms / 1000)


@pytest.mark.parametrize("name", BOUNDS)
def test_robot_without_a_command_in_the_last_second_does_not_drive(name):
    assert "robots that drive at the end" in failed(BOUNDS[name], {"r3": record("a" * 75)})
    assert "robots that drive at the end" not in failed(BOUNDS[name], {"r3": record("a" * 77)})


def test_service_that_drives_late_after_the_return_of_its_link_is_found():
    alone, late = BOUNDS["shared-alone"], record("a" * 91)
    late["accepted"] = [one for one in late["accepted"] if not 1_200 * MS <= one[0] < 3_800 * MS]
    assert failed(alone, {"r4": late}, (3_000 * MS, 6_000 * MS), each=2) == ["drives again, worst robot"]
    assert failed(alone, {"r4": late}, (3_500 * MS, 6_000 * MS), each=2) == []
    full = {f"r{number}": record("a" * 91) for number in range(1, 20)}
    spans_us = [(0, 3_000 * MS), (3_000 * MS, 6_000 * MS)]
    checks = {check.name: check for check in sharing_checks(alone, {**full, "r20": record("a" * 20)}, spans_us, 2)}
    assert checks["drives again, worst robot"].value is None


@pytest.mark.parametrize("name", [name for name, bounds in BOUNDS.items() if bounds.least_changes])
def test_run_with_few_changes_of_the_driver_shows_nothing_about_two_drivers(name):
    calm = {f"r{number}": record("a" * 91) for number in range(14)}
    assert failed(BOUNDS[name], calm) == ["changes of the driver"], "6 of the other robots change"


def test_number_of_harms_follows_from_the_length_of_the_run():
    assert [least_harms(KILLED, seconds) for seconds in (4, 20, 120)] == [1, 3, 20]
    assert [least_harms(BOUNDS["shared-parted"], seconds, 2) for seconds in (4, 20, 120)] == [2, 4, 24]


def test_frames_that_two_services_look_at_are_found():
    twice = {f"r{number}": record("a" * 90 + "b", answers_per_frame=2.0) for number in range(KILLED.robots)}
    assert looks_per_frame(twice) == 2.0
    assert failed(KILLED, twice) == ["answers of all services over frames"]
    assert failed(BOUNDS["shared-alone"], twice) == [], "one service cannot"


def loaded(services, received=None, **changes):
    """Names of the checks that fail for services that answer each frame of 15 a second, from 1 to 3 s."""
    every = {"step_us": STEP_US, **changes}
    records = {f"r{number}": record("a" * 91, **every) for number in range(LOADED_ROBOTS)}
    sent = 20 * len([t_us for t_us in range(0, 91 * every["step_us"], every["step_us"]) if 1 <= t_us / SECOND_US < 3])
    checks = loaded_checks(records, services, SECOND_US, 3 * SECOND_US, sent if received is None else received * sent)
    return [check.name for check in checks if not check.ok]


def test_services_with_a_slow_detector_must_answer_more_frames_together():
    assert [loaded(services) for services in LOADED_FPS] == [[], [], []]
    slow = {services: loaded(services, step_us=120 * MS) for services in LOADED_FPS}
    assert slow == {1: [], 2: [], 4: ["4 services: answered for each robot"]}
    assert loaded(2, step_us=140 * MS) == ["2 services: answered for each robot"]
    assert loaded(1, step_us=900 * MS) == []


def test_frames_that_come_to_services_without_an_answer_are_found():
    assert loaded(4, received=1.04) == []
    assert loaded(4, received=1.06) == ["4 services: frames received over frames sent"]


def test_frame_that_is_answered_twice_counts_once_for_services_with_a_slow_detector():
    twice = record("a" * 60, step_us=100 * MS)
    twice["accepted"] = sorted(twice["accepted"] * 2)
    checks = list(loaded_checks({f"r{number}": twice for number in range(LOADED_ROBOTS)}, 4, 0, 6 * SECOND_US, 0))
    assert checks[0].value == pytest.approx(10) and not checks[0].ok


def test_every_row_has_its_harm_and_its_bounds():
    rows = {row.name for row in CASES if row.scene == "shared"}
    assert rows == set(BOUNDS) == set(HARMS)
