"""Tables and colors on the terminal."""

import io

import pytest

from sightline.operator_side.client.missions import mission_line
from sightline.operator_side.table import colored, print_block, print_table, table_lines, uses_color
from sightline.protocol.messages import MissionReport


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_columns_are_as_wide_as_their_cells_in_any_terminal(monkeypatch):
    monkeypatch.setenv("COLUMNS", "10")
    long = "word " * 40
    assert table_lines([("a", "b", long.strip()), ("long name", "", "c"), ("alone",)]) == [
        f"a          b  {long.strip()}", "long name     c", "alone",
    ]  # fmt: skip
    assert table_lines([]) == []


@pytest.mark.parametrize(("environ", "expected"), [
    ({}, True), ({"NO_COLOR": "1"}, False), ({"NO_COLOR": ""}, True), ({"TERM": "dumb"}, False),
])
def test_colors_need_a_terminal_and_no_no_color(monkeypatch, environ, expected):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    for name, value in environ.items():
        monkeypatch.setenv(name, value)
    assert uses_color(Terminal()) is expected
    assert uses_color(io.StringIO()) is False
    assert uses_color(None) is False, "the output is closed"


def test_text_of_a_peer_cannot_control_the_terminal(capsys):
    print_block(["mission   a: \x1b[31mred\nline", "", "µ 中文"])
    assert capsys.readouterr().out == "mission   a: ?[31mred?line\n\nµ 中文\n"
    report = MissionReport(mission="a", phase="\x1b[2Jgone\r", note="b\x07")
    assert mission_line(report) == "a: ?[2Jgone?; b?"


def test_states_are_colored_and_other_words_are_not():
    assert colored("state STOPPED: x") == "state \x1b[31mSTOPPED\x1b[0m: x"
    assert colored("HOLDING ACTIVELY") == "HOLDING ACTIVELY"


def test_a_pipe_gets_plain_lines(capsys):
    print_table([("r1", "FAULT")])
    assert capsys.readouterr().out == "r1  FAULT\n"
