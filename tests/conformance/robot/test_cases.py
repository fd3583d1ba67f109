"""The kit against our own robot in virtual time, and its own parts. tests/conformance/mutants runs the broken ones."""

import itertools
from dataclasses import replace

import pytest

from sightline.conformance.case import GROUPS, KEPT_MESSAGES, Case, Level, Suite
from sightline.conformance.report import summary
from sightline.conformance.robot.cases import CASES, prepare
from sightline.conformance.runner import Outcome, chosen, passed, run_case, run_cases, untested
from sightline.protocol import proof
from sightline.protocol.channels import STATUS
from sightline.protocol.errors import CLAMPED, ConfigError
from sightline.protocol.transports.memory import MemoryNetwork
from sightline.robot_side.network.core import NetworkCore
from sightline.robot_side.network.stream import StreamConfig
from tests.conformance.clauses import clauses
from tests.conformance.robot import reference
from tests.conformance.robot.broken import arming as broken_arming
from tests.conformance.robot.broken import credit as broken_credit
from tests.conformance.robot.broken import lease as broken_lease
from tests.conformance.robot.broken import motion as broken_motion
from tests.conformance.robot.broken import order as broken_order
from tests.conformance.robot.broken.breaking import bend_out, fields_of, wrap
from tests.conformance.robot.reference import KEYED, virtual_robot

pytestmark = pytest.mark.computes

VIRTUAL = [case for case in CASES if not case.real]
NAMES = [case.id for case in VIRTUAL]
CASES_BY_ID = dict(zip(NAMES, VIRTUAL, strict=True))


def result_of(case, break_it=None):
    bench, _robot = virtual_robot(break_it, keys=case.id in KEYED)
    return run_case(case, bench, prepare)


# --- our robot, and broken ones --------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", VIRTUAL, ids=NAMES)
def test_our_robot_passes(case):
    result = result_of(case)
    assert result.outcome is Outcome.PASSED, result.reason


@pytest.mark.parametrize("cases", [VIRTUAL[::8], pytest.param(VIRTUAL, marks=pytest.mark.slow)], ids=["some", "all"])
def test_one_robot_passes_cases_in_a_row(cases):
    bench, _robot = virtual_robot()
    results = run_cases(cases, bench, prepare)
    assert {one.case.id: one.reason for one in results if one.outcome is Outcome.FAILED} == {}
    assert {one.case.id for one in results if one.outcome is Outcome.SKIPPED} <= set(KEYED)


def test_a_robot_without_guests_passes_what_applies():
    for case in VIRTUAL:
        if case.id.startswith("R-DIAL"):
            bench, _robot = virtual_robot(guests=False)
            assert run_case(case, bench, prepare).outcome is not Outcome.FAILED, case.id


def test_robot_slower_than_the_usual_twist_of_the_kit_passes():
    bench, _robot = virtual_robot(max_linear_mps=0.08)
    results = run_cases([case for case in VIRTUAL if case.id in ("R-LIM-01", "R-LIM-08")], bench, prepare)
    assert [one.reason for one in results if one.outcome is not Outcome.PASSED] == []


def _two_lines(robot, channel, *path):
    def bend(_header, payload):
        for name in path[:-1]:
            payload = payload.get(name) or {}
        if path[-1] in payload:
            payload[path[-1]] += "\nmore"

    bend_out(robot, channel, bend)


@pytest.mark.parametrize("path", [("status", "last_refusal", "detail"), ("reply", "detail")], ids="-".join)
def test_robot_with_a_text_of_two_lines_fails(path):
    assert result_of(CASES_BY_ID["R-STAT-13"], lambda robot: _two_lines(robot, *path)).outcome is Outcome.FAILED


def test_robot_that_shows_a_reduced_command_as_a_rejection_fails():
    def bend(_header, payload):
        if payload["refused"].get(CLAMPED):
            payload["last_refusal"] = {"source": "vision", "reason": CLAMPED, "detail": "48 m/s is too fast"}

    result = result_of(CASES_BY_ID["R-LIM-05"], lambda robot: bend_out(robot, "status", bend))
    assert (result.outcome, "last_refusal" in result.reason) == (Outcome.FAILED, True), result.reason


@pytest.mark.parametrize(("name", "channel", "fields"), [
    ("R-FRAM-03", "reply", {"session": "0badf00d"}), ("R-SEQ-04", "reply", {"seq": 0}),
    ("R-SEQ-05", "odometry", {"t_us": 1}), ("R-SEQ-05", "camera", {"t_us": 0}), ("R-SEQ-05", "reply", {"t_us": 2**40})])
def test_robot_with_a_wrong_stamp_on_one_channel_fails(name, channel, fields):
    def bend(header, _payload):
        header.update(fields)

    result = result_of(CASES_BY_ID[name], lambda robot: bend_out(robot, channel, bend))
    assert result.outcome is Outcome.FAILED, result.reason


@pytest.mark.parametrize("pose", [lambda x, y, yaw: [0, 0, 0], lambda x, y, yaw: [x, y, 57.3 * yaw]])
@pytest.mark.parametrize("channel", ["frame", "odometry"])
def test_robot_whose_frames_have_another_pose_than_its_odometry_fails(channel, pose):
    def bend(header, payload):
        fields = header if channel == "frame" else payload
        fields["pose"] = pose(*fields["pose"])

    result = result_of(CASES_BY_ID["R-LIM-08"], lambda robot: bend_out(robot, channel, bend))
    assert result.outcome is Outcome.FAILED, result.reason


@pytest.mark.parametrize("reason", ["OUT_OF_ORDER", "STALE"])
def test_robot_whose_lease_a_rejected_command_renews_fails(reason):
    def renews(robot):
        def around(inner, source, error):
            holder = robot.driving.gate.holder(robot.now())
            if error.reason == reason and holder is not None:
                robot.driving.gate._lease.expires_us = robot.now() + 1_000_000
            return inner(source, error)

        wrap(robot.driving.gate, "reject", around)

    assert result_of(CASES_BY_ID["R-LEASE-06"], renews).outcome is Outcome.FAILED


@pytest.mark.parametrize("age_ms", [400, 700, 950])
def test_robot_that_accepts_older_frames_passes_the_case_about_rejected_twists(age_ms):
    limits = {"zero_speed_age_ms": age_ms, "silence_ms": 250, "max_linear_mps": 0.15, "max_angular_rad_s": 1.0}
    bench, _robot = virtual_robot(**limits)
    result = run_case(CASES_BY_ID["R-LEASE-06"], bench, prepare)
    assert result.outcome is Outcome.PASSED, result.reason


def test_robot_that_counts_accepted_commands_again_after_a_stop_fails():
    def bend(_header, payload):
        payload["accepted"] = 0 if payload["state"] in ("STOPPED", "DISARMED") else payload["accepted"]

    result = result_of(CASES_BY_ID["R-STAT-11"], lambda robot: bend_out(robot, "status", bend))
    assert (result.outcome, "accepted" in result.reason) == (Outcome.FAILED, True), result.reason


@pytest.mark.parametrize(("hashes", "outcome"), [(63, Outcome.FAILED), (64, Outcome.PASSED)])
def test_robot_that_hashes_a_proof_less_than_64_times_fails(monkeypatch, hashes, outcome):
    monkeypatch.setattr(proof, "MAX_LOST", hashes)
    assert result_of(CASES_BY_ID["R-PROOF-05"]).outcome is outcome


def one_frame_in(count, break_it=None):
    """The robot films only one of `count` pictures of its camera, which takes 30 a second."""

    def film_rarely(robot):
        film, ticks = robot.film, itertools.count()
        robot.film = lambda now_us: None if next(ticks) % count else film(now_us)
        if break_it is not None:
            break_it(robot)

    return film_rarely


@pytest.mark.parametrize("name", ["R-ARM-03", "R-ARM-16"])
def test_robot_below_ten_frames_a_second_passes(name):
    result = result_of(CASES_BY_ID[name], one_frame_in(4))
    assert result.outcome is Outcome.PASSED, result.reason


@pytest.mark.parametrize(("count", "found"), [(8, Outcome.FAILED), (12, Outcome.SKIPPED)])
def test_robot_of_few_frames_that_arms_from_before_a_human_let_go_does_not_pass(count, found):
    break_it = one_frame_in(count, broken_arming.arms_from_before_a_human_let_go)
    assert result_of(CASES_BY_ID["R-ARM-16"], break_it).outcome is found


RATES = {
    "R-SEQ-12": {1: Outcome.PASSED, 5: Outcome.PASSED, 12: Outcome.PASSED},
    "R-FLOW-08": {9: Outcome.SKIPPED, 12: Outcome.SKIPPED, 18: Outcome.PASSED},
    "R-FLOW-05": {3: Outcome.PASSED},
    "R-ARM-04": {3: Outcome.PASSED},
    "R-STOP-14": {2: Outcome.SKIPPED, 3: Outcome.PASSED, 7: Outcome.PASSED},
    **{f"R-FLOW-{number}": {2.6: Outcome.PASSED} for number in ("09", "10", "12")},
    "R-FRAM-12": {2.6: Outcome.SKIPPED, 3: Outcome.PASSED},
    "R-LIM-01": {2.7: Outcome.SKIPPED, 3: Outcome.PASSED},
    "R-LIM-06": {3: Outcome.SKIPPED, 5: Outcome.PASSED},
    "R-LIM-07": {5: Outcome.PASSED, 7: Outcome.PASSED},
    "R-LEASE-02": {1: Outcome.SKIPPED, 2: Outcome.PASSED},
    "R-LEASE-05": {2: Outcome.SKIPPED, 3: Outcome.PASSED},
    "R-LEASE-10": {1: Outcome.SKIPPED},
    "R-LEASE-16": {2: Outcome.PASSED},
    "R-LEASE-23": {1: Outcome.SKIPPED},
    **{f"R-PROOF-0{number}": {1: Outcome.SKIPPED, 2: Outcome.PASSED} for number in (1, 2, 3, 4, 9)},
}
"""Case -> camera rate in 1/s -> the outcome at our robot, where a case needs frames at some rate."""


@pytest.mark.parametrize(("name", "fps"), [(name, fps) for name, rates in RATES.items() for fps in rates])
def test_robot_with_a_slow_camera_passes_or_is_left(monkeypatch, name, fps):
    monkeypatch.setattr(reference, "CAMERA_US", 1e6 / fps)
    result = result_of(CASES_BY_ID[name])
    assert result.outcome is RATES[name][fps], result.reason


@pytest.mark.slow
@pytest.mark.parametrize("fps", [1, 2, 3, 5, 7, 9, 10, 12, 14, 15, 18, 24, 60, 120, 240])
def test_robot_with_any_camera_fails_no_case(monkeypatch, fps):
    monkeypatch.setattr(reference, "CAMERA_US", 1e6 / fps)
    results = {case.id: result_of(case) for case in VIRTUAL}
    assert {name: one.reason for name, one in results.items() if one.outcome is Outcome.FAILED} == {}
    assert {one.case.id: one.reason for one in untested(list(results.values()))} == {}


@pytest.mark.parametrize("fps", [120, 240])
def test_robot_with_a_fast_camera_widens_its_window_on_a_long_link(monkeypatch, fps):
    monkeypatch.setattr(reference, "CAMERA_US", 1e6 / fps)

    def streams_all(robot):
        robot.sending = NetworkCore(StreamConfig(max_fps=fps), "00000001", 0, robot.config.max_frame_bytes)

    result = result_of(CASES_BY_ID["R-FLOW-07"], streams_all)
    assert result.outcome is Outcome.PASSED, result.reason


def over_link(monkeypatch, delay_us):
    monkeypatch.setattr(reference, "MemoryNetwork", lambda: MemoryNetwork(delay_us=delay_us))


@pytest.mark.parametrize("delay_us", [80_000, 150_000])
@pytest.mark.parametrize("name", ["R-CAUS-10", "R-CAUS-15", "R-FLOW-04", "R-FLOW-07", "R-FLOW-08", "R-FLOW-14",
                                  "R-FRAM-13", "R-HOST-06", "R-HOST-10", "R-LEASE-06", "R-LEASE-14", "R-LEASE-31",
                                  "R-LIM-08", "R-RECO-04", "R-SEQ-12", "R-STAT-01", "R-STAT-03", "R-STAT-11"])
def test_our_robot_passes_over_a_slow_link(monkeypatch, name, delay_us):
    over_link(monkeypatch, delay_us)
    result = result_of(CASES_BY_ID[name])
    assert result.outcome is Outcome.PASSED, result.reason


@pytest.mark.parametrize(("delay_us", "outcome"), [(90_000, Outcome.PASSED), (200_000, Outcome.SKIPPED)])
@pytest.mark.parametrize("name", ["R-SIL-05", "R-SIL-14"])
def test_case_about_age_is_not_applicable_where_the_link_alone_slows_the_robot(monkeypatch, name, delay_us, outcome):
    over_link(monkeypatch, delay_us)
    result = result_of(CASES_BY_ID[name])
    assert result.outcome is outcome, result.reason


@pytest.mark.parametrize("cases", [VIRTUAL[::8], pytest.param(VIRTUAL, marks=pytest.mark.slow)], ids=["some", "all"])
@pytest.mark.parametrize("delay_us", [120_000, 200_000, 250_000, 300_000])
def test_our_robot_conforms_over_a_slow_link(monkeypatch, delay_us, cases):
    over_link(monkeypatch, delay_us)
    results = {case.id: result_of(case) for case in cases}
    assert {name: one.reason for name, one in results.items() if one.outcome is Outcome.FAILED} == {}
    assert {one.case.id: one.reason for one in untested(list(results.values()))} == {}


@pytest.mark.parametrize("delay_us", [80_000, 150_000])
@pytest.mark.parametrize(("name", "break_it"), [
    ("R-CAUS-15", broken_order.one_twist_for_a_frame), ("R-LEASE-14", broken_lease.acquire_renews),
    ("R-HOST-10", broken_credit.forgets_who_drives_when_many_come)])
def test_broken_robot_fails_over_a_slow_link(monkeypatch, name, break_it, delay_us):
    over_link(monkeypatch, delay_us)
    assert result_of(CASES_BY_ID[name], break_it).outcome is Outcome.FAILED


@pytest.mark.parametrize(("reply_us", "link_us"), [(20_000, 0), (200_000, 150_000), (900_000, 300_000), (None, 0)])
def test_robot_that_replies_late_gets_a_bounded_time(monkeypatch, reply_us, link_us):
    def replies_late(robot):
        def around(inner, message):
            if reply_us is not None:
                bench.after(reply_us, lambda: inner(message))

        wrap(robot, "on_request", around)

    bench, _robot = virtual_robot(replies_late)
    prepare(bench)
    assert link_us <= bench.link_us <= link_us + 30_000


@pytest.mark.parametrize(("joins_after_us", "outcome"), [(200_000, Outcome.PASSED), (900_000, Outcome.SKIPPED)])
def test_lease_that_ended_while_the_kit_connected_again_is_not_a_failure(monkeypatch, joins_after_us, outcome):
    bench, _robot = virtual_robot()
    join = bench.join
    monkeypatch.setattr(bench, "join", lambda: bench.rest(joins_after_us) or join())
    result = run_case(CASES_BY_ID["R-RECO-04"], bench, prepare)
    assert result.outcome is outcome, result.reason


def test_robot_that_counts_no_twist_of_a_second_driver_fails():
    def drops_others(robot):
        on_twist, sessions = robot.on_twist, set()

        def of_the_first(message):
            sessions.add(fields_of(message.header)["session"])
            if len(sessions) == 1:
                on_twist(message)

        robot.on_twist = of_the_first

    result = result_of(CASES_BY_ID["R-LEASE-02"], drops_others)
    assert result.outcome is Outcome.FAILED, result.reason


def test_rejected_reset_may_be_counted_in_a_later_status():
    def reports_late(robot):
        emit, waiting = robot.emit, []

        def one_status_late(message):
            if message.channel is STATUS:
                waiting.append(message)
                message = waiting.pop(0) if len(waiting) > 1 else None
            if message is not None:
                emit(message)

        robot.emit = one_status_late

    result = result_of(CASES_BY_ID["R-STOP-15"], reports_late)
    assert result.outcome is Outcome.PASSED, result.reason


@pytest.mark.parametrize("break_it", broken_motion.LIARS, ids=lambda break_it: break_it.__name__)
def test_robot_whose_wheels_differ_from_its_status_fails(break_it):
    bench, _robot = virtual_robot(break_it)
    found = broken_motion.LIARS[break_it]
    results = run_cases([case for case in VIRTUAL if case.id in found], bench, prepare)
    assert {one.case.id for one in results if one.outcome is Outcome.FAILED} == set(found)
    assert not passed(results)


def test_coasting_robot_fails_nineteen_of_the_cases_about_stopping():
    bench, _robot = virtual_robot(broken_motion.coasts)
    results = run_cases([case for case in VIRTUAL if case.group in ("arming", "stop", "silence")], bench, prepare)
    failed = [one.case.id for one in results if one.outcome is Outcome.FAILED]
    assert (len(results), len(failed)) == (57, 19), failed


def test_a_dead_robot_fails_everything():
    bench, robot = virtual_robot()
    robot.tick = lambda now_us: None
    assert {one.outcome for one in run_cases(VIRTUAL[:20], bench, prepare)} == {Outcome.FAILED}


# --- the cases themselves --------------------------------------------------------------------------------------------


def test_there_are_enough_and_each_is_of_a_clause():
    assert len(CASES) >= 60
    assert {case.clause for case in CASES} <= set(clauses())
    assert all(len(case.title) > 15 and case.title.endswith(".") for case in CASES)
    assert {case.group for case in CASES} >= {
        "framing", "causality", "sequence", "limits", "lease", "stop", "flow", "legacy clients", "hostile input",
        "reconnect",
    }  # fmt: skip


def test_a_case_needs_a_good_id():
    suite = Suite("R")

    def run(_bench):
        """A title."""

    for bad in ("R-NONE-01", "V-CAUS-01", "R-CAUS", "R-CAUS-x"):
        with pytest.raises(ValueError, match="R-GROUP-NN"):
            suite.must(bad, "Headers")(run)
    suite.must("R-CAUS-01", "Headers")(run)
    with pytest.raises(ValueError, match="twice"):
        suite.should("R-CAUS-01", "Headers")(run)
    assert suite.cases == [Case("R-CAUS-01", Level.MUST, "Headers", "A title.", run)]


def test_cases_are_chosen_by_id_and_group():
    assert {case.group for case in chosen(CASES, groups=["lease"])} == {"lease"}
    assert [case.id for case in chosen(CASES, only=["r-stop-01"])] == ["R-STOP-01"]
    assert chosen(CASES, only=["R-STOP"], groups=["lease"]) == []
    with pytest.raises(ConfigError, match="no case begins so"):
        chosen(CASES, only=["R-NONE"])
    with pytest.raises(ConfigError, match="there are framing"):
        chosen(CASES, groups=["leases"])
    assert set(GROUPS.values()) >= {case.group for case in CASES}


# --- the runner and the bench ----------------------------------------------------------------------------------------


def outcome(run, level=Level.MUST):
    bench, _robot = virtual_robot()
    return run_case(Case("R-CAUS-99", level, "Headers", "A title.", run), bench)


def test_whatever_a_case_raises_is_a_result():
    assert outcome(lambda bench: bench.rest(1000)).outcome is Outcome.PASSED
    failed = outcome(lambda bench: bench.expect(False, "why"))
    assert (failed.outcome, failed.reason) == (Outcome.FAILED, "why")
    skipped = outcome(lambda bench: bench.need(False, "what"))
    assert (skipped.outcome, skipped.reason) == (Outcome.SKIPPED, "what")
    late = outcome(lambda bench: bench.expect_within(lambda: False, 30_000, "it never came"))
    assert (late.reason, late.took_us) == ("it never came (waited 0.03 s)", 30_000)
    assert outcome(lambda _bench: {}["x"]).reason == "KeyError: 'x'"


def test_case_with_a_second_try_reports_the_number_of_tries():
    bench, _robot = virtual_robot()
    runs = []

    def fails_once(bench):
        runs.append(bench.now_us)
        bench.expect(len(runs) > 1, "lost")

    case = Case("R-CAUS-99", Level.MUST, "Headers", "A title.", fails_once)
    once = run_cases([case], bench)
    runs.clear()
    twice = run_cases([case], bench, tries=2)
    assert [one.outcome for one in (*once, *twice)] == [Outcome.FAILED, Outcome.PASSED]
    assert twice[0].reason == "at try 2; before: lost"
    always = Case("R-CAUS-98", Level.MUST, "Headers", "A title.", lambda bench: bench.expect(False, "never"))
    assert run_cases([always], bench, tries=3)[0].reason == "never"
    runs.clear()

    def fails_then_lacks(bench):
        runs.append(bench.now_us)
        bench.expect(len(runs) > 1, "lost")
        bench.need(False, "gone")

    lacking = Case("R-CAUS-97", Level.MUST, "Headers", "A title.", fails_then_lacks)
    assert run_cases([lacking], bench, tries=2)[0].outcome is Outcome.FAILED


@pytest.mark.parametrize("tries", [2, 3])
def test_case_that_fails_again_reports_its_first_failure(tries):
    bench, _robot = virtual_robot()
    runs = []

    def leaves_wheels_turning(bench):
        runs.append(bench.now_us)
        bench.expect(False, "the wheels still turn" if len(runs) == 1 else "could not be brought to rest")

    case = Case("R-SIL-99", Level.MUST, "5.4 Silence", "A title.", leaves_wheels_turning)
    (result,) = run_cases([case], bench, tries=tries)
    assert (result.outcome, result.reason, len(runs)) == (Outcome.FAILED, "the wheels still turn", tries)


def test_a_peer_conforms_if_no_must_failed_and_something_was_tested():
    good, weak = outcome(lambda bench: None), outcome(lambda bench: bench.expect(False, "x"), Level.SHOULD)
    bad, nothing = outcome(lambda bench: bench.expect(False, "x")), outcome(lambda bench: bench.need(False, "x"))
    assert passed([good, weak, nothing])
    assert not passed([good, bad])
    assert not passed([nothing])
    assert not passed([])


def test_must_that_is_left_though_its_need_was_met_before_is_tried_again_and_does_not_conform():
    bench, _robot = virtual_robot()
    runs = []

    def lacks(bench):
        runs.append(bench.now_us)
        bench.need(len(runs) > most, "not armed (R-CAUS-99)")

    good = Case("R-CAUS-99", Level.MUST, "Headers", "A title.", lambda bench: None)
    weak = replace(good, level=Level.SHOULD)
    case = Case("R-CAUS-98", Level.MUST, "Headers", "A title.", lacks)
    most = 9
    assert passed(run_cases([case], bench, tries=3)) is False and len(runs) == 1
    assert passed(run_cases([weak, case], bench, tries=3)) is True and len(runs) == 2
    results = run_cases([good, case], bench, tries=3)
    assert not passed(results) and len(runs) == 5
    assert summary(results).endswith("; 1 MUST could not be tested, first R-CAUS-98: not armed (R-CAUS-99)")
    most = 6
    results = run_cases([good, case], bench, tries=2)
    assert passed(results) and results[1].reason.startswith("at try 2")


def test_time_passes_only_while_a_case_waits_and_callbacks_run_inside():
    bench, _robot = virtual_robot()
    began_us, rung = bench.now_us, []
    bench.after(20_000, lambda: rung.append(bench.now_us - began_us))
    bench.after(10_000, lambda: rung.append(bench.now_us - began_us))
    assert bench.now_us == began_us and rung == []
    assert not bench.wait(lambda: False, 50_000)
    assert rung == [10_000, 20_000]
    assert bench.now_us == began_us + 50_000


def test_the_log_is_bounded_and_forgets_between_cases():
    bench, robot = virtual_robot()
    bench.rest(100_000)
    status = next(iter(robot.driving.messages(bench.now_us + 500_000)))
    for _ in range(KEPT_MESSAGES + 100):
        robot.emit(status)
    bench.rest(10_000)
    assert len(bench.received(status.channel)) == KEPT_MESSAGES
    bench.forget()
    assert bench.newest(status.channel) is None
