"""`sightline stop`: a plain command line is read as typer reads it, and every other one by typer."""

from random import Random

import pytest

from sightline.operator_side.cli import app as cli

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


@pytest.mark.parametrize("words", [["-h"], ["--help"], ["r1", "r2"], ["--connect"], ["--secure", "--json"], ["--now"]])
def test_other_words_are_left_to_typer(words):
    assert cli.plain_options(words) is None
