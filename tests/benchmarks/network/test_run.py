"""`sightline bench network`: its rows, its figures, its error without root; one real row where it can run."""

import json
import subprocess
import sys

import pytest

from sightline.benchmarks.loop.figures import WheelCommand
from sightline.benchmarks.network.cases import CASES, NetworkCase, chosen, spans_s
from sightline.benchmarks.network.figures import (
    Stretch,
    figures_of,
    injected_checks,
    network_checks,
    sent_between,
    worst_of_seeds,
)
from sightline.benchmarks.network.run import SCENES, write_film
from sightline.benchmarks.network.stage import NetworkSetting
from sightline.evaluation.checks import Check, at_most
from sightline.evaluation.processes import SIGHTLINE
from sightline.protocol.errors import ConfigError
from sightline.sim.network_emulator import EmulatedLink, LinkShape, LinkShapes
from sightline.sim.tun_emulator import why_impossible

SECOND_US = 1_000_000
COMMAND = [*SIGHTLINE, "bench", "network"]


def status(at_s, state="ACTIVE", accepted=0, stale=0, age_ms=50, sent=0):
    return [round(at_s * SECOND_US), state, age_ms * 1000, accepted, stale, 2, 0, 0.4, 80, 100, sent]


def frames(*latencies_ms, begin_s=0.0):
    return [
        [number, round((begin_s + number / 30) * SECOND_US), None if ms is None else ms * 1000 + number, 20_000]
        for number, ms in enumerate(latencies_ms)
    ]


def seen(frame_rows=(), statuses=(), end_s=10.0, judged_s=0.0, rad_s=1.0):
    stretch = Stretch(0, round(judged_s * SECOND_US), round(end_s * SECOND_US))
    wheels = [WheelCommand(t_us, rad_s, rad_s) for t_us in range(0, 10 * SECOND_US, 1000)]
    return figures_of({"frames": list(frame_rows), "statuses": list(statuses)}, wheels, stretch)


# --- rows --------------------------------------------------------------------------------------------------------


def test_every_row_harms_packets_and_demands_something():
    for row in CASES:
        assert any(leg != LinkShape() for phase in row.phases for leg in (phase.shapes.ab, phase.shapes.ba)), row.name
        demanded = (row.least_fps, row.p50_ms, row.p95_ms, row.over_first_ms, row.flows_again_s)
        assert row.scene or any(bound is not None for bound in demanded), row.name


@pytest.mark.parametrize(("name", "kinds"), [
    ("cut", {"delayed", "cut"}), ("radio", {"delayed", "lost"}), ("bursts", {"delayed", "lost"}), ("thin", {"delayed"}),
])
def test_every_effect_that_a_row_requests_must_have_harmed_packets(name, kinds):
    row = next(one for one in CASES if one.name == name)
    both_harmed = dict.fromkeys(("ab", "ba"), dict.fromkeys(kinds, 1))
    assert [check.ok for check in injected_checks(row, both_harmed)] == [True] * len(kinds)
    only_delayed = {"ab": {"delayed": 1000}, "ba": {"delayed": 1000}}
    failed = [check.name for check in injected_checks(row, only_delayed) if not check.ok]
    assert failed == [f"packets {kind}" for kind in ("lost", "cut") if kind in kinds]


@pytest.mark.parametrize(("name", "failed"), [
    ("rtt40", ["delayed"]), ("radio", ["delayed", "lost"]), ("bursts", ["delayed"]), ("cut", ["delayed"]),
])
@pytest.mark.parametrize("harmed", ["ab", "ba"])
def test_effect_each_way_must_harm_packets_in_both_directions(name, failed, harmed):
    row = next(one for one in CASES if one.name == name)
    counts = {"ab": {}, "ba": {}, harmed: {"delayed": 1000, "lost": 1000, "cut": 1000}}
    found = [check.name for check in injected_checks(row, counts) if not check.ok]
    assert found == [f"packets {kind}" for kind in failed]


def test_every_scene_that_a_row_names_is_there():
    assert {row.scene for row in CASES if row.scene} == {*SCENES, "medium"}


def test_rows_are_chosen_by_name():
    assert [row.name for row in chosen(["rtt40", "cut"])] == ["rtt40", "cut"]
    assert chosen([]) == CASES
    with pytest.raises(ConfigError, match="unknown --only 'rtt4' over zenoh; known: rtt40"):
        chosen(["rtt4"])


def test_rows_with_a_router_are_not_offered_over_websocket():
    names = [row.name for row in chosen([], "websocket")]
    assert "radio" in names and "standby" in names and "router" not in names
    with pytest.raises(ConfigError, match="unknown --only 'router' over websocket"):
        chosen(["router"], "websocket")


def test_only_rows_where_packets_are_lost_differ_by_seed():
    assert [row.name for row in CASES if row.draws] == ["radio", "bursts"]


def test_phases_without_a_length_share_the_time():
    cut = next(row for row in CASES if row.name == "cut")
    assert spans_s(cut, 20.0) == [10.0, 5.0, 10.0]


@pytest.mark.parametrize("changes", [{"transport": "smoke"}, {"seconds": 1.0}, {"seeds": ()}])
def test_a_setting_that_cannot_be_run_is_rejected(changes):
    with pytest.raises(ConfigError):
        NetworkSetting(**changes)


def test_a_seed_makes_the_wire_lose_the_same_packets_again():
    def lost(seed):
        wire = EmulatedLink()
        wire.shape(LinkShapes(ab=LinkShape(loss=0.3), seed=seed))
        for number in range(200):
            wire.ab.put(bytes(40) + bytes([number]), number)
        return [packet[-1] for packet in wire.ab.take_due(10**9)]

    assert lost(1) == lost(1) != lost(2)


# --- figures -----------------------------------------------------------------------------------------------------


def test_ages_come_from_accepted_commands_and_late_ones_count_as_infinite():
    rows = frames(None, 40, 41, 42, 43)
    found = seen(rows, [status(0), status(10)])
    assert found.p50_ms == pytest.approx(42.5, abs=0.5), "the wheels follow each millisecond"
    assert found.validated_ms == pytest.approx(41.5, abs=0.51)
    late = seen(rows, [status(0), status(9.9, stale=100)])
    assert late.p50_ms == float("inf")
    assert seen(rows[:1], [status(0), status(10)]).p50_ms is None


def test_frame_answered_by_two_twists_counts_once():
    """A link loses every second frame. Vision sends each twist twice then, and the robot accepts both."""
    rows = [[seq, seq * 33_333, 4_000 + (seq - 1) // 2, 20_000] for seq in range(300)]
    found = seen(rows, [status(n / 10, accepted=n * 3) for n in range(101)])
    assert found.fps == pytest.approx(15, rel=0.02)
    between = [[0, 0, None, 1], [1, 33_333, None, 1], [2, 50_050, 50_000, 1], [3, 83_000, 50_100, 1]]
    assert seen(between).fps == 0.1, "a header that left between the two"


def test_wheels_that_never_turn_give_no_ages_and_no_rate():
    rows = frames(None, *range(40, 340))
    dead = seen(rows, [status(0), status(10, accepted=300)], rad_s=0.0)
    assert (dead.p50_ms, dead.p95_ms, dead.validated_ms, dead.fps, dead.moving_percent) == (None, None, None, 0.0, 0.0)
    assert seen(rows, [status(0), status(10)]).moving_percent == 100


@pytest.mark.parametrize("row", [row for row in CASES if not row.scene], ids=lambda row: row.name)
def test_robot_that_only_stands_and_answers_a_frame_in_ten_seconds_passes_no_row(row):
    rows = [[seq, seq * SECOND_US, 40_000 + seq, 20_000] for seq in range(0, 11, 10)]
    standing = seen(rows, [status(n / 10, "HOLD") for n in range(101)], rad_s=0.0)
    failed = [check.name for check in network_checks(row, [standing] * len(row.phases)) if not check.ok]
    assert "wheels move" in failed
    assert row.flows_again_s is not None or "answered" in failed


def test_constant_latency_changes_nothing():
    same = [[number, number * 33_333, 40_000, 1] for number in range(10)]
    assert seen(same).p50_ms is None


def test_rate_and_oldest_executed_are_of_the_scored_time_only():
    statuses = [status(1, age_ms=900), *(status(2 + n / 10) for n in range(81))]
    figures = seen(frames(*(40 + n % 10 for n in range(300))), statuses, judged_s=2.0)
    assert figures.fps == pytest.approx(30, rel=0.02) and figures.executed_ms == 50
    half = seen(frames(*(40 + n % 10 for n in range(150))), statuses, judged_s=2.0)
    assert half.fps == pytest.approx(30 * 3 / 8, rel=0.05), "150 frames take 5 s"
    held = [status(3, "HOLD", age_ms=800)]
    assert seen((), statuses + held, judged_s=2.0).executed_ms == 50, "held is not driven"


def test_holds_are_counted_after_driving_and_to_the_end():
    states = ["HOLD", "ACTIVE", "HOLD", "HOLD", "ACTIVE", "DEGRADED", "HOLD", "HOLD"]
    figures = seen((), [status(number / 10, state) for number, state in enumerate(states)])
    assert figures.holds_s == pytest.approx((0.2, 0.1))


def test_flowing_again_is_the_first_acceptance_of_a_frame_of_the_stretch():
    rows = frames(30, 30, begin_s=-1.0) + frames(30, 31, begin_s=0.4)
    assert seen(rows).flows_after_s == pytest.approx(0.433, abs=0.01)
    assert seen(frames(30, begin_s=-1.0)).flows_after_s is None


def test_a_bound_that_is_broken_is_not_ok_and_none_is_never_ok():
    row = NetworkCase("x", "x", CASES[0].phases, least_fps=28, p50_ms=55, p95_ms=60, flows_again_s=1, most_holds=0)
    good = network_checks(row, [seen(frames(*(40 + n % 10 for n in range(295))), [status(0), status(9.9)])])
    assert all(check.ok for check in good)
    standing = seen((), [status(0), status(1, "HOLD"), status(2)], rad_s=0.0)
    bad = {check.name: check.ok for check in network_checks(row, [standing])}
    assert bad == {
        "age p50": False, "age p95": False, "answered": False, "holds": False, "flows again": False,
        "wheels move": False, "oldest executed": True,
    }


def test_phase_without_a_status_fails_although_it_shows_no_hold():
    row = NetworkCase("x", "x", CASES[0].phases, most_holds=0)
    driven = seen(frames(*(40 + n % 10 for n in range(295))), [status(0), status(9.9)])
    for phases, ok in (([driven, driven], True), ([driven, seen()], False), ([seen(), driven], False)):
        checks = {check.name: check.ok for check in network_checks(row, phases)}
        assert checks == {"holds": True, "wheels move": True, "oldest executed": ok}


def test_the_worst_seed_of_each_demand_is_shown():
    def answered(fps):
        return Check("answered", fps, "fps", 12.0, fps >= 12)

    runs = [(at_most("age", age_ms, "ms", 160), answered(fps)) for age_ms, fps in ((90, 20), (110, 14), (80, 30))]
    assert [(one.name, one.value, one.ok) for one in worst_of_seeds("radio", runs)] == [
        ("radio, worst of 3 seeds: age", 110, True), ("radio, worst of 3 seeds: answered", 14, True),
    ]
    runs += [(at_most("age", 170, "ms", 160), answered(8)), (at_most("age", None, "ms", 160), answered(11))]
    assert [(one.value, one.ok) for one in worst_of_seeds("radio", runs)] == [(None, False), (8, False)]
    assert worst_of_seeds("near", runs[:1])[0].name == "near: age"


def test_frames_sent_are_counted_between_statuses():
    counts = [status(number / 10, sent=3 * number) for number in range(101)]
    assert sent_between(counts, 1_050_000, 6_050_000) == pytest.approx(150)
    assert sent_between(counts, -1, 20 * SECOND_US) == 300 and sent_between([], 0, 1) == 0


def test_the_film_is_recorded_pictures(tmp_path):
    assert write_film(tmp_path).stat().st_size > 100_000


# --- the command -------------------------------------------------------------------------------------------------


def test_an_unknown_row_is_one_line(tmp_path):
    done = subprocess.run([*COMMAND, "--only", "moon"], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "known: rtt40" in done.stderr and "Traceback" not in done.stderr


def test_network_bench_without_root_names_its_requirements():
    # A root that becomes another user keeps root's access to files, since the checkout may lie in root's home.
    drop = (
        "import ctypes, os, sys; "
        "os.geteuid() or (os.setresuid(65534, 65534, 0), ctypes.CDLL(None).setfsuid(0)); "
        "from sightline.operator_side.cli.app import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", drop, "bench", "network", "--only", "rtt40"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "run it as root on Linux" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(bool(why_impossible()), reason=f"{why_impossible()}; run the tests as root with /dev/net/tun")
def test_short_network_row_runs_with_real_processes():
    command = [*COMMAND, "--only", "near", "--seconds", "4", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    told = json.loads(done.stdout)
    names = [check["name"] for check in told["checks"]]
    assert "near: packets delayed" in names and told["rows"][0]["injected"] > 100
    assert done.returncode == (0 if told["ok"] else 5), done.stderr
