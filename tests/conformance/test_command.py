"""Tests of `sightline conform` as users and CI jobs run it: a real robot process, over WebSocket and Zenoh."""

import json
import os
import shlex
import signal
import socket
import sys
import threading
import xml.etree.ElementTree as ET
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import serve

from docs.make.conformance import to_page
from sightline.conformance import jobs
from sightline.conformance.case import Access, Case, Level
from sightline.conformance.report import summary, to_dict, to_junit, to_line
from sightline.conformance.robot import cases as robot_cases
from sightline.conformance.robot.cases import CASES
from sightline.conformance.runner import Outcome, Result, run_case
from sightline.conformance.vision import cases as vision
from sightline.operator_side.cli import app as cli
from sightline.operator_side.cli import conform
from sightline.operator_side.cli.conform import RunOptions, access_for
from sightline.operator_side.setup import keys
from sightline.protocol.channels import TWIST
from sightline.protocol.errors import ConfigError, LinkError
from tests.conformance.robot.reference import virtual_robot
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


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "witnesses", "outcome"), [
    ("CoastingDrive", False, "failed"), ("BlindCoastingDrive", False, "passed"), ("BlindCoastingDrive", True, "failed"),
])  # fmt: skip
def test_robot_whose_wheels_never_stop_fails_what_a_witness_sees(capsys, tmp_path, kind, witnesses, outcome):
    endpoint = free_endpoint("ws://")
    drive = {"kind": f"tests.conformance.robot.coasting_drive:{kind}", "options": {"path": str(tmp_path / "m.csv")}}
    with RobotProcess(tmp_path, endpoint=endpoint, safety={}, drive=drive) as robot:
        robot.wait_until_on(f"on {endpoint}")
        more = ["--motor-log", tmp_path / "m.csv"] if witnesses else []
        code, out, _err = run(capsys, "robot", endpoint, *only("R-STOP-01", "R-ARM-05"), *more, "--json")
    found = {check["name"]: check["value"] for check in json.loads(out)["checks"]}
    assert found == {"R-STOP-01": outcome, "R-ARM-05": outcome}, out
    assert code == (5 if outcome == "failed" else 0)


@pytest.mark.slow
def test_motor_log_of_another_run_is_one_line(capsys, tmp_path):
    endpoint = free_endpoint("ws://")
    (tmp_path / "old.csv").write_text("1000000,0,0\n")
    with RobotProcess(tmp_path, endpoint=endpoint, safety={}) as robot:
        robot.wait_until_on(f"on {endpoint}")
        code, out, err = run(capsys, "robot", endpoint, "--motor-log", tmp_path / "old.csv", *only("R-STOP-01"))
    assert (code, out) == (2, "")
    assert "name the log of this run" in err and err.count("\n") == 1


@pytest.mark.slow
def test_robot_that_hangs_in_a_case_fails_it_in_one_line_and_the_others_run(capsys, tmp_path):
    endpoint = free_endpoint("ws://")
    with RobotProcess(tmp_path, guarded=False, endpoint=endpoint, safety={}) as robot:
        robot.wait_until_on(f"on {endpoint}")
        begins, run_one = [], conform.run_cases

        def hanging(cases, bench, prepare, on_result, tries):
            def prepare_and_hang(bench):
                prepare(bench)
                begins.append(robot.process.pid)
                if len(begins) == 2:
                    for pid in (robot.network_pid(), robot.process.pid):
                        os.kill(pid, signal.SIGSTOP)
                    threading.Timer(3.0, lambda: [os.kill(pid, signal.SIGCONT)
                                                  for pid in (robot.process.pid, robot.network_pid())]).start()

            return run_one(cases, bench, prepare_and_hang, on_result, 1)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(conform, "run_cases", hanging)
            code, out, err = run(capsys, "robot", endpoint, *only("R-REQ-01", "R-REQ-02", "R-STOP-03"), "--json")
    found = {check["name"]: (check["value"], check["reason"]) for check in json.loads(out)["checks"]}
    assert code == 5
    assert found.pop("R-REQ-01") == ("failed", "no readable status came (waited 2 s)")
    assert found == {"R-STOP-03": ("passed", ""), "R-REQ-02": ("passed", "")}
    assert sum(line.startswith("R-REQ-01") for line in err.splitlines()) == 1


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


@pytest.mark.waits
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
        (["robot"], "no ENDPOINT; write its address, e.g. sightline conform robot ws://"),
        (["robot", "ws://127.0.0.1:1", "--jobs", "2", "--motor-log", "m.csv"], "--motor-log is for one peer"),
        (["vision", "ws://127.0.0.1:1", "--start", "x {endpoint}", "--dial"], "--dial is for one peer"),
        (["codec", "--jobs", "2", "--", "x"], "conform codec is for one peer; leave out --jobs and --start"),
        (["robot", "ws://127.0.0.1:1", "--jobs", "2"], "--jobs needs --start COMMAND with {endpoint}"),
        (["robot", "ws://127.0.0.1", "--start", "x {endpoint}"], "--jobs counts its port up"),
        (["robot", "ws://127.0.0.1:1", "--start", "/nowhere/x {endpoint}"], "cannot start --start '/nowhere/x'"),
        (["robot", "ws://127.0.0.1:1", "--motor-log", "/nowhere/m.csv"], "cannot read --motor-log /nowhere/m.csv"),
        (["robot", "ws://127.0.0.1:1", "--motor-log", __file__], "line 1: expected t_us,left_rad_s,right_rad_s"),
        (["robot", "ws://127.0.0.1:1", "--resume", "/nowhere/r.jsonl"], "no folder /nowhere"),
        (["robot", "ws://127.0.0.1:1", "--resume", __file__], "line 1: not a result; remove the line"),
        (["robot", "ws://127.0.0.1:1", "--older", "ftp://127.0.0.1:1"], "invalid endpoint 'ftp://127.0.0.1:1'"),
        (["robot", "ws://127.0.0.1:1", "--older", "ws://127.0.0.1:1"], "invalid --older ws://127.0.0.1:1: expected"),
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


@pytest.mark.parametrize("command", ["robot", "vision", "codec"])
def test_help_lists_no_option_that_the_command_always_rejects(capsys, command):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0 and "--resume" in out
    assert ("--jobs" in out) is ("--start" in out) is (command != "codec")


@pytest.mark.parametrize(("send", "seen"), [
    (lambda client: client.close(1011, "the camera is gone"), "; it ends the connection with 1011 the camera is gone"),
    (lambda client: client.send(b'\x1a\x00{"channel":"status","v":1}{}'), "header block of 6656 bytes in a message of"),
    (lambda client: client.send(b"\0\x13" + b'{"channel":"smell"}'), "; its messages are rejected: INEXACT_KEY"),
    (lambda client: None, "; check --robot, or publish status"),
], ids=["closes", "little-endian", "invalid", "silent"])
def test_robot_without_a_status_is_described_as_it_is_seen(capsys, monkeypatch, send, seen):
    def play(client):
        client.recv()
        client.send(json.dumps({"v": 1, "robot": "r1", "session": "4e5f6071"}))
        send(client)
        with suppress(ConnectionClosed):
            client.recv()

    monkeypatch.setattr(robot_cases, "_FIRST_US", 300_000)
    monkeypatch.setattr(conform, "_SEEN_S", 0.1)
    endpoint = free_endpoint("ws://")
    with serve(play, "127.0.0.1", int(endpoint.rpartition(":")[2]), subprotocols=["sightline.v1"]) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        code, out, err = run(capsys, "robot", endpoint, "--group", "stop")
    assert (code, out) == (4, "")
    assert "no status from robot 'r1'" in err and seen in err and err.count("\n") == 1


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


def test_cases_are_listed_without_an_endpoint(capsys):
    for side, first in (("robot", "R-FRAM-01"), ("vision", "V-FRAM-01"), ("codec", "C-CODEC-1001")):
        code, out, _err = run(capsys, side, "--list")
        assert (code, out.splitlines()[0].split()[0]) == (0, first)


# --- one line per case, and going on ---------------------------------------------------------------------------------


def test_each_case_is_one_line_and_a_second_run_skips_what_the_file_has(capsys, tmp_path):
    store = tmp_path / "r.jsonl"
    with SmallServer({"compresses"}) as server:
        options = [*only("R-SOCK-01", "R-SOCK-03"), "--resume", store, "--json-lines"]
        code, out, err = run(capsys, "robot", server.endpoint, *options)
        lines = [json.loads(line) for line in out.splitlines()]
        assert (code, [(one["name"], one["value"]) for one in lines]) == (
            5, [("R-SOCK-01", "passed"), ("R-SOCK-03", "failed")])  # fmt: skip
        assert [line.split()[0] for line in err.splitlines()[:2]] == ["R-SOCK-01", "R-SOCK-03:"]
        assert "[14.1 Opening]" in err
        assert store.read_text() == out
        store.write_text(store.read_text().splitlines(keepends=True)[1] + '{"name": "R-SO')
        code, out, _err = run(capsys, "robot", server.endpoint, *options)
        assert [json.loads(line)["name"] for line in out.splitlines()] == ["R-SOCK-01"]
        assert code == 5, "the failure that the file has counts"
        code, out, err = run(capsys, "robot", server.endpoint, *options, "--name", "another")
        assert (code, out) == (2, "") and "not of robot another" in err and err.count("\n") == 1


@pytest.mark.parametrize("text", ["my notes", "line\nmy notes", "{}"])
def test_resume_leaves_a_file_of_another_kind_as_it_is(capsys, tmp_path, text):
    (tmp_path / "notes").write_text(text)
    code, out, err = run(capsys, "robot", "ws://127.0.0.1:1", "--resume", tmp_path / "notes")
    assert (code, out) == (2, "") and "--resume" in err and err.count("\n") == 1
    assert (tmp_path / "notes").read_text() == text


def test_resume_of_another_peer_keeps_the_cut_line(tmp_path):
    store = tmp_path / "r.jsonl"
    text = to_line(Result(CASES[0], Outcome.PASSED, "", 1), "robot", "a") + '\n{"name": "R-'
    store.write_text(text)
    with pytest.raises(ConfigError, match="not of robot b"):
        RunOptions(resume=store).earlier(CASES, "robot", "b")
    assert store.read_text() == text
    assert len(RunOptions(resume=store).earlier(CASES, "robot", "a")) == 1
    store.write_text('{"name": "R-')
    assert RunOptions(resume=store).earlier(CASES, "robot", "a") == [] and store.read_text() == ""


@pytest.mark.slow
def test_jobs_start_a_peer_each_and_join_their_results(capsys):
    first = free_endpoint("ws://")
    start = f"{sys.executable} -m tests.conformance.robot.small_server {{endpoint}}"
    names = ("R-SOCK-01", "R-SOCK-02", "R-SOCK-07", "R-SOCK-13")
    code, out, err = run(capsys, "robot", first, *only(*names), "--jobs", "2", "--start", start, "--json")
    assert (code, [check["name"] for check in json.loads(out)["checks"]]) == (0, list(names)), err


def started(start, code, monkeypatch, *, passed=True):
    """Run one case by `--start`; the kit is a command that prints its result, and exits with `code` 4 without one."""
    line = to_line(Result(CASES[0], Outcome.PASSED if passed else Outcome.FAILED), "robot", "ws://127.0.0.1:1")
    kit = "exit 4" if code == 4 else f"sleep 0.2; echo {shlex.quote(line)}; exit {code}"
    monkeypatch.setattr(jobs, "_KIT", ("sh", "-c", kit))
    return jobs.Jobs("robot", "ws://127.0.0.1:1", start, 1, ()).run(CASES[:1], lambda result: None)


def test_start_where_something_listens_already_starts_nothing(tmp_path):
    endpoint = free_endpoint("ws://")
    other, tested = ("127.0.0.1", int(endpoint.rpartition(":")[2])), f"touch {tmp_path / 'x'} {{endpoint}}"
    with socket.create_server(other), pytest.raises(ConfigError, match=f"something listens on {endpoint} already"):
        jobs.Jobs("robot", endpoint, tested, 1, ()).run(CASES[:1], print)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("code", [0, 4])
def test_peer_of_start_that_has_ended_conforms_to_nothing_and_its_last_error_is_shown(monkeypatch, code):
    with pytest.raises(LinkError, match=r"ended with exit code 98: address in use; try its command: sh -c .*ws://"):
        started("sh -c 'echo starts >&2; echo address in use >&2; echo >&2; exit 98' {endpoint}", code, monkeypatch)


def test_peer_of_start_that_ends_in_a_case_has_its_results(monkeypatch):
    results = started("sh -c 'exit 98' {endpoint}", 5, monkeypatch, passed=False)
    assert [one.outcome for one in results] == [Outcome.FAILED]


@pytest.mark.parametrize("wrapper", ["sleep 60 & echo $! > {file}; wait", "sleep 60 & echo $! > {file}"])
def test_nothing_that_start_began_is_left_running(monkeypatch, tmp_path, wrapper):
    file = tmp_path / "pid"
    assert len(started(f"sh -c '{wrapper.format(file=file)}' {{endpoint}}", 0, monkeypatch)) == 1
    with pytest.raises(ProcessLookupError):
        os.kill(int(file.read_text()), 0)


def test_failed_case_shows_the_last_messages_bounded():
    bench, _robot = virtual_robot()

    def fails(bench):
        bench.publish(TWIST, b'{"v":1}', b"x" * 64, "vision")
        bench.rest(500_000)
        bench.expect(False, "why")

    result = run_case(Case("R-CAUS-99", Level.MUST, "5.1 Order", "A title.", fails), bench)
    sent = next(line for line in result.evidence if line.startswith("sent twist"))
    assert sent == f"sent twist: header {{\"v\":1}}, payload {'x' * 48!r} = {'78' * 48} (64 bytes)"
    assert any(line.startswith("received status: header") for line in result.evidence)
    assert max(map(len, result.evidence)) < 600


def test_case_after_a_lost_connection_connects_again():
    bench, _robot = virtual_robot()
    calls = []
    bench.restore = lambda: calls.append(bench.now_us)
    run_case(Case("R-CAUS-99", Level.MUST, "5.1 Order", "A title.", lambda bench: None), bench)
    assert len(calls) == 1


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


def test_results_are_printed_before_files_that_cannot_be_written(capsys, tmp_path):
    for option in ("junit", "save"):
        with pytest.raises(ConfigError, match=f"cannot write {tmp_path}: Is a directory; choose another file"):
            RunOptions(as_json=True, **{option: tmp_path}).report(RUN, "robot", "x")
        assert json.loads(capsys.readouterr().out)["ok"] is False


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
