"""The robot address that a client command uses: its option, SIGHTLINE_CONNECT, the saved context, or the default.
Shell (files).

`sightline use` saves the context. Robot, vision service and router never read it.
"""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT, check_endpoint, check_robot_id
from sightline.protocol.transports.stop_port import stop_secret_file

CONNECT_VARIABLE: Final = "SIGHTLINE_CONNECT"
DEFAULT_ROBOT: Final = "r1"
_KEYS: Final = ("connect", "robot", "secure")
_CLEAR: Final = "run `sightline use --clear`"


class Context(NamedTuple):
    """A saved address: endpoint, robot id, and the folder of keys or ""."""

    connect: str
    robot: str = DEFAULT_ROBOT
    secure: str = ""


class RobotAddress(NamedTuple):
    """The robot that a command addresses, and the source of its address."""

    robot: str
    connect: tuple[str, ...]
    secure: str
    origin: str

    def __str__(self) -> str:
        return f"robot {self.robot} at {', '.join(self.connect)} (from {self.origin})"


def find_address(
    environ: Mapping[str, str], robot: str | None, connect: Sequence[str] | None, secure: str = ""
) -> RobotAddress:
    """Find the address for a client command.

    The context's robot id and keys are used only together with its address.

    Args:
        environ: environment of the process.
        robot: id from the command line, or None.
        connect: endpoints from the command line, or None.
        secure: folder of keys from the command line, or "".

    Raises:
        ConfigError: SIGHTLINE_CONNECT or the context file is invalid.
    """
    robot_id = DEFAULT_ROBOT if robot is None else robot  # "" comes from an unset variable of a script, and is invalid
    if connect:
        return RobotAddress(robot_id, tuple(connect), secure, "--connect")
    if environ.get(CONNECT_VARIABLE):
        return RobotAddress(robot_id, _from_variable(environ[CONNECT_VARIABLE]), secure, CONNECT_VARIABLE)
    path = context_path(environ)
    saved = read_context(path) if path else None
    if saved is not None:
        robot_id = saved.robot if robot is None else robot
        return RobotAddress(robot_id, (saved.connect,), secure or saved.secure, shown(path))
    default = DEFAULT_ENDPOINT.replace("tcp/", "tls/") if secure else DEFAULT_ENDPOINT
    return RobotAddress(robot_id, (default,), secure, "default")


def target_of(robot: str | None, connect: list[str] | None, secure: str, *, announce: bool = False) -> RobotAddress:
    """Find the robot that a client command addresses. Raises ConfigError for an invalid id or address.

    Args:
        robot, connect, secure: values of the options, as given.
        announce: True to print address and source on stderr, for commands that move a robot.
    """
    target = find_address(os.environ, robot, connect, secure)
    check_robot_id(target.robot)
    for endpoint in target.connect:
        check_endpoint(endpoint)
    if announce:
        print(str(target), file=sys.stderr)
    return target


def stop_secret_of(target: RobotAddress, warn: Callable[[str], None]) -> str:
    """Return the file of the STOP secret. Warns with one line if the keys do not contain it."""
    try:
        return stop_secret_file(target.secure) if target.secure else ""
    except ConfigError as error:
        warn(str(error))
        return ""


def _from_variable(text: str) -> tuple[str, ...]:
    endpoints = tuple(part.strip() for part in text.split(","))
    for endpoint in endpoints:
        _check(check_endpoint, endpoint, CONNECT_VARIABLE, "correct or unset the variable")
    return endpoints


def context_path(environ: Mapping[str, str]) -> Path | None:
    """Return the path of the context file, or None if the user has no home folder."""
    folder = environ.get("XDG_CONFIG_HOME", "")
    if Path(folder).is_absolute():  # the XDG specification ignores relative paths
        return Path(folder) / "sightline/context.toml"
    try:
        return Path("~/.config/sightline/context.toml").expanduser()
    except RuntimeError:
        return None


def shown(path: Path | None) -> str:
    """Return `path` with `~` for the home folder."""
    try:
        return str(path and Path("~") / path.relative_to(Path.home()))
    except (RuntimeError, ValueError):
        return str(path)


def read_context(path: Path) -> Context | None:
    """Read the context file. None if it is missing. Raises ConfigError for a damaged or unreadable file."""
    import tomllib

    from sightline.operator_side.config.toml_text import parse_toml

    try:
        table = parse_toml(path.read_text("utf-8-sig"))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}; {_CLEAR}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: invalid TOML: {error}; {_CLEAR}") from None
    return _checked(table, path)


def _checked(table: dict[str, Any], path: Path) -> Context:
    for key, value in table.items():
        if key not in _KEYS:
            raise ConfigError(f"{path}: unknown key '{key}'; {_CLEAR}")
        if not isinstance(value, str):
            raise ConfigError(f"{path}: invalid {key}: expected text; {_CLEAR}")
    if "connect" not in table:
        raise ConfigError(f"{path}: connect is missing; {_CLEAR}")
    context = Context(**table)
    _check(check_endpoint, context.connect, str(path), _CLEAR)
    _check(check_robot_id, context.robot, str(path), _CLEAR)
    return context


def _check(check: Any, value: str, place: str, fix: str) -> None:
    try:
        check(value)
    except ConfigError as error:
        raise ConfigError(f"{place}: {error}; {fix}") from None


def write_context(path: Path, context: Context) -> None:
    """Save the context atomically. Raises ConfigError if the file cannot be written."""
    import tempfile

    from sightline.operator_side.config.toml_text import toml_text

    table = {key: value for key in _KEYS if (value := getattr(context, key))}
    text = f"# The default robot address of client commands, saved by `sightline use`.\n{toml_text(table)}"
    part = ""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        number, part = tempfile.mkstemp(prefix=".context-", dir=path.parent)
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        Path(part).replace(path)
    except OSError as error:
        if part:
            Path(part).unlink(missing_ok=True)
        raise ConfigError(
            f"cannot write {path}: {error.strerror}; set XDG_CONFIG_HOME to a folder that you may write"
        ) from None


def clear_context(path: Path) -> bool:
    """Remove the context file. Returns False if it was missing. Raises ConfigError if it cannot be removed."""
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"cannot remove {path}: {error.strerror}; remove it by hand") from None
    return True
