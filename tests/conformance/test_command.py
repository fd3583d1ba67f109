"""Tests of `sightline conform` as users and CI jobs run it: a real robot process, over WebSocket and Zenoh."""

import json
import xml.etree.ElementTree as ET
from contextlib import ExitStack
from pathlib import Path

import pytest

from docs.make.conformance import to_page
from sightline.conformance.case import Access, Case, Level
from sightline.conformance.report import summary, to_dict, to_junit
from sightline.conformance.robot.cases import CASES
from sightline.conformance.runner import Outcome, Result
from sightline.conformance.vision import cases as vision
from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli.conform import access_for
from sightline.operator_side.setup import keys
from tests.conformance.robot.small_server import SmallServer
from tests.fixtures.ports import free_endpoint
from tests.fixtures.robot_process import RobotProcess

QUICK = ("R-CAUS-02", "R-HEAD-17", "R-REQ-01", "R-STOP-03", "R-HOST-04")


def run(capsys, *arguments):
    code = cli.run(("conform", *map(str, arguments)))
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def only(*cases):
    return [part for case in cases for part in ("--only", case)]


# --- at real robots --------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["tcp/", "ws://"])
def test_a_real_robot_conforms(capsys, tmp_path, scheme):
    endpoint = free_endpoint(scheme)
    with RobotProcess(tmp_path, endpoint=endpoint, safety={}) as robot:
        robot.wait_until_on(f"on {endpoint}")
        code, out, _err = run(capsys, "robot", endpoint, *only(*QUICK), "--json", "--save", tmp_path / "r.json")
    report = json.loads(out)
    assert code == 0, [check["reason"] for check in report["checks"]]
    assert report["ok"] and report["side"] == "robot" and report["peer"] == endpoint
    assert {check["name"] for check in report["checks"]} == set(QUICK)
    assert json.loads((tmp_path / "r.json").read_text()) == report


def test_broken_robot_fails_and_every_report_names_the_cause(capsys, tmp_path):
    files = {name: tmp_path / f"r.{name}" for name in ("junit", "save")}
    with SmallServer({"compresses"}) as server:
        options = [part for name, path in files.items() for part in (f"--{name}", path)]
        code, out, err = run(capsys, "robot", server.endpoint, *only("R-SOCK-01", "R-SOCK-03"), *options)
    assert code == 5
    assert "does NOT conform: 1 passed, 1 failed, of 2 cases" in out
    assert "R-SOCK-03" in err and "permessage-deflate" in err
    assert ET.parse(files["junit"]).getroot().get("failures") == "1"
    assert json.loads(files["save"].read_text())["ok"] is False


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["tls/", "wss://"])
def test_a_robot_behind_keys_conforms(capsys, tmp_path, scheme):
    """Roles have keys of their own there, so the kit comes in as vision and as operator at once."""
    endpoint = free_endpoint(scheme)
    keys.make(tmp_path / "keys", [])
    cases = (*QUICK, "R-STOP-02", *(("R-SOCK-34", "R-SOCK-40") if scheme == "wss://" else ()))
    with RobotProcess(tmp_path, endpoint=endpoint, secure=str(tmp_path / "keys"), safety={}) as robot:
        robot.wait_until_on(f"on {endpoint}")
        code, out, _err = run(capsys, "robot", endpoint, "--secure", tmp_path / "keys", *only(*cases), "--json")
    outcomes = {check["name"]: (check["value"], check["reason"]) for check in json.loads(out)["checks"]}
    assert (code, set(outcomes)) == (0, set(cases))
    assert {value for value, _ in outcomes.values()} == {"passed"}, outcomes


# --- mistakes --------------------------------------------------------------------------------------------------------


def test_missing_robot_exits_with_4(capsys):
    code, out, err = run(capsys, "robot", free_endpoint("ws://"), "--only", "R-CAUS-02")
    assert (code, out) == (4, "")
    assert err.startswith("error: no answer from ws://127.0.0.1:") and err.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["robot", "ws://127.0.0.1:1", "--only", "R-NONE"], "no case begins so"),
        (["robot", "ws://127.0.0.1:1", "--group", "leases"], "no such group"),
        (["robot", "http://127.0.0.1:1"], "expected ws://"),
        (["robot", "ws://127.0.0.1:1", "--save", "/nowhere/r.json"], "no folder /nowhere"),
        (["robot"], "ENDPOINT"),
        (["vision"], "ENDPOINT"),
        (["robot", "tcp/127.0.0.1"], "expected <protocol>/<host>:<port>"),
        (["robot", "ws://127.0.0.1:1", "--token", "/nowhere/token"], "cannot read --token /nowhere/token"),
        (["robot", "ws://127.0.0.1:1", "--token", __file__], "invalid token"),
        (["robot", "ws://127.0.0.1:1", "--token", "driver=x"], "unknown role 'driver'"),
        (["robot", "wss://127.0.0.1:1", "--secure", "/nowhere"], "folder not found"),
        (["robot", "ws://127.0.0.1:1", "--robot", "../x"], "robot id"),
        (["vision", "ws://0.0.0.0:1"], "without a token"),
        (["codec"], "no command"),
        (["codec", "--", "/nowhere/codec"], "cannot start"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_mistake_is_one_line_and_exit_code_2(capsys, arguments, says):
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (2, "")
    assert says in err and err.count("\n") == 1


@pytest.mark.slow
def test_a_robot_of_another_name_is_exit_code_4(capsys, tmp_path):
    endpoint = free_endpoint()
    with RobotProcess(tmp_path, endpoint=endpoint) as robot:
        robot.wait_until_on(f"on {endpoint}")
        code, out, err = run(capsys, "robot", endpoint, "--robot", "r9")
    assert (code, out) == (4, "")
    assert "no status from robot 'r9'" in err and err.count("\n") == 1


def test_no_vision_is_exit_code_4(capsys, monkeypatch):
    monkeypatch.setattr(vision, "_FIRST_US", 300_000)
    endpoint = free_endpoint("ws://")
    code, out, err = run(capsys, "vision", endpoint)
    assert (code, out) == (4, "")
    assert f"sightline vision --connect {endpoint}" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        (["sh", "-c", "while read line; do echo nonsense; done"], "this line is not JSON"),
        (["true"], "it ended with 0 before it had answered"),
    ],
)
def test_a_program_that_is_not_a_codec_is_reported_once(capsys, program, reason):
    code, out, err = run(capsys, "codec", "--", *program)
    assert code == 5
    assert err.count("\n") == 1 and reason in err
    assert len(out.splitlines()) < 12 and "the program is gone" in out


# --- keys ------------------------------------------------------------------------------------------------------------

TOKEN = "0123456789abcdefABCDEF_-"


def test_one_token_stands_for_every_role_and_named_ones_for_theirs(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    one.write_text(TOKEN + "\n")
    other.write_text(TOKEN[::-1])
    with ExitStack() as ending:
        assert access_for("", (), ("vision", "operator"), ending) == Access()
        alike = access_for("", [str(one)], ("vision", "operator"), ending)
        assert alike.tokens == {"vision": TOKEN, "operator": TOKEN} and alike.is_guarded
        apart = access_for("", [str(one), f"operator={other}"], ("vision", "operator"), ending)
        assert apart.tokens == {"vision": TOKEN, "operator": TOKEN[::-1]}
        assert Path(apart.folder, "operator.token").stat().st_mode & 0o77 == 0
    assert not Path(apart.folder).exists()


def test_a_token_beside_a_folder_stands_before_the_one_in_it(tmp_path):
    (tmp_path / "keys").mkdir()
    (tmp_path / "keys" / "vision.token").write_text(TOKEN)
    (tmp_path / "keys" / "ca.pem").write_text("an authority")
    (tmp_path / "one").write_text(TOKEN[::-1])
    with ExitStack() as ending:
        assert access_for(str(tmp_path / "keys"), (), ("vision",), ending).tokens == {"vision": TOKEN}
        both = access_for(str(tmp_path / "keys"), [f"vision={tmp_path / 'one'}"], ("vision",), ending)
        assert both.tokens == {"vision": TOKEN[::-1]}
        assert Path(both.folder, "ca.pem").read_text() == "an authority"
    assert (tmp_path / "keys" / "vision.token").read_text() == TOKEN


def test_behind_keys_a_viewer_is_mute_so_an_operator_watches():
    assert (Access().watcher, Access().may_request("vision")) == ("viewer", True)
    guarded = Access({"operator": TOKEN})
    assert (guarded.watcher, guarded.may_request("vision"), guarded.may_request("teleop")) == ("operator", False, True)
    assert (guarded.token_of("teleop"), guarded.token_of("vision")) == (TOKEN, "")


def test_cases_are_listed_without_a_peer(capsys):
    code, out, _err = run(capsys, "robot", "ws://127.0.0.1:1", "--list", "--group", "stop")
    assert code == 0
    stops = [case for case in CASES if case.group == "stop"]
    assert [line.split()[0] for line in out.splitlines()] == [case.id for case in stops]
    assert all(case.title in out and case.clause in out for case in stops)


# --- reports ---------------------------------------------------------------------------------------------------------


def result(number, outcome=Outcome.PASSED, reason="", level=Level.MUST):
    case = Case(f"R-LEASE-{number:02}", level, "Lease, arming, STOP", f"Point | {number}.", lambda bench: None)
    return Result(case, outcome, reason, 1_500_000)


NASTY = "<script>&\x00\x1b|\ud800"
RUN = [
    result(1),
    result(2, Outcome.FAILED, NASTY),
    result(3, Outcome.SKIPPED, "no guests"),
    result(4, Outcome.FAILED, "slow", Level.SHOULD),
]


def test_the_summary_counts_each_kind():
    assert summary(RUN) == "does NOT conform: 1 passed, 1 failed, 1 SHOULD failed, 1 not applicable, of 4 cases"
    assert summary(RUN[:1]) == "conforms: 1 passed, of 1 cases"
    assert summary([]) == "does NOT conform: 0 passed, of 0 cases"


def test_json_has_the_shape_of_all_checking_commands():
    report = to_dict(RUN, "robot", "x")
    assert report["ok"] is False
    assert [(check["name"], check["value"], check["ok"]) for check in report["checks"]] == [
        ("R-LEASE-01", "passed", True),
        ("R-LEASE-02", "failed", False),
        ("R-LEASE-03", "not applicable", True),
        ("R-LEASE-04", "failed", True),
    ]
    assert set(report["checks"][0]) >= {"name", "value", "unit", "bound", "ok"}
    assert report["ok"] == all(check["ok"] for check in report["checks"])


def test_junit_is_valid_for_any_text_of_a_peer():
    suite = ET.fromstring(to_junit(RUN, "robot", NASTY))
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("4", "1", "2")
    failure = suite.find(".//failure")
    assert failure.get("message") == "<script>&??|?" and failure.get("type") == "MUST"
    assert [case.get("classname") for case in suite] == ["robot.lease"] * 4


def test_the_page_of_several_runs_has_a_column_each():
    page = to_page([to_dict(RUN, "robot", "a"), to_dict([result(1), result(2)], "robot", "b")])
    assert "| a | robot | no | 1 | 1 | 1 | 1 | 4 |" in page
    assert "| b | robot | yes | 2 | 0 | 0 | 0 | 2 |" in page
    assert "| R-LEASE-02 | MUST | Lease, arming, STOP | Point \\| 2. | FAIL | ok |" in page
    assert "| R-LEASE-03 | MUST | Lease, arming, STOP | Point \\| 3. | n/a |  |" in page
    assert "| R-LEASE-03 | not applicable | no guests |" in page
    assert to_page([]).startswith("# Conformance")


def test_cases_that_lack_the_same_share_a_line():
    alike = [result(number, Outcome.SKIPPED, "no guests") for number in (1, 2)]
    assert "| R-LEASE-01, R-LEASE-02 | not applicable | no guests |" in to_page([to_dict(alike, "robot", "x")])
