"""The address of client commands: its sources in their order, and the file of `sightline use`."""

import ctypes
import json
import os
import stat
import threading
from pathlib import Path

import pytest

from sightline.operator_side.config.context import (
    Context,
    clear_context,
    context_path,
    find_address,
    read_context,
    write_context,
)
from sightline.protocol.channels import STATUS
from sightline.protocol.codec import encode
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import Stamp, State, Status
from sightline.protocol.transports.open import open_link
from tests.fixtures.commands import run
from tests.fixtures.links import free_endpoint

ADDRESS = "tcp/192.168.1.20:7447"


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.delenv("SIGHTLINE_CONNECT", raising=False)
    return tmp_path


def target(robot=None, connect=None, secure="", **variables):
    return find_address({**os.environ, **variables}, robot, connect, secure)


def test_sources_of_the_address_in_their_order(home):
    assert (target().connect, target().origin) == (("tcp/127.0.0.1:7447",), "default")
    write_context(context_path(os.environ), Context(ADDRESS, "r7", "/keys"))
    saved = target()
    assert (saved.robot, saved.connect, saved.secure) == ("r7", (ADDRESS,), "/keys")
    assert saved.origin.endswith("sightline/context.toml")
    variable = target(SIGHTLINE_CONNECT="tcp/a:1, ws://b:2")
    assert (variable.connect, variable.origin) == (("tcp/a:1", "ws://b:2"), "SIGHTLINE_CONNECT")
    option = target(connect=["tcp/c:3"], SIGHTLINE_CONNECT="tcp/a:1")
    assert (option.connect, option.origin) == (("tcp/c:3",), "--connect")


def test_robot_and_keys_of_the_context_belong_to_its_address():
    write_context(context_path(os.environ), Context(ADDRESS, "r7", "/keys"))
    assert target(robot="r2").robot == "r2"
    assert target(secure="/other").secure == "/other"
    for other in (target(connect=["tcp/c:3"]), target(SIGHTLINE_CONNECT="tcp/a:1")):
        assert (other.robot, other.secure) == ("r1", "")


def test_default_address_with_keys_is_a_tls_address():
    assert target(secure="/keys").connect == ("tls/127.0.0.1:7447",)


@pytest.mark.parametrize(("text", "expected"), [
    ("connect = ", "invalid TOML"),
    ("\xff", "invalid TOML"),
    ("connect = " + "[" * 5000, "nested too deeply"),
    ("robot = 'r1'", "connect is missing"),
    ("connect = 5", "invalid connect: expected text"),
    ("connect = 'here'", "'here'"),
    ("connect = 'tcp/a:1'\nrobot = 'a/b'", "'a/b'"),
    ("connect = 'tcp/a:1'\nhost = 'a'", "unknown key 'host'"),
])
def test_damaged_context_is_one_line_for_every_client_command(capsys, home, text, expected):
    path = home / "sightline/context.toml"
    path.parent.mkdir()
    path.write_bytes(text.encode("latin-1"))
    for command in (("stop",), ("status",), ("use",)):
        code, out, err = run(capsys, *command)
        assert (code, out) == (2, "")
        assert err.startswith("error: ") and err.count("\n") == 1
        assert str(path) in err and expected in err and err.endswith("run `sightline use --clear`\n")
    assert run(capsys, "use", "--clear")[0] == 0
    assert not path.exists()


def test_context_that_cannot_be_read_is_one_line(capsys, home):
    (home / "sightline/context.toml").mkdir(parents=True)
    code, _, err = run(capsys, "stop")
    assert code == 2 and "cannot read" in err and err.count("\n") == 1


def test_context_is_not_read_with_an_address_from_elsewhere(capsys, home):
    (home / "sightline").mkdir()
    (home / "sightline/context.toml").write_text("damaged")
    assert target(connect=["tcp/c:3"]).connect == ("tcp/c:3",)
    assert target(SIGHTLINE_CONNECT="tcp/a:1").connect == ("tcp/a:1",)


def test_invalid_variable_is_one_line(capsys, monkeypatch):
    monkeypatch.setenv("SIGHTLINE_CONNECT", "tcp/a:1,here")
    code, out, err = run(capsys, "stop")
    assert (code, out) == (2, "")
    assert err.startswith("error: SIGHTLINE_CONNECT: ") and "'here'" in err and err.count("\n") == 1


@pytest.mark.parametrize("service", ["robot", "vision", "sim"])
def test_services_accept_the_variable_and_ignore_it(capsys, monkeypatch, service):
    monkeypatch.setenv("SIGHTLINE_CONNECT", ADDRESS)
    code, out, err = run(capsys, "config", "show", service)
    assert (code, err) == (0, "") and ADDRESS not in out
    monkeypatch.setenv("SIGHTLINE_CONECT", ADDRESS)
    assert "did you mean 'SIGHTLINE_CONNECT'?" in run(capsys, "config", "show", service)[2]


def test_write_replaces_the_file_as_a_whole(home, monkeypatch):
    path = context_path(os.environ)
    write_context(path, Context(ADDRESS))
    write_context(path, Context("tcp/b:2", "r2", "/a \"b\""))
    assert read_context(path) == Context("tcp/b:2", "r2", "/a \"b\"")

    def fail(_descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(ConfigError, match="No space left on device"):
        write_context(path, Context(ADDRESS))
    assert read_context(path).connect == "tcp/b:2"
    assert [file.name for file in path.parent.iterdir()] == ["context.toml"], "no part is left"


def test_folder_that_is_not_writable_is_one_line(capsys, home):
    (home / "sightline").write_text("a file in place of the folder")
    code, out, err = run(capsys, "use", ADDRESS, "--no-check")
    assert (code, out) == (2, "") and "cannot write" in err and err.count("\n") == 1


@pytest.fixture
def read_only_home(home):
    """A home that may not be written, also where root runs the tests: the kernel checks a thread's filesystem user."""
    home.chmod(stat.S_IRUSR | stat.S_IXUSR)
    is_root, libc = os.geteuid() == 0, ctypes.CDLL(None)
    if is_root:
        libc.setfsuid(65534)
    yield
    if is_root:
        libc.setfsuid(0)


def test_read_only_folder_is_one_line(capsys, read_only_home):
    code, out, err = run(capsys, "use", ADDRESS, "--no-check")
    assert (code, out) == (2, "") and "Permission denied" in err and err.count("\n") == 1


def test_user_without_a_home_folder_has_no_context(monkeypatch):
    def no_home(_path):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("pathlib.Path.expanduser", no_home)
    assert find_address({}, None, None).origin == "default"


def test_relative_config_home_is_ignored(monkeypatch):
    monkeypatch.setenv("HOME", "/home/anna")
    for environ in ({"XDG_CONFIG_HOME": "relative"}, {}):
        assert str(context_path(environ)) == "/home/anna/.config/sightline/context.toml"


# --- `sightline use` -------------------------------------------------------------------------------------------------


def test_use_saves_shows_and_clears_an_address(capsys, home):
    code, out, err = run(capsys, "use", ADDRESS, "--robot", "r7", "--secure", "keys", "--no-check")
    assert (code, err) == (0, "") and out.startswith(f"saved robot r7 at {ADDRESS} to ")
    code, out, _ = run(capsys, "use")
    assert out.startswith(f"robot r7 at {ADDRESS} (from ") and out.endswith(f", keys {Path('keys').absolute()}\n")
    shown = json.loads(run(capsys, "use", "--json")[1])
    assert (shown["connect"], shown["robot"]) == (ADDRESS, "r7")
    assert run(capsys, "use", "--clear") == (0, "saved address cleared\n", "")
    assert run(capsys, "use", "--clear") == (0, "no saved address\n", "")
    assert run(capsys, "use")[1] == "robot r1 at tcp/127.0.0.1:7447 (from default)\n"


@pytest.mark.parametrize(("arguments", "code", "expected"), [
    (("here",), 2, "'here'"),
    ((ADDRESS, "--robot", "a/b"), 2, "'a/b'"),
    ((ADDRESS, "--clear"), 2, "--clear"),
    (("--robot", "r2"), 2, "--robot needs ADDRESS; write sightline use ADDRESS --robot r2"),
    (("--secure", "keys"), 2, "--secure needs ADDRESS; write sightline use ADDRESS --secure keys"),
    (("--no-check",), 2, "--no-check needs ADDRESS; write sightline use ADDRESS --no-check"),
    (("--clear", "--robot", "r2"), 2, "--robot needs ADDRESS"),
    (("tls/127.0.0.1:1", "--secure", "no-such-folder"), 2, "no-such-folder"),
])
def test_invalid_use_is_one_line_and_saves_nothing(capsys, home, arguments, code, expected):
    got, out, err = run(capsys, "use", *arguments)
    assert (got, out) == (code, "")
    assert expected in err and err.startswith("error: ") and err.count("\n") == 1
    assert not (home / "sightline/context.toml").exists()


def test_address_that_does_not_answer_is_one_line_and_is_not_saved(capsys, home, monkeypatch):
    monkeypatch.setattr("sightline.operator_side.cli.admin.ANSWER_S", 0.5)
    endpoint = free_endpoint()
    code, out, err = run(capsys, "use", endpoint)
    assert (code, out) == (4, "") and endpoint in err and "--no-check" in err and err.count("\n") == 1
    assert not (home / "sightline/context.toml").exists()


@pytest.mark.waits
def test_address_of_a_robot_is_saved_and_used(capsys, home):
    endpoint = free_endpoint()
    with open_link("r7", listen=[endpoint]) as robot:
        code, out, err = run(capsys, "use", endpoint, "--robot", "r8")
        assert (code, err) == (0, "") and "note: no status from robot 'r8'" in out
        stop = _publish(robot)
        try:
            code, out, err = run(capsys, "use", endpoint, "--robot", "r7")
            assert (code, err) == (0, "") and out.startswith("saved robot r7") and "note" not in out
            code, out, err = run(capsys, "status")
            assert (code, err) == (0, "") and "HOLD: test" in out
            code, out, err = run(capsys, "disarm", "--json")
            assert code == 4 and err.startswith(f"robot r7 at {endpoint} (from ") and err.count("\n") == 2
        finally:
            stop()


def _publish(robot):
    ending = threading.Event()

    def publish():
        while not ending.wait(0.05):
            robot.publish(STATUS, encode(Stamp(session="0000abcd", seq=1, t_us=1)),
                          encode(Status(state=State.HOLD, reason="test")))

    thread = threading.Thread(target=publish, daemon=True)
    thread.start()
    return lambda: (ending.set(), thread.join())


def test_clear_reports_a_file_that_cannot_be_removed(home):
    path = home / "sightline/context.toml"
    path.mkdir(parents=True)
    with pytest.raises(ConfigError, match="cannot remove"):
        clear_context(path)
