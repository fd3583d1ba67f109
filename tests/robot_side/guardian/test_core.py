"""When a driver process counts as hung, and how often it is started again."""

import pytest

from sightline.robot_side.guardian.core import (
    AT_REST,
    ENDING,
    ENDS_WITHIN_US,
    FAILED,
    HUNG_US,
    IDLE,
    LATE_US,
    LOST,
    MAX_RESTARTS,
    MOVING,
    PERIOD_US,
    REJECTS_US,
    RESTART_WINDOW_US,
    STARTING,
    STARTS_WITHIN_US,
    STARVED_US,
    WATCHED,
    HeartbeatMonitor,
    RestartBudget,
    exit_code_after,
    needs_zero,
    pack_beat,
    unpack_beat,
)


def silence_us(monitor, begin_us, *, run_share=None, step_us=LATE_US, limit_us=60_000_000):
    """Look at a silent driver every `step_us`; return the silence until it must be killed, or None, and the reason."""
    now_us = begin_us
    while now_us - begin_us < limit_us:
        now_us += step_us
        run_us = None if run_share is None else int((now_us - begin_us) * run_share)
        if reason := monitor.look(now_us, run_us):
            return now_us - begin_us, reason
    return None, ""


def beaten(kind, at_us=1_000_000):
    monitor = HeartbeatMonitor(0)
    monitor.on_beat(kind, at_us)
    return monitor


@pytest.mark.parametrize("kind", [AT_REST, MOVING])
@pytest.mark.parametrize("run_share", [None, 1.0])
def test_stopped_or_looping_driver_is_hung_after_200_ms(kind, run_share):
    silent_us, reason = silence_us(beaten(kind), 1_000_000, run_share=run_share)
    assert silent_us == HUNG_US == 200_000
    assert reason == "no heartbeat for 200 ms"


@pytest.mark.parametrize("kind", [AT_REST, MOVING])
def test_driver_with_regular_heartbeats_is_never_killed(kind):
    monitor = HeartbeatMonitor(0)
    for now_us in range(0, 10_000_000, LATE_US):
        monitor.on_beat(kind, now_us)
        assert monitor.look(now_us + LATE_US - 1) == ""
        assert not monitor.is_late


def test_heartbeat_after_a_pause_begins_again():
    monitor = beaten(MOVING, 0)
    silence_us(monitor, 0, limit_us=180_000)
    monitor.on_beat(MOVING, 180_000)
    assert silence_us(monitor, 180_000)[0] == HUNG_US


def test_driver_without_a_processor_is_killed_only_while_its_wheels_turn():
    silent_us, reason = silence_us(beaten(MOVING), 1_000_000, run_share=0.0)
    assert (silent_us, reason) == (STARVED_US, "no processor time for 500 ms; the machine is overloaded")
    assert silence_us(beaten(AT_REST), 1_000_000, run_share=0.0) == (None, "")


def test_loop_that_shares_its_processor_is_found_by_its_own_time():
    silent_us, reason = silence_us(beaten(AT_REST), 1_000_000, run_share=0.25)
    assert 700_000 <= silent_us <= 800_000
    assert reason == f"no heartbeat for {silent_us // 1000} ms"
    assert silence_us(beaten(AT_REST), 1_000_000, run_share=0.1) == (1_775_000, "no heartbeat for 1775 ms")


def test_silence_while_the_guardian_was_starved_does_not_count():
    monitor = beaten(MOVING, 0)
    assert monitor.look(5_000_000) == "", "one late look is the lateness of the guardian"
    assert silence_us(monitor, 5_000_000)[0] == HUNG_US - PERIOD_US - LATE_US


def test_start_and_end_have_limits_of_their_own():
    assert silence_us(HeartbeatMonitor(0), 0) == (STARTS_WITHIN_US, "did not start within 30 s")
    monitor = beaten(ENDING)
    monitor.on_beat(MOVING, 1_000_000)
    assert silence_us(monitor, 1_000_000) == (ENDS_WITHIN_US, "did not end within 7 s")


def test_driver_whose_drive_did_not_take_zero_is_killed_at_once():
    assert beaten(FAILED).look(1_000_000) == "its drive did not take zero at the end"
    assert beaten(FAILED).drive_failed and not beaten(ENDING).drive_failed


def test_driver_whose_drive_takes_no_speeds_while_the_wheels_turn_is_killed_at_once():
    assert beaten(LOST).look(1_000_000) == "its drive took no speeds for 100 ms" and REJECTS_US == 100_000
    assert not beaten(LOST).drive_failed, "a new driver process starts"


def test_limits_are_exact():
    for monitor, limit_us in ((HeartbeatMonitor(0), STARTS_WITHIN_US), (beaten(MOVING, 0), HUNG_US)):
        assert silence_us(monitor, 0, limit_us=limit_us - LATE_US)[0] is None
        assert monitor.look(limit_us - 1) == ""
        assert monitor.look(limit_us) != ""


def test_driver_that_falls_asleep_while_it_waits_for_a_processor_is_hung():
    monitor = beaten(MOVING, 0)
    assert silence_us(monitor, 0, run_share=0.0, limit_us=100_000)[0] is None
    assert silence_us(monitor, 100_000)[0] == HUNG_US - LATE_US


def test_heartbeats_are_bytes_that_differ():
    assert (AT_REST, MOVING, LOST, IDLE) == (b"0", b"1", b"l", b"i")
    assert (STARTING, ENDING, FAILED, WATCHED) == (b"s", b"e", b"f", b"w")
    assert RESTART_WINDOW_US == 60_000_000
    assert pack_beat(MOVING, 1) == b"1\x01" + bytes(7)
    assert unpack_beat(pack_beat(MOVING, 2**40 + 3)) == (MOVING, 2**40 + 3)


def test_silence_counts_from_the_time_at_which_the_heartbeat_was_sent():
    monitor = beaten(MOVING, 0)
    monitor.on_beat(MOVING, 20_000)
    assert monitor.look(PERIOD_US) == "" and monitor.is_late
    assert monitor.look(20_000 + HUNG_US) == "no heartbeat for 200 ms"


def test_tool_that_waits_for_an_operator_may_be_silent():
    assert silence_us(beaten(IDLE), 0, limit_us=10 * STARTS_WITHIN_US)[0] is None
    assert beaten(IDLE).look(2_000_000) == ""


@pytest.mark.parametrize("run_share", [None, 0.0, 1.0])
def test_driver_that_hangs_in_the_start_of_its_network_process_is_killed_after_30_s(run_share):
    monitor = beaten(STARTING, 0)
    reason = "did not start its network process within 30 s"
    assert silence_us(monitor, 0, run_share=run_share) == (STARTS_WITHIN_US, reason)
    monitor.on_beat(AT_REST, 40_000_000)
    assert not monitor.is_starting and silence_us(monitor, 40_000_000)[0] == HUNG_US


def test_time_in_which_the_guardian_did_not_run_does_not_count_for_a_start():
    monitor = beaten(STARTING, 0)
    assert monitor.look(10 * STARTS_WITHIN_US) == "" and monitor.is_starting and not monitor.is_late
    assert silence_us(monitor, 10 * STARTS_WITHIN_US)[0] == STARTS_WITHIN_US - PERIOD_US - LATE_US


def test_processor_time_is_needed_only_after_a_missing_heartbeat():
    monitor = HeartbeatMonitor(0)
    monitor.look(50_000)
    assert not monitor.is_late and not monitor.is_ready
    monitor.on_beat(MOVING, 60_000)
    monitor.look(60_000 + LATE_US)
    assert monitor.is_late and monitor.is_ready


def test_five_restarts_within_a_minute_are_permitted():
    budget = RestartBudget()
    assert [budget.take(second * 1_000_000) for second in range(MAX_RESTARTS + 1)] == [True] * 5 + [False]
    assert not budget.take(RESTART_WINDOW_US - 1)
    assert budget.take(RESTART_WINDOW_US)
    assert not budget.take(RESTART_WINDOW_US)


@pytest.mark.parametrize(("code", "end_signal", "expected"), [
    (0, None, 0), (0, 15, 0), (4, None, 4), (-9, None, None), (-11, None, None), (-1, None, None),
    (-9, 15, 143), (-9, 2, 130), (-1, 15, 143),
])  # fmt: skip
def test_exit_codes_are_forwarded_and_a_killed_driver_starts_again(code, end_signal, expected):
    assert exit_code_after(code, end_signal, was_running=False) == expected


@pytest.mark.parametrize(("code", "end_signal", "expected"), [
    (0, None, None), (1, None, None), (-9, None, None), (0, 15, 0), (4, 15, 4), (-9, 15, 143),
])  # fmt: skip
def test_driver_that_ends_without_an_announcement_starts_again_whatever_its_code(code, end_signal, expected):
    assert exit_code_after(code, end_signal, was_running=True) == expected


@pytest.mark.parametrize(("code", "was_ready", "expected"), [
    (0, True, False), (0, False, False), (1, True, True), (1, False, False), (-9, False, True), (-9, True, True),
    (-1, False, True),
])  # fmt: skip
def test_motors_are_set_to_zero_unless_the_driver_did_it(code, was_ready, expected):
    assert needs_zero(code, was_ready=was_ready, was_running=False) is expected
    assert needs_zero(code, was_ready=True, was_running=True)


@pytest.mark.parametrize(("kind", "is_running"), [
    (AT_REST, True), (MOVING, True), (LOST, True), (STARTING, True), (IDLE, False), (ENDING, False), (FAILED, False),
])
def test_loop_runs_until_it_announces_its_end(kind, is_running):
    assert beaten(kind).is_running is is_running and not HeartbeatMonitor(0).is_running
