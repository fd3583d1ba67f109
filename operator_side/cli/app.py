"""The `sightline` command: registers the command groups and turns every error into one line and an exit code. Shell.

Whatever goes wrong is one line on stderr that says what, where and how to fix it, and the exit code of the design:
0 ok, 2 bad usage or configuration, 3 hardware, 4 cannot connect, 5 a check failed.
"""

import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Any, Final

import typer
from typer.core import TyperGroup

from sightline.operator_side.config.errors import no_such_name
from sightline.protocol.errors import SightlineError
from sightline.protocol.log import error_line

INTERRUPTED: Final = 130
UNEXPECTED: Final = 1
_MODULES: Final = {
    "sim": "services", "robot": "services", "vision": "services", "router": "services",
    "demo": "evaluate",
    "robots": "operate", "status": "operate", "arm": "operate", "disarm": "operate", "stop": "operate",
    "reset": "operate",
    "faults": "evaluate",
    "install": "admin", "doctor": "admin",
    "metrics": "services",
    "teleop": "operate", "mission": "operate", "goto": "operate",
    "scenarios": "services", "labels": "services",
    "watch": "watch", "capture": "watch", "pick-color": "calibrate",
    "train": "evaluate", "score": "evaluate", "bench": "bench",
    "calibrate": "calibrate", "keys": "admin", "config": "services",
    "conform": "conform", "detector": "detector",
}
"""Each command, in the order of the help, and the module beside this one that registers it."""
_UNKNOWN_COMMAND = re.compile(r"No such command '([^']*)'")


class _Commands(Mapping[str, Any]):
    """The commands by name; a module is imported when one of its commands is looked up."""

    def __getitem__(self, name: str) -> Any:
        return _registered(_MODULES[name])[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_MODULES)

    def __len__(self) -> int:
        return len(_MODULES)


@cache
def _registered(module: str) -> Mapping[str, Any]:
    group = typer.Typer(rich_markup_mode=None)
    import_module(f"sightline.operator_side.cli.{module}").register(group)
    return typer.main.get_group(group).commands


class _Program(TyperGroup):
    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings | {"commands": _Commands()})


app = typer.Typer(
    name="sightline",
    cls=_Program,
    help="Let a small robot use eyes and judgement that live on another machine, and never obey old sight.\n\n"
    "Begin with: sightline demo",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)

@app.callback(invoke_without_command=True)
def _help_by_default(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


def run(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code; never raises."""
    try:
        code = app(list(arguments), standalone_mode=False, prog_name="sightline")
        return code if isinstance(code, int) else 0
    except SightlineError as error:
        return _print_error(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return INTERRUPTED
    except BrokenPipeError:  # `sightline status --watch | head`: whoever read has gone, and knows
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNEXPECTED
    except Exception as error:
        return _unexpected(error)


def _unexpected(error: Exception) -> int:
    """A usage error of the command line, or a fault of the program; either way one line."""
    usage = getattr(error, "format_message", None)
    if usage is not None:
        line = _usage_line(" ".join(usage().split()), getattr(error, "ctx", None))
        return _print_error(line, getattr(error, "exit_code", 2))
    if os.environ.get("SIGHTLINE_DEBUG") == "1":
        raise error
    where = f"{type(error).__name__}: {' '.join(str(error).split())}"
    return _print_error(f"unexpected {where}; SIGHTLINE_DEBUG=1 shows where, please report it", UNEXPECTED)


def _usage_line(text: str, context: typer.Context | None) -> str:
    """A usage error with the nearest command of the same group, where it is about one."""
    unknown = _UNKNOWN_COMMAND.match(text)
    if unknown is None:
        return f"{text.rstrip('.')}; see --help"
    path = context.command_path if context else "sightline"
    here = list(getattr(context and context.command, "commands", _MODULES))
    if path != "sightline" and unknown[1] in _MODULES:
        return f"no command called {unknown[1]!r} in {path}; did you mean 'sightline {unknown[1]}'?; see {path} --help"
    return no_such_name("command", unknown[1], here) + f"; see {path} --help"


def _print_error(line: str, code: int) -> int:
    typer.echo(error_line(line), err=True)
    return code


def main() -> None:
    """Entry point of the `sightline` command."""
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
