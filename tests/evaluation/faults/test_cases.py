"""The fault bench: its checks on invented logs, its rows and report, and the rows themselves on real processes.

The short set is marked `slow`, the rest `long`.
"""

import json
import math
import re
import ssl
from collections import Counter
from datetime import UTC, date, datetime
from types import SimpleNamespace

import pytest
import typer
from hypothesis import given
from hypothesis import strategies as st

from docs.make.faults import describe_machine, report_page
from sightline.evaluation.checks import Check, at_most, worst_checks
from sightline.evaluation.faults import cases, devices, drivers, runner, stop_cases
from sightline.evaluation.faults.cases import CASES, chosen
from sightline.evaluation.faults.drivers import JOINED_GAP_MS, OWNER, STANDBY, handover_checks
from sightline.evaluation.faults.evidence import (
    GOOD,
    HELD_US,
    INJECTED,
    OLD_US,
    RAMPED_US,
    Blind,
    EventLog,
    MotorRow,
    SentCommand,
    held_rows,
    last_valid_us,
    measure_stop,
    most_gain_mps2,
    moved_on_old_sight,
    read_events,
    read_motors,
    stop_checks,
)
from sightline.evaluation.faults.fixture import ROBOT, Setup
from sightline.evaluation.faults.load_clients import client_hello
from sightline.evaluation.faults.peer import ATTACKS, MALFORMED, OVERSIZED, read_recording
from sightline.evaluation.faults.report import passed, run_line, to_dict
from sightline.evaluation.faults.runner import FaultCase, FaultOutcome, Injected, run_case, watched_us
from sightline.evaluation.faults.sampler import STALL_US, Hole, read_holes, stalled_us
from sightline.operator_side.cli import evaluate as cli_faults
from sightline.protocol.channels import REQUEST, TWIST
from sightline.protocol.clock import monotonic_us
from sightline.protocol.errors import ConfigError, LinkError, WireError
from sightline.protocol.jpeg import read_jpeg_size
from sightline.protocol.text import parse_twist
from sightline.robot_side.kinematics import DiffDriveConfig
from sightline.robot_side.safety.limits import SafetyConfig, stop_bound
from sightline.vision_side.serving.assignment import assign

RADIUS_M = DiffDriveConfig().wheel_radius_m
TICK_US = 20_000
SENT_EVERY_US = 33_000


def log(speeds_mps, lag_rows=0):
    """A motors' log of one row a tick; the wheels follow `lag_rows` later."""
    rows, angle_rad = [], 0.0
    for index, speed_mps in enumerate(speeds_mps):
        rows.append(MotorRow(index * TICK_US, speed_mps / RADIUS_M, speed_mps / RADIUS_M, angle_rad, angle_rad))
        angle_rad += speeds_mps[max(0, index - lag_rows)] / RADIUS_M * TICK_US / 1e6
    return rows


def drive_and_stop(plateau=50, ramp=10, rest=50, top_mps=0.5):
    return [top_mps] * plateau + [top_mps * (1 - (k + 1) / ramp) for k in range(ramp)] + [0.0] * rest


def commands(until_us, age_us=5_000):
    return [SentCommand(t_us, t_us - age_us) for t_us in range(0, until_us + 1, SENT_EVERY_US)]


# --- the checks --------------------------------------------------------------------------------------------------


@given(st.integers(1, 60), st.integers(1, 30), st.integers(0, 4))
def test_stop_is_measured_at_its_time(plateau, ramp, lag_rows):
    rows = log(drive_and_stop(plateau, ramp), lag_rows)
    stop = measure_stop(rows, since_us=0)
    assert stop.falls_ms == plateau * 20
    zero_ms = (plateau + ramp - 1) * 20
    assert zero_ms <= stop.zero_ms <= zero_ms + (lag_rows + 1) * 20
    assert stop.distance_m == pytest.approx(0.5 * 0.02 * (plateau + (ramp - 1) / 2 + lag_rows), rel=1e-6)


def test_wheels_that_only_coast_are_not_at_zero():
    rows = log([0.5] * 10 + [0.0] * 20, lag_rows=30)
    assert measure_stop(rows, 0).zero_ms is None


def test_speed_that_returns_fails_the_stop_check():
    rows = log([*drive_and_stop(), 0.1, 0.1])
    assert measure_stop(rows, 0).zero_ms is None
    assert not all(check.ok for check in stop_checks(measure_stop(rows, 0)))


def test_wheels_that_never_slow_never_fall():
    stop = measure_stop(log([0.5] * 100), since_us=1_000_000)
    assert stop.falls_ms is None and stop.zero_ms is None
    assert not any(check.ok for check in stop_checks(stop))


def test_a_dip_does_not_count_as_falling():
    speeds = [0.5] * 20 + [0.3] + [0.5] * 10 + drive_and_stop(0)
    assert measure_stop(log(speeds), 0).falls_ms == 31 * 20


def test_turning_on_the_spot_is_motion():
    turning = [MotorRow(index * TICK_US, -5.0, 5.0, -0.1 * index, 0.1 * index) for index in range(50)]
    assert measure_stop(turning, 0).zero_ms is None
    assert moved_on_old_sight(turning, [SentCommand(0, -2_000_000)], None) > 0


@pytest.mark.parametrize(("late_ms", "ok"), [(300, True), (340, True), (360, False), (700, False)])
def test_the_bound_on_falling_is_a_bound(late_ms, ok):
    rows = log(drive_and_stop(plateau=late_ms // 20, ramp=5))
    assert stop_checks(measure_stop(rows, 0))[0].ok is ok


def test_a_log_is_read_without_its_unfinished_line():
    text = "t_us,left_rad_s,right_rad_s,left_rad,right_rad\n1,2.0,3.0,4.0,5.0\n2,2.0,3."
    assert read_motors(text) == [MotorRow(1, 2.0, 3.0, 4.0, 5.0)]


# --- old frames --------------------------------------------------------------------------------------------------


def test_promised_ages_are_those_of_the_robot():
    assert SafetyConfig().zero_speed_age_ms * 1000 == OLD_US and stop_bound(SafetyConfig()).ramped_us == RAMPED_US


def test_driving_on_young_frames_is_not_counted():
    assert moved_on_old_sight(log(drive_and_stop()), commands(900_000), None) == 0


def test_driving_on_without_a_young_frame_is_counted():
    rows = log([0.5] * 150)
    assert moved_on_old_sight(rows, commands(1_000_000), None) > 70


def test_gaining_speed_on_an_old_frame_is_counted_within_the_ramp():
    speeds = [0.3] * 50 + [0.3 - 0.01 * k for k in range(20)] + [0.15] + [0.0] * 30
    last_us = (50 + 20 - 22) * TICK_US
    assert moved_on_old_sight(log(speeds), commands(last_us, age_us=0), None) == 1


def test_commands_while_blind_permit_nothing_until_frames_are_fresh():
    rows, sent = log([0.5] * 150), commands(3_000_000)
    assert moved_on_old_sight(rows, sent, None) == 0
    assert moved_on_old_sight(rows, sent, Blind(1_000_000)) > 60
    assert moved_on_old_sight(rows, sent, Blind(1_000_000, 1_200_000)) == 0


def test_image_in_flight_at_the_cut_may_be_answered():
    rows = log([0.5] * 51 + [0.5 - 0.02 * k for k in range(25)] + [0.0] * 40)
    sent = [*commands(900_000), SentCommand(1_090_000, 990_000)]
    assert moved_on_old_sight(rows, sent, Blind(1_000_000)) > 0
    assert moved_on_old_sight(rows, sent, Blind(1_000_000, by_frame=True)) == 0
    assert last_valid_us(sent, Blind(1_000_000, by_frame=True)) == 1_090_000
    assert last_valid_us(sent, Blind(1_000_000)) <= 1_000_000


def test_failed_check_extends_the_watched_time_to_all_measurements():
    good, bad = at_most("zero", 1.0, "ms", 2.0), at_most("zero", 3.0, "ms", 2.0)
    injected = Injected(1, 6_000_000, from_us=2_000_000)
    assert watched_us(injected, [good]) == (6_000_000, 7_000_000)
    from_us, to_us = watched_us(injected, [good, bad])
    assert from_us == 2_000_000 and to_us > 66_000_000
    assert stalled_us([Hole(3_000_000, 3_100_000)], from_us, to_us) > STALL_US
    assert watched_us(Injected(1, 6_000_000), [bad])[0] == 6_000_000


def test_speed_that_a_robot_keeps_without_a_line_is_counted():
    frozen, stands = log([0.5] * 51), log(drive_and_stop(plateau=60))
    to_the_end = held_rows(frozen, 0, 3_000_000)
    until_it_stands = held_rows([*frozen, *(row for row in stands if row.t_us > 2_000_000)], 0, 3_000_000)
    assert moved_on_old_sight(to_the_end, commands(1_000_000), None) > 70
    assert moved_on_old_sight(until_it_stands, commands(1_000_000), None) > 20
    assert moved_on_old_sight(held_rows(stands, 0, 9_000_000), commands(1_000_000), None) == 0, "it stands"
    assert moved_on_old_sight(to_the_end, commands(3_000_000), None) == 0, "frames are young"


@pytest.mark.parametrize(("now_us", "ok"), [(3_000_000, False), (1_000_000, True)])
def test_row_without_a_stop_counts_a_speed_that_lasts_until_its_end(monkeypatch, now_us, ok):
    monkeypatch.setattr(runner, "monotonic_us", lambda: now_us)
    rig = SimpleNamespace(motors=lambda: log([0.5] * 51), sent=lambda: commands(1_000_000))
    row = FaultCase("x", "x", lambda _rig: Injected(1, 0), Setup(), stops=False)
    assert [one.ok for one in runner._motion_checks(row, rig, Injected(1, 0))] == [ok]


def test_speed_of_a_legacy_robot_out_of_reach_does_not_count_as_driven_on_an_old_frame(monkeypatch, tmp_path):
    (tmp_path / "log").write_text(stop_cases.CUT_ITS_POWER)
    clock = iter([500_000, 11_000_000])
    monkeypatch.setattr(stop_cases, "monotonic_us", lambda: next(clock))
    monkeypatch.setattr(runner, "monotonic_us", lambda: 11_100_000)
    processes = SimpleNamespace(signal=lambda *_: None, start=lambda *_: None, exit_code=lambda *_: LinkError.exit_code,
                                log=lambda _: tmp_path / "log")
    [case] = chosen(["legacy.stop_offline"], short=False)
    rig = SimpleNamespace(processes=processes, endpoint="", setup=case.setup,  # its last line is later than the signal
                          motors=lambda: log([0.5] * 27), sent=lambda: commands(500_000))
    injected = case.inject(rig)
    assert [one.name for one in (*runner._motion_checks(case, rig, injected), *injected.checks) if not one.ok] == []


def test_only_a_long_pause_from_the_fault_on_counts_as_a_held_speed():
    begin, end = (MotorRow(t_us, 5.0, 5.0, 0.0, 0.0) for t_us in (1_000_000, 1_000_000 + HELD_US))
    assert held_rows([begin, end], 1_000_000, end.t_us) == [begin, end]
    assert len(held_rows([begin, end], 1_000_000, end.t_us + HELD_US + 1)) == 7
    assert held_rows([begin], 1_000_001, 9_000_000) == [begin]
    assert held_rows([], 0, 9_000_000) == []


def test_without_any_command_no_motion_is_allowed():
    assert moved_on_old_sight(log([0.5] * 10), [], None) == 9


@given(st.lists(st.integers(0, 10**6), max_size=20), st.integers(0, 10**6))
def test_the_last_valid_command_is_from_before_the_blindness(times_us, from_us):
    last_us = last_valid_us([SentCommand(t_us, t_us) for t_us in times_us], Blind(from_us))
    assert last_us == max((t_us for t_us in times_us if t_us <= from_us), default=None)


@pytest.mark.parametrize("gain_mps2", [0.5, 2.0, 8.0])
def test_the_hardest_change_is_found(gain_mps2):
    speeds = [0.0] * 10 + [min(0.5, gain_mps2 * 0.02 * k) for k in range(60)]
    assert most_gain_mps2(log(speeds), 0) == pytest.approx(min(gain_mps2, 0.5 / 0.1), rel=0.01)


# --- what the bench's own processes note -------------------------------------------------------------------------


def test_event_log_is_read_without_a_torn_line(tmp_path):
    path = tmp_path / "a.events"
    event_log = EventLog(path)
    event_log.note(GOOD, 7)
    event_log.note(INJECTED)
    with path.open("a") as torn:
        torn.write("good,12")
    assert [one.frame_us for one in read_events(path, GOOD)] == [7] and len(read_events(path, INJECTED)) == 1
    assert read_events(tmp_path / "none", GOOD) == []


def test_recording_is_read_without_a_torn_line(tmp_path):
    path = tmp_path / "driver.txt"
    path.write_text(f"twist {b'{}'.hex()} {b'0|0'.hex()}\nrequest {b'{}'.hex()} {b'1'.hex()}\ntwist 7b", "ascii")
    assert read_recording(path) == [(TWIST, b"{}", b"0|0"), (REQUEST, b"{}", b"1")]


def test_only_holes_in_the_window_spoil_a_row(tmp_path):
    path = tmp_path / "holes.csv"
    path.write_text("100,200\n5000,9000\n20000,20100\n")
    assert stalled_us(read_holes(path), 300, 4000) == 0
    assert stalled_us(read_holes(path), 150, 6000) == 4000


@pytest.mark.parametrize("text", [*MALFORMED, *OVERSIZED], ids=lambda text: repr(text[:12]))
def test_malformed_messages_are_malformed(text):
    with pytest.raises(WireError):
        parse_twist(text)


def test_oversized_messages_exceed_the_channel_bound():
    assert all(len(text) > TWIST.max_payload_bytes for text in OVERSIZED)


def test_spare_images_have_the_defects_of_their_names(tmp_path):
    devices.write_spares(tmp_path)
    size = read_jpeg_size((tmp_path / "black.jpg").read_bytes())
    assert (size.width_px, size.height_px) == devices.SPARE["black"]
    bomb = (tmp_path / "bomb.jpg").read_bytes()
    assert len(bomb) < 2000 and read_jpeg_size(bomb, max_pixels=2**33).width_px == 65_500
    with pytest.raises(WireError):
        read_jpeg_size(bomb)


# --- rows and report ---------------------------------------------------------------------------------------------


def outcome(row=CASES[0], value=1.0, bound=2.0, **changes):
    check = Check("zero", value, "ms", bound, value is not None and value <= bound)
    return FaultOutcome(row, **{"checks": (check,), **changes})


@pytest.mark.parametrize(("row", "other"), [
    ("wire.mixed", "delayed"), ("wire.mixed", "reordered"), ("wire.loss", "delayed"),
])
def test_other_harm_of_the_wire_is_not_the_fault(monkeypatch, row, other):
    assert harmed_count(monkeypatch, row, ab=[other], ba=[other]) == 0


@pytest.mark.parametrize(("row", "harms"), [
    ("wire.mixed", ["reordered", "duplicated"]), ("wire.loss", ["lost"]), ("wire.delay", ["delayed"]),
])
def test_harm_in_one_direction_only_is_not_the_fault(monkeypatch, row, harms):
    assert harmed_count(monkeypatch, row, ab=harms, ba=[]) == harmed_count(monkeypatch, row, ab=[], ba=harms) == 0
    assert harmed_count(monkeypatch, row, ab=harms, ba=harms) == 5


def harmed_count(monkeypatch, row, **harms):
    """The count of a row whose wire harms five packets in each direction in the ways of `harms`."""
    monkeypatch.setattr(cases, "drives_again", lambda rig: True)

    class Wire:
        def __init__(self):
            self.counts = {"ab": Counter(), "ba": Counter()}

        def shape(self, shapes):
            self.counts = {leg: count + Counter(dict.fromkeys(harms[leg], 5)) for leg, count in self.counts.items()}

    [case] = chosen([row], short=False)
    return case.inject(SimpleNamespace(wire=Wire(), watch=lambda seconds: None)).count


@pytest.mark.parametrize("row", ["network.kill", "network.pause"])
def test_robot_may_drive_from_the_first_command_that_a_new_network_process_lets_arrive(monkeypatch, row):
    began_us, pids, signaled = monotonic_us(), iter([7, 7, 0, 8]), []
    after_us = [cases.LEFT_OVER_US // 2, 2_750_000, 2_800_000]
    monkeypatch.setattr(cases, "drives_again", lambda rig: True)
    monkeypatch.setattr(cases, "os", SimpleNamespace(kill=lambda *sent: signaled.append(sent)))
    rig = SimpleNamespace(
        processes=SimpleNamespace(network=lambda name: next(pids)), watch=lambda seconds: None,
        sent=lambda: [SentCommand(began_us + later_us, began_us) for later_us in after_us],
        until=lambda happened, *_: list(iter(happened, True)),
        signal_network=lambda number: monotonic_us(),
    )
    [case] = chosen([row], short=False)
    assert case.inject(rig).resumed_us == began_us + 2_750_000 and [pid for pid, _ in signaled] == [7]


@pytest.mark.parametrize(("row", "falls_ms", "zero_ms", "cpu_s", "ok"), [
    ("stop.typed", 100, 540, 0.1, True), ("stop.typed", 100, 560, 0.1, False), ("stop.typed", 220, 540, 0.1, False),
    ("stop.typed_slow", 100, 340, 0.1, True), ("stop.typed_slow", 100, 360, 0.1, False),
    ("stop.typed_slow", 220, 340, 0.1, False), ("stop.typed_slow", 100, 340, 0.25, False),
])
def test_typed_stop_has_the_bounds_of_its_speed(monkeypatch, row, falls_ms, zero_ms, cpu_s, ok):
    [case] = chosen([row], short=False)
    before, ramp = [case.setup.linear_mps] * (200 // 20), (zero_ms - falls_ms) // 20 + 1
    fast = [case.setup.linear_mps] * (falls_ms // 20)
    speeds = [*before, *fast, *(fast[0] * (1 - k / ramp) for k in range(1, ramp + 1)), *[0.0] * 30]
    used_s = iter([1.0, 1.0 + cpu_s])
    monkeypatch.setattr(stop_cases, "monotonic_us", lambda: 200_000 - 1)
    monkeypatch.setattr(stop_cases, "resource", SimpleNamespace(
        RUSAGE_CHILDREN=0, getrusage=lambda who: SimpleNamespace(ru_utime=next(used_s), ru_stime=0.0)))
    monkeypatch.setattr(stop_cases, "subprocess", SimpleNamespace(run=lambda *_, **__: SimpleNamespace(returncode=0)))
    rig = SimpleNamespace(endpoint="", setup=case.setup, motors=lambda: log(speeds), watch=lambda seconds: None)
    assert all(check.ok for check in case.inject(rig).checks) is ok


@pytest.mark.parametrize(("each_us", "ok"), [(100_000, True), (110_000, True), (130_000, False), (10**6, False)])
def test_publisher_that_is_slower_than_its_row_states_fails(each_us, ok):
    noted = [SentCommand(number * each_us, 0) for number in range(30)]
    for events, is_ok in ((noted, ok), (noted[:1], False), ([], False)):
        rig = SimpleNamespace(noted=lambda *_, events=events: events, web_endpoint="")
        assert [check.ok for check in stop_cases._load_checks(rig, "publisher")] == [is_ok]


@pytest.mark.parametrize(("row", "least"), [
    ("flood.tls25", 60), ("flood.tcp500", 1200), ("flood.tcp_half_after20", 700), ("flood.sessions_router", 63)])
def test_flood_that_is_weaker_than_its_row_states_fails(monkeypatch, row, least):
    monkeypatch.setattr(stop_cases, "_load_checks", lambda *_: ())
    nothing = SimpleNamespace(wait_line=lambda *_: None, kill=lambda *_: None)
    for count, is_ok in ((least, True), (least - 1, False)):
        rig = SimpleNamespace(
            prepare_operator=lambda: None, start_load=lambda *_: None, processes=nothing, watch=lambda _: None,
            noted=lambda *_, count=count: [None] * count, stop_by_operator=lambda **_: (0, ()), web_endpoint="",
            endpoint="")
        [case] = chosen([row], short=False)
        assert [check.ok for check in case.inject(rig).checks] == [is_ok]


def test_stop_is_sent_during_each_flood_and_at_several_times_after_its_end():
    rows = {row.id for row in CASES if row.id.startswith("flood.")}
    floods = {row for row in rows if "_router" not in row and "_after" not in row}
    assert {f"flood.{kind}" for kind in ("tls25", "tls_half", "tls_hello", "tcp500", "tcp_half", "sessions")} < floods
    assert {f"{flood}_after{after_s}" for flood in floods for after_s in (2, 20, 80)} < rows


def test_stalled_handshake_begins_one():
    server = ssl.MemoryBIO()
    server.write(client_hello())
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    with pytest.raises(ssl.SSLError, match="NO_SHARED_CIPHER"):  # it has no certificate, but read the whole message
        context.wrap_bio(server, ssl.MemoryBIO(), server_side=True).do_handshake()


# --- services that share robots ----------------------------------------------------------------------------------


def circles(*sides, each=50, mps=0.5):
    """A motor log of drivers that turn to one side each: 1 left, -1 right."""
    turns = [side for side in sides for _ in range(each)]
    return [MotorRow(index * TICK_US, mps / RADIUS_M - turn, mps / RADIUS_M + turn, 0.0, 0.0)
            for index, turn in enumerate(turns)]


def test_first_service_of_the_rows_is_the_better_choice_of_the_robot():
    assert assign([ROBOT], {OWNER: 1.0, STANDBY: 1.0})[ROBOT] == (OWNER, STANDBY)


def handed_over(rows, changes=1, gap_us=SENT_EVERY_US):
    sent = [SentCommand(t_us, t_us) for t_us in (*range(0, 900_000, SENT_EVERY_US), *range(
        891_000 + gap_us, rows[-1].t_us, SENT_EVERY_US))]
    return [check.name for check in handover_checks(rows, sent, changes, JOINED_GAP_MS, rows[-1].t_us) if not check.ok]


def test_robot_that_drives_on_under_the_next_driver_passes():
    assert handed_over(circles(1, -1)) == handed_over(circles(1, -1, 1), 2) == []


@pytest.mark.parametrize(("rows", "failed"), [
    (circles(1, each=100), ["changes of the driver"]), (circles(1, -1, 1), ["no more changes"]),
    (circles(*[1, -1] * 50, each=2), ["no more changes"]),
    ([*circles(1, -1)[:60], *circles(1, -1, mps=0.0)[60:62], *circles(1, -1)[62:]], ["speed kept"]),
])
def test_robot_without_driver_or_with_two_is_found_in_the_motor_log(rows, failed):
    assert handed_over(rows) == failed


def test_robot_that_receives_no_command_for_a_while_is_found():
    assert handed_over(circles(1, -1), gap_us=170_000) == ["between two commands"]
    ended = handover_checks(circles(1, -1), commands(900_000), 1, JOINED_GAP_MS, 1_980_000)
    assert [check.name for check in ended if not check.ok] == ["between two commands"]


@pytest.mark.parametrize(("late_us", "code", "failed"), [
    (0, 0, []), (100_000, 0, ["commands beside the driver"]), (0, 1, ["exit code"]), (0, None, ["exit code"]),
])
def test_handover_with_two_drivers_or_an_error_is_found(monkeypatch, late_us, code, failed):
    rows, times = circles(1, -1, 1), range(0, 2_960_000, SENT_EVERY_US)
    second = [one for one in map(SentCommand, times, times) if 1_000_000 <= one.t_us < 2_000_000]
    first = [one for one in map(SentCommand, times, times) if not 1_000_000 + late_us <= one.t_us < 2_000_000]
    clock = iter([0, 2_000_000, 2_500_000, rows[-1].t_us])
    monkeypatch.setattr(drivers, "monotonic_us", lambda: next(clock))
    processes = SimpleNamespace(wait_line=lambda *_: None, signal=lambda *_: None, exit_code=lambda *_: code)
    rig = SimpleNamespace(
        processes=processes, start_peer=lambda *_, **__: None, watch=lambda _: None, until=lambda *_: None,
        motors=lambda: rows, sent=lambda name="": {"peer": first, "second": second}.get(name, sorted(
            [*first, *second], key=lambda one: one.t_us)),
    )
    [case] = chosen(["token.handover"], short=False)
    assert [check.name for check in case.inject(rig).checks if not check.ok] == failed


def test_driver_repeats_its_last_twist_and_sends_newer_ones_only_after_its_token_ended():
    done, frames = [], iter(["frame"])
    script = SimpleNamespace(
        sent=["first", "last"], withdraw=lambda: done.append("ended"), replay=done.append, attack=done.append,
        answer=lambda frame: f"answer to {frame}", frame=lambda: next(frames),
    )
    with pytest.raises(RuntimeError):  # no more frames
        ATTACKS["after_token"](script)
    assert done == ["ended", "last", "answer to frame"]


def test_rows_have_unique_names_and_state_their_bounds():
    assert len({row.id for row in CASES}) == len(CASES) == len({row.what for row in CASES})
    assert all(row.demanded and row.id.count(".") == 1 and "|" not in row.what + row.demanded for row in CASES)
    assert all(row.setup.fault in ATTACKS for row in CASES if row.setup.driver == "driver" and row.setup.fault)
    assert 6 <= sum(row.short for row in CASES) < len(CASES)


def test_row_that_counts_from_the_start_of_a_process_runs_alone():
    counted = [row for row in CASES if re.search(r"after (the|its) start", row.also)]
    assert len(counted) == 7 and all(row.alone for row in counted)


def test_rows_are_chosen_by_id_group_and_length():
    assert [row.id for row in chosen(["vision.kill"], short=False)] == ["vision.kill"]
    assert {row.id.partition(".")[0] for row in chosen(["wire", "stop"], short=False)} == {"wire", "stop"}
    assert all(row.short for row in chosen([], short=True))
    with pytest.raises(ConfigError, match=r"did you mean 'vision\.kill'"):
        chosen(["vison.kill"], short=False)
    assert all(row.short for row in chosen(["vision"], short=True)), "each name has a short row"
    with pytest.raises(ConfigError, match=r"unknown fault of the short set 'stop\.lossy'"):
        chosen(["vision", "stop.lossy"], short=True)


@pytest.mark.parametrize(
    "bad", [outcome(value=3.0), outcome(value=None), outcome(trouble="inconclusive"), outcome(checks=())]
)
def test_one_bad_run_fails_everything(bad):
    assert passed([[outcome()], [outcome(), outcome()]])
    assert not passed([[outcome()], [outcome(), bad]])
    assert "FAIL" in run_line(bad) and to_dict([[bad]])["ok"] is False


def record(results):
    return {"command": "sightline faults", "machine": ["CPU: one"], "again": [], **to_dict(results)}


def test_skipped_rows_are_listed_and_do_not_pass():
    skipped = outcome(skipped="needs root", checks=())
    assert passed([[skipped], [outcome()]]) and not passed([[skipped]])
    assert "needs root" in run_line(skipped) and "needs root" in report_page(record([[skipped]]))


@given(st.lists(st.one_of(st.none(), st.integers(0, 1000).map(lambda ms: ms / 100)), min_size=1, max_size=6))
def test_the_worst_run_is_reported(values):
    (worst,) = worst_checks(outcome(value=value).checks for value in values)
    expected = None if None in values else max(values)
    assert worst.value == expected


def test_failure_outranks_a_larger_figure_and_less_injection_is_worse():
    few, many = (FaultOutcome(CASES[0], (Check("injected", value, "times", 1, value >= 1),)) for value in (1.0, 50.0))
    assert worst_checks([many.checks, few.checks])[0].value == 1.0


def test_the_report_is_one_object_and_one_table():
    results = [[outcome(), outcome(value=1.5)], [outcome(CASES[1], value=3.0)]]
    report = json.loads(json.dumps(to_dict(results)))
    assert [check["value"] for check in report["checks"]] == [1.5, 3.0]
    assert [row["ok"] for row in report["rows"]] == [True, False]
    text = report_page(record(results))
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    assert len(rows) == 1 + len(results) and {line.count("|") for line in rows} == {6}
    assert "| yes |" in rows[1] and "**no**" in rows[2] and "1 of 2 rows passed" in text


def test_the_machine_is_described_without_naming_it():
    text = " ".join(describe_machine())
    assert "Python 3" in text and "cores" in text and "/" not in text.replace("x86_64", "")


def test_the_machine_is_described_with_the_date_of_the_measurement():
    before = datetime.now(UTC).date()
    (shown,) = re.findall(r"\d{4}-\d\d-\d\d", describe_machine()[0])
    assert before <= date.fromisoformat(shown) <= datetime.now(UTC).date()


def test_the_command_lists(capsys):
    app = typer.Typer()
    cli_faults.register(app)
    app.callback()(lambda: None)
    assert app(["faults", "--list", "--only", "stop"], standalone_mode=False) == 0
    assert len(capsys.readouterr().out.splitlines()) == sum(row.id.startswith("stop.") for row in CASES)


# --- the rows themselves -----------------------------------------------------------------------------------------


def run_once(row, tmp_path):
    done = run_case(row, tmp_path)
    if done.skipped:
        pytest.skip(done.skipped)
    assert done.ok, run_line(done)
    assert all(check.value is not None and math.isfinite(check.value) for check in done.checks)


def by_tier(rows):
    """Put the rows that compute for more than 1.5 s into the second tier, one at a time: beside other tests on a slow
    machine, the sampler of a row's stop stalled three times in a row."""
    costly = {"command.flood", "command.heartbeat", "command.replay", "camera.frozen", "stop.driving", "wire.cut3",
              "end.sigterm", "network.kill", "network.gil", "vision.hangs", "vision.kill", "flood.tls25",
              "flood.tcp500", "camera.hangs", "drive.raises", "drive.refuses", "guardian.driver_kill"}
    assert costly <= {row.id for row in rows}
    return [pytest.param(row, marks=pytest.mark.alone if row.id in costly else (), id=row.id) for row in rows]


@pytest.mark.parametrize("row", by_tier(chosen([], short=True)))
def test_the_short_set(row, tmp_path):
    run_once(row, tmp_path)


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("row", [row for row in CASES if not row.short], ids=lambda row: row.id)
def test_the_long_set(row, tmp_path):
    run_once(row, tmp_path)

