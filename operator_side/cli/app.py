"""The process of the `sightline` command: runs it, and turns every error into one line and an exit code. Shell.

A plain `sightline stop` imports only the modules of a STOP datagram. typer parses all other command lines, but its
import takes longer than a STOP.
"""

import errno
import json
import os
import re
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TextIO

from sightline.operator_side.client.stop import stop_robot
from sightline.operator_side.config.context import stop_secret_of, target_of
from sightline.protocol.errors import SightlineError

if TYPE_CHECKING:
    import typer

INTERRUPTED: Final = 130
CLOSED: Final = 141  # the exit code of a shell for SIGPIPE
UNEXPECTED: Final = 1
USAGE: Final = 2

_UNKNOWN_COMMAND = re.compile(r"No such command '([^']*)'")
_VALIDATION = re.compile("Value error, |, unable to parse string as an? [a-z]+")
"""What the validation of a value adds to its reason."""


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; never raises."""
    try:
        options = plain_options(arguments[1:]) if arguments[:1] == ["stop"] else None
        code = _typed(arguments) if options is None else send_stop(**options)
        if sys.stdout is not None:
            sys.stdout.flush()  # here, because its error can still be reported
        return code if isinstance(code, int) else 0
    except SightlineError as error:
        return _print_error(str(error), error.exit_code)
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        return _of_system(error, arguments)
    except Exception as error:
        return _unexpected(error, arguments)


def _typed(arguments: Sequence[str]) -> Any:
    """Run a command line through typer. Returns the command's result."""
    import typer

    from sightline.operator_side.cli.commands import app

    if arguments[:1] == ["help"]:
        arguments = [*arguments[1:], "--help"]
    try:
        with _connecting_printed() if "--json" not in arguments else nullcontext():
            return app(list(arguments), standalone_mode=False, prog_name="sightline")
    except typer.Abort as ending:
        if isinstance(ending.__cause__, EOFError):  # from the program, e.g. an empty file, not the end of stdin
            raise ending.__cause__ from None
        return INTERRUPTED
    except SystemExit as ending:
        if isinstance(ending.__context__, BrokenPipeError):  # typer treats it as an unexpected error
            raise ending.__context__ from None
        raise


@contextmanager
def _connecting_printed() -> Iterator[None]:
    """Print the line of a link that waits for an answer, unless the command has a log with this line."""
    import logging

    opening = logging.getLogger("sightline.protocol.transports.open")
    handler = logging.StreamHandler()
    handler.addFilter(lambda _record: not logging.getLogger().handlers)
    opening.addHandler(handler)
    opening.setLevel(logging.INFO)
    try:
        yield
    finally:
        opening.removeHandler(handler)


def plain_options(arguments: Sequence[str]) -> dict[str, Any] | None:
    """Return the options of `stop` if all words are plain: ROBOT, --connect, --secure and --json; otherwise None."""
    given: dict[str, Any] = {"robot": None, "connect": [], "secure": "", "as_json": False}
    words = iter(arguments)
    for word in words:
        name, has_value, value = word.partition("=")
        if word == "--json":
            given["as_json"] = True
        elif name in ("--connect", "--secure"):
            value = value if has_value else next(words, "")
            if not value or value.startswith("-"):
                return None
            given[name[2:]] = [*given["connect"], value] if name == "--connect" else value
        elif not word or word.startswith("-") or given["robot"] is not None:
            return None
        else:
            given["robot"] = word
    return given


def send_stop(robot: str | None, connect: list[str] | None, secure: str, as_json: bool) -> int:
    """Run `sightline stop` with the given options. Returns 0; raises SightlineError if the robot may still move."""

    def on_slow() -> None:
        _warn(f"STOP of {target.robot} is not confirmed, repeating; be ready to cut its power by hand")

    target = target_of(robot or None, connect, secure)  # an unset variable of a script must not prevent a STOP
    _warn(str(target))
    lacks: list[str] = []

    def on_other_secret() -> None:
        lacks.append(f"{secret_file} is not the STOP secret of {target.robot}, so that datagrams did not stop it; "
                     "copy that of the robot's keys")

    secret_file = stop_secret_of(target, lacks.append)
    try:
        is_stored = stop_robot(target.robot, target.connect, target.secure, secret_file, on_slow,
                               on_other_secret=on_other_secret, thread_name=ABANDONED_THREAD)
    except SightlineError as error:
        lacks = [line for line in lacks if line != str(error)]  # the error of the link already reports these keys
        raise
    finally:
        for line in lacks:
            _warn(line)
    if not is_stored:
        _warn(f"STOP of {target.robot} is not on its disk, so that a restart ends it; is the disk full?")
    done = {"robot": target.robot, "ok": True, "state": "STOPPED", "detail": "wheels at zero"}
    _print(json.dumps(done) if as_json else f"{target.robot}: STOPPED (wheels at zero)", sys.stdout)
    return 0


def _warn(line: str) -> None:
    _print(line, sys.stderr)


def _print(line: str, stream: TextIO | None) -> None:
    """Print a line. A closed output or a full disk must not prevent a STOP or change its exit code."""
    try:
        if stream is not None:
            print(line, file=stream, flush=True)
    except OSError:
        _discard(stream)


def _discard(stream: TextIO | None) -> None:
    """Redirect an output to the null device, so that its error does not affect the end of the process."""
    if stream is not None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _of_system(error: OSError, arguments: Sequence[str]) -> int:
    """Report an output that cannot be written, or a missing current folder. Other errors are unexpected."""
    if error.filename is None and error.errno in (errno.EPIPE, errno.ENOSPC):
        _discard(sys.stdout)
        if error.errno == errno.EPIPE:
            return CLOSED
        return _print_error(f"cannot write the output: {error.strerror}; free the disk", USAGE)
    try:
        Path.cwd()
    except FileNotFoundError:
        return _print_error("the current folder no longer exists; change to another", USAGE)
    if isinstance(error, FileNotFoundError) and error.filename is None and "temporary directory" in str(error):
        return _print_error("no temporary folder can be written: the disk is full or read-only; free some space, or "
                            "set TMPDIR to a folder that you may write", USAGE)
    if arguments[:1] == ["--install-completion"]:
        return _print_error(f"cannot write {error.filename}: {error.strerror}; set HOME to a folder that you may "
                            "write, or add the lines of `sightline --show-completion` to your shell by hand", USAGE)
    return _unexpected(error, arguments)


def _unexpected(error: Exception, arguments: Sequence[str]) -> int:
    """Print a usage error of the command line, or an internal error, as one line."""
    usage = getattr(error, "format_message", None)
    if usage is not None:
        line = _usage_line(" ".join(usage().split()), getattr(error, "ctx", None), arguments)
        return _print_error(line, getattr(error, "exit_code", USAGE))
    if os.environ.get("SIGHTLINE_DEBUG") == "1":
        raise error
    from sightline.protocol.log import error_text, report_ending

    report_ending("program", error)
    where = f"{type(error).__name__}: {error_text(error)}"
    return _print_error(f"unexpected {where}; SIGHTLINE_DEBUG=1 shows where, please report it", UNEXPECTED)


def _usage_line(text: str, context: "typer.Context | None", arguments: Sequence[str]) -> str:
    """Add the nearest command of the same group to a usage error about a command."""
    text = _VALIDATION.sub("", text).replace("Input should be", "expected")
    unknown = _UNKNOWN_COMMAND.match(text)
    path = context.command_path if context else _command_path(arguments)
    if unknown is None:
        return f"{text.rstrip('.')}; see {path} --help"
    from sightline.operator_side.cli.commands import COMMANDS
    from sightline.operator_side.config.errors import no_such_name

    here = list(getattr(context and context.command, "commands", COMMANDS))
    if path != "sightline" and unknown[1] in COMMANDS:
        return f"unknown command '{unknown[1]}' in {path}; did you mean 'sightline {unknown[1]}'?; see {path} --help"
    return no_such_name("command", unknown[1], here) + f"; see {path} --help"


def _command_path(arguments: Sequence[str]) -> str:
    """Return the words of the command, for an error without them, e.g. an option without its value."""
    from typer.main import get_command

    from sightline.operator_side.cli.commands import app

    commands, path = getattr(get_command(app), "commands", {}), "sightline"
    for word in arguments:
        if word not in commands:
            break
        commands, path = getattr(commands[word], "commands", {}), f"{path} {word}"
    return path


def _print_error(line: str, code: int) -> int:
    from sightline.protocol.log import error_line

    _warn(error_line(line))
    return code


def _open_closed_streams() -> None:
    """Open the null device for each closed standard stream, so that no socket gets its descriptor number."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            null = os.open(os.devnull, os.O_RDWR)  # gets the lowest free number, which is `number`
            os.set_inheritable(null, True)  # also for the child processes of a robot
            setattr(sys, name, os.fdopen(null, "w" if number else "r"))


ABANDONED_THREAD: Final = "abandoned link"
"""Name of a thread that may still open a link when the command has its result. It must not delay the exit."""


def main() -> None:
    """Run the command of this process and exit with its code."""
    code = INTERRUPTED
    _open_closed_streams()
    with suppress(KeyboardInterrupt):  # a second Ctrl-C, while the first one ends the command
        code = run(sys.argv[1:])
    # After Ctrl-C a link may be open. Threads of Zenoh that call Python abort the process when its interpreter ends.
    if code == INTERRUPTED and "zenoh" in sys.modules:
        with suppress(KeyboardInterrupt, OSError, AttributeError):
            sys.stdout.flush()
        os._exit(code)
    if any(thread.name == ABANDONED_THREAD for thread in threading.enumerate()):
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
