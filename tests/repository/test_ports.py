"""Free ports come from `tests/fixtures/ports.py` alone, and no two processes get the same one."""

import ast
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.fixtures.ports import BLOCK, EPHEMERAL, free_endpoint, free_port, outside_ephemeral

TESTS = Path(__file__).parent.parent
_PRINT_PORTS = """
from tests.fixtures.ports import free_port
print(*(free_port() for _ in range(150)), flush=True)
input()  # the ports stay locked
"""


def binds_port_zero(text: str) -> list[int]:
    """Return the lines that bind port 0, with which the kernel picks a port that others may take meanwhile."""
    if "bind" not in text and "create_server" not in text:
        return []
    calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call) and node.args]
    return [
        call.lineno
        for call in calls
        if getattr(call.func, "attr", getattr(call.func, "id", "")) in ("bind", "create_server")
        and isinstance(call.args[0], ast.Tuple)
        and isinstance(port := call.args[0].elts[1], ast.Constant)
        and port.value == 0
    ]


@pytest.mark.parametrize("line", [
    'probe.bind(("127.0.0.1", 0))', 'socket.create_server(("", 0), backlog=1)', "create_server(at=1) or bind((x, 0))",
])  # fmt: skip
def test_a_line_that_binds_port_zero_is_found(line):
    assert binds_port_zero(line) == [1]


def test_no_test_binds_port_zero():
    found = {
        str(path.relative_to(TESTS.parent)): lines
        for path in TESTS.rglob("*.py")
        if (lines := binds_port_zero(path.read_text(encoding="utf-8")))
    }
    assert not found, "take the port from tests/fixtures/ports.py"


def test_ports_of_processes_that_run_together_never_meet():
    command = [sys.executable, "-c", _PRINT_PORTS]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "cwd": TESTS.parent}
    others = [subprocess.Popen(command, **pipes) for _ in range(2)]
    handed_out = [free_port() for _ in range(BLOCK + 1)]
    for other in others:
        handed_out += map(int, other.stdout.readline().split())
    for other in others:
        other.communicate("\n", timeout=20)
    assert len(handed_out) == len(set(handed_out)) == BLOCK + 301


def test_a_port_that_something_uses_is_passed_over():
    next_port = free_port() + 1
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", next_port))
        assert free_port() != next_port


def test_forked_child_gets_other_ports():
    mine, (reader, writer) = free_port(), os.pipe()
    child = os.fork()
    if not child:
        try:
            os.write(writer, f"{free_port()}\n".encode())
            signal.pause()  # its block is free for others once it has ended
        finally:
            os._exit(1)  # an exception must not continue the session of the parent
    os.close(writer)
    try:
        with os.fdopen(reader) as text:
            theirs = int(text.readline())
        assert theirs not in {mine, *(free_port() for _ in range(BLOCK))}
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


@pytest.mark.parametrize(("text", "usable"), [
    ("32768\t60999\n", range(10_000, 32_768)), ("10240\t60000\n", range(60_001, 65_536)),
    ("1024\t65535\n", range(10_000, 65_536)),
])  # fmt: skip
def test_ports_lie_outside_the_range_of_outgoing_connections(text, usable):
    assert outside_ephemeral(text) == usable


def test_an_endpoint_has_a_port_outside_the_range_of_outgoing_connections():
    scheme, _, port = free_endpoint("ws://").rpartition("127.0.0.1:")
    assert scheme == "ws://" and int(port) in outside_ephemeral(EPHEMERAL.read_text())
