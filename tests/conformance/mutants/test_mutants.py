"""Each mutant fails the cases that must catch it, each case has a mutant, and honest peers pass; the table's rules."""

import re
from concurrent.futures import ProcessPoolExecutor

import pytest

from sightline.conformance.case import Level
from sightline.conformance.runner import Outcome
from tests.conformance.mutants import peers
from tests.conformance.mutants.operators import OPERATORS, OperatorError, change_function
from tests.conformance.mutants.table import FAULTS, read_table
from tests.conformance.robot.reference import KEYED
from tests.conformance.vision.fixture import BY_BOXES
from tests.fixtures.javascript import EXAMPLES

MUTANTS, PROBLEMS = peers.table()
PYTHON = ("robot", "vision")
JAVASCRIPT = ("javascript-robot", "javascript-vision")
VIRTUAL = (*PYTHON, *JAVASCRIPT)
NOT_APPLICABLE = {"javascript-robot": {"R-FRAM-11", *(f"R-LEASE-{number}" for number in range(21, 28)), *KEYED},
                  "javascript-vision": {*(f"V-REP-0{number}" for number in range(1, 7)),
                                        *(f"V-REQ-0{number}" for number in range(2, 6)), *BY_BOXES}}
"""Cases that a peer's choices leave nothing to test in: the JavaScript robot publishes no scan, and has no Zenoh and no
keys here; the JavaScript vision service publishes no reports and no detections, knows no missions, and steers by no
boxes of another peer."""


AT_ONCE = 8
"""Peers on sockets at a time: they wait far more than they compute."""
MOST_S = 900.0
"""One mutant on sockets at all cases takes two minutes, and waits for those before it."""


def of(*names, survive=False):
    """Parameters of the mutants of some peers; those on sockets run in real time, so they are slow."""
    return [
        pytest.param(one, id=str(one), marks=[pytest.mark.slow] if one.peer not in VIRTUAL else [])
        for one in MUTANTS if one.peer in names and bool(one.survives) is survive
    ]


@pytest.fixture(scope="session")
def stage():
    with peers.Stage() as stage:
        yield stage


def failures_of(mutant):
    """Return the cases that fail, of all of the peer; it runs in a process of its own."""
    with peers.Stage() as stage:
        return set(peers.failed(stage.results(mutant.peer, mutant, peers.CASES[mutant.peer])))


@pytest.fixture(scope="module")
def on_sockets():
    """Mutant -> what will have failed, so that each is reported when it is done."""
    pool = ProcessPoolExecutor(AT_ONCE)
    chosen = [one for one in MUTANTS if one.exact and one.peer in peers.REAL_TIME]
    yield {str(one): pool.submit(failures_of, one) for one in chosen}
    pool.shutdown(cancel_futures=True)


def results_of(stage, mutant, cases):
    return stage.results(mutant.peer, mutant, cases)


# --- each mutant is caught, and honest peers pass ---------------------------------------------------------------------


@pytest.mark.parametrize("mutant", of(*(peer for peer in peers.CASES if peer != "robot-socket")))
def test_mutant_fails_the_cases_that_must_catch_it(stage, mutant):
    cases = [case for case in peers.CASES[mutant.peer] if case.id in mutant.caught_by]
    failed = peers.failed(results_of(stage, mutant, cases))
    assert set(failed) == set(mutant.caught_by)
    assert not [reason for reason in failed.values() if "Error:" in reason or "\n" in reason], failed


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.parametrize("mutant", of("robot-socket", "vision-socket"))
def test_mutant_on_sockets_fails_exactly_its_case(on_sockets, mutant):
    assert on_sockets[str(mutant)].result(timeout=MOST_S) == set(mutant.caught_by)


@pytest.mark.long
@pytest.mark.parametrize("peer", [*VIRTUAL, "codec", "javascript-codec"])
def test_mutants_at_all_cases_fail_those_that_must_catch_them(peer):
    chosen, wrong = [one for one in MUTANTS if one.peer == peer and not one.survives], {}
    with ProcessPoolExecutor() as pool:  # they compute: one for each processor
        for mutant, failed in zip(chosen, pool.map(failures_of, chosen), strict=True):
            caught_by = set(mutant.caught_by)
            if failed != caught_by and (mutant.exact or not failed > caught_by):
                wrong[str(mutant)] = f"must fail {sorted(caught_by)}, fails {sorted(failed)}"
    assert not wrong, "\n".join(f"{name}: {what}" for name, what in wrong.items())


@pytest.mark.long
@pytest.mark.parametrize("mutant", of(*peers.CASES, survive=True))
def test_mutant_that_is_listed_as_not_caught_fails_no_case(stage, mutant):
    assert peers.failed(results_of(stage, mutant, peers.CASES[mutant.peer])) == {}


@pytest.mark.slow
@pytest.mark.parametrize("peer", JAVASCRIPT)
def test_javascript_peer_passes_in_virtual_time(stage, peer):
    results = stage.results(peer, None, peers.CASES[peer])
    missed = {one.case.id: one.reason for one in results if one.outcome is not Outcome.PASSED}
    assert set(missed) == NOT_APPLICABLE.get(peer, set()), missed


# --- the table --------------------------------------------------------------------------------------------------------


def test_every_row_of_the_table_is_good():
    assert PROBLEMS == ()


def test_text_that_a_javascript_mutant_changes_is_in_the_source_once():
    changes = [one.parameters for one in MUTANTS if one.peer in JAVASCRIPT and one.operator == "source"]
    counts = {one["old"]: (EXAMPLES / one["place"]).read_text("utf-8").count(one["old"]) for one in changes}
    assert len(counts) > 20 and {old: count for old, count in counts.items() if count != 1} == {}


def test_every_case_has_a_mutant():
    caught = {name for mutant in MUTANTS for name in mutant.caught_by}
    cases = {case.id: case for of_peer in peers.CASES.values() for case in of_peer}
    assert [name for name, case in cases.items() if case.level is Level.MUST and name not in caught] == []
    assert sorted(set(cases) - caught) == []


def test_every_case_of_a_robot_and_a_vision_service_has_a_hand_written_peer():
    written = {name for mutant in MUTANTS if mutant.exact for name in mutant.caught_by}
    assert written == {case.id for peer in ("robot", "vision", "robot-socket", "vision-socket")
                       for case in peers.CASES[peer]}  # fmt: skip


def test_table_has_every_fault_in_both_languages():
    rows = [one for one in MUTANTS if one.operator in OPERATORS]
    assert len(rows) >= 60
    for names in (PYTHON, JAVASCRIPT):
        assert {one.fault for one in rows if one.peer in names} >= set(FAULTS) - {peers.HAND_WRITTEN}
    assert all(one.survives or one.caught_by for one in rows)


GOOD = """
[[robot]]
name = "reports no holder"
fault = "wrong role"
operator = "drop"
message = "status"
field = "payload.holder"
caught_by = ["R-LEASE-01"]
"""


@pytest.mark.parametrize(("old", "new", "line"), [
    ('"drop"', '"drip"', r"mutants.toml: mutant 'reports no holder' of robot: unknown operator 'drip'; expected one of "
                         "add, append, .*source, swap"),
    ('"wrong role"', '"bad luck"', "unknown fault 'bad luck'; expected one of swapped fields"),
    ('"status"', '"statuses"', "`message` names no channel"),
    ("R-LEASE-01", "R-LEASE-99", "unknown case R-LEASE-99"),
    ("field =", "fields =", "drop has the parameters field, not fields"),
    ('caught_by = ["R-LEASE-01"]', "", "give either `caught_by` or `survives`"),
    ('operator = "drop"', "", "operator is missing"),
])
def test_bad_row_is_one_line_and_the_others_remain(old, new, line):
    other = GOOD.replace("no holder", "no holder at all")
    ids = {"robot": {"R-LEASE-01"}}
    mutants, problems = read_table(GOOD.replace(old, new) + other, "mutants.toml", ids)
    assert [one.name for one in mutants] == ["reports no holder at all"]
    assert len(problems) == 1 and "\n" not in problems[0]
    assert re.search(line, problems[0]), problems


def test_unknown_peer_and_broken_toml_are_one_line():
    ids = {"robot": {"R-LEASE-01"}}
    assert read_table("[[robots]]", "m.toml", ids) == ([], ["m.toml: unknown peer 'robots'; expected one of robot"])
    assert read_table("[[robot", "m.toml", ids)[1][0].startswith("m.toml: invalid TOML: ")


@pytest.mark.parametrize(("place", "old", "line"), [
    ("sightline.robot_side.safety.lease:Lease.take", "self", "times; expected once"),
    ("sightline.robot_side.safety.lease:Lease.give", "self", "no function .*:Lease.give"),
])
def test_source_that_cannot_be_changed_is_one_line(place, old, line):
    with pytest.raises(OperatorError, match=line), change_function(place, old, ""):
        pass
