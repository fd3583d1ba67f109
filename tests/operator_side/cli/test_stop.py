"""`sightline stop`: a plain command line is read as typer reads it, and every other one by typer."""

import threading
from pathlib import Path
from random import Random
from unittest.mock import Mock

import pytest

from sightline.operator_side.cli import app as cli
from sightline.protocol.errors import LinkError, home_path

WORDS = ("r1", "r2", "--json", "--connect", "--connect=tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447", "--secure",
         "--secure=k", "--connect=", "--", "-h", "--jso", "-1", "", "=", "stop")  # fmt: skip


@pytest.fixture
def stopped(monkeypatch):
    """The options of each STOP that was sent."""
    sent = []

    def stop_robot(*given, **_options):
        sent.append(given[:3])
        return True

    monkeypatch.delenv("SIGHTLINE_CONNECT", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", "/nowhere")
    monkeypatch.setattr(cli, "stop_robot", stop_robot)
    return sent


def test_plain_words_are_read_without_typer(stopped, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_typed", None)
    assert cli.run(["stop", "r7", "--connect", "tcp/10.0.0.1:7447", "--json", "--connect=tcp/10.0.0.2:7447"]) == 0
    assert stopped == [("r7", ("tcp/10.0.0.1:7447", "tcp/10.0.0.2:7447"), "")]
    assert '"state": "STOPPED"' in capsys.readouterr().out


@pytest.mark.parametrize("seed", range(4))
def test_every_line_has_the_result_that_typer_gives_it(stopped, monkeypatch, capsys, seed):
    random = Random(seed)
    lines = [random.choices(WORDS, k=random.randrange(5)) for _ in range(60)]
    plain = [line for line in lines if cli.plain_options(line) is not None]
    assert 5 < len(plain) < 55
    results = []
    for reader in (cli.plain_options, lambda _words: None):
        monkeypatch.setattr(cli, "plain_options", reader)
        stopped.clear()
        codes = [cli.run(["stop", *line]) for line in lines]
        results.append((codes, tuple(stopped), capsys.readouterr()))
    assert results[0] == results[1]


def test_empty_robot_id_stops_the_default_robot(stopped):
    assert cli.run(["stop", ""]) == 0
    assert stopped == [("r1", ("tcp/127.0.0.1:7447",), "")]


def test_keys_in_an_unknown_home_do_not_prevent_a_stop(stopped, capsys):
    assert cli.run(["stop", "--secure", "~no-user/x"]) == 0 and len(stopped) == 1
    assert "no home folder for '~no-user' in ~no-user/x; write the whole path" in capsys.readouterr().err


def test_keys_in_an_unknown_home_are_named_once(stopped, monkeypatch, capsys):
    def stop_robot(_robot, _connect, secure, *_given, **_options):
        home_path(secure)  # as the link does

    monkeypatch.setattr(cli, "stop_robot", stop_robot)
    assert cli.run(["stop", "--secure", "~no-user/x"]) == 2
    shown, *others = capsys.readouterr().err.splitlines()
    assert shown == "robot r1 at tls/127.0.0.1:7447 (from default)"
    assert others == ["error: no home folder for '~no-user' in ~no-user/x; write the whole path"]


@pytest.mark.parametrize("is_stopped", [True, False])
def test_missing_secret_is_named_whether_the_robot_stops_or_not(stopped, monkeypatch, capsys, tmp_path, is_stopped):
    if not is_stopped:
        monkeypatch.setattr(cli, "stop_robot", Mock(side_effect=LinkError("no answer")))
    assert cli.run(["stop", "--secure", str(tmp_path)]) == (0 if is_stopped else LinkError.exit_code)
    assert capsys.readouterr().err.count("stop.secret is missing") == 1


@pytest.mark.parametrize("output", ["stdout", "stderr"])
@pytest.mark.parametrize("is_closed", [True, False])
def test_output_that_fails_neither_prevents_a_stop_nor_changes_its_exit_code(stopped, monkeypatch, output, is_closed):
    def unanswered(*_given, **_options):
        raise LinkError("no answer")

    with Path("/dev/full").open("w", buffering=1) as full:
        monkeypatch.setattr(f"sys.{output}", None if is_closed else full)
        assert cli.run(["stop", "r7"]) == 0 and len(stopped) == 1
        monkeypatch.setattr(cli, "stop_robot", unanswered)
        assert cli.run(["stop", "r7"]) == 4


def test_link_that_lingers_does_not_delay_the_exit_with_a_closed_output(stopped, monkeypatch):
    ended, codes = threading.Event(), []
    threading.Thread(target=ended.wait, name=cli.ABANDONED_THREAD, daemon=True).start()
    monkeypatch.setattr("sys.stdout", None)
    monkeypatch.setattr("sys.argv", ["sightline", "stop", "r7"])
    monkeypatch.setattr("os._exit", codes.append)
    with pytest.raises(SystemExit):
        cli.main()
    ended.set()
    assert codes == [0] and len(stopped) == 1


@pytest.mark.parametrize("words", [["-h"], ["--help"], ["r1", "r2"], ["--connect"], ["--secure", "--json"], ["--now"]])
def test_other_words_are_left_to_typer(words):
    assert cli.plain_options(words) is None
