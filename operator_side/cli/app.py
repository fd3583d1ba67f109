"""The `sightline` command: registers the command groups and turns every error into one line and an exit code. Shell.

Whatever goes wrong is one line on stderr that says what, where and how to fix it, and the exit code of the design:
0 ok, 2 bad usage or configuration, 3 hardware, 4 cannot connect, 5 a check failed.
"""

import os
import re
import sys
from collections.abc import Sequence
from typing import Final

import typer

from sightline.operator_side.cli.admin import register_doctor, register_install, register_keys
from sightline.operator_side.cli.bench import register_benches as register_bench
from sightline.operator_side.cli.calibrate import register_calibrate, register_pick_color
from sightline.operator_side.cli.conform import register_conform
from sightline.operator_side.cli.detector import register_detector
from sightline.operator_side.cli.evaluate import register_demo_and_score as register_judge
from sightline.operator_side.cli.evaluate import register_faults, register_train
from sightline.operator_side.cli.operate import register_missions as register_mission
from sightline.operator_side.cli.operate import register_operator as register_people
from sightline.operator_side.cli.operate import register_teleop
from sightline.operator_side.cli.services import (
    register_config,
    register_metrics,
    register_scenarios,
    register_services,
)
from sightline.operator_side.cli.watch import register_capture, register_watch
from sightline.operator_side.config.errors import no_such_name
from sightline.protocol.errors import SightlineError

INTERRUPTED: Final = 130
UNEXPECTED: Final = 1
_UNKNOWN_COMMAND = re.compile(r"No such command '([^']*)'")

app = typer.Typer(
    name="sightline",
    help="Let a small robot use eyes and judgement that live on another machine, and never obey old sight.\n\n"
    "Begin with: sightline demo",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
for register in (
    register_services,
    register_judge,
    register_people,
    register_bench,
    register_faults,
    register_calibrate,
    register_keys,
    register_install,
    register_doctor,
    register_metrics,
    register_config,
    register_conform,
    register_detector,
    register_teleop,
    register_mission,
    register_scenarios,
    register_watch,
    register_capture,
    register_pick_color,
    register_train,
):
    register(app)


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
    here = _names_in(context.command if context else None)
    if path != "sightline" and unknown[1] in _names_in(None):
        return f"no command called {unknown[1]!r} in {path}; did you mean 'sightline {unknown[1]}'?; see {path} --help"
    return no_such_name("command", unknown[1], here) + f"; see {path} --help"


def _names_in(group: object) -> list[str]:
    """Names of a group's commands; None is the program itself."""
    return list(getattr(group or typer.main.get_command(app), "commands", ()))


def _print_error(line: str, code: int) -> int:
    typer.echo(f"error: {line}", err=True)
    return code


def main() -> None:
    """Entry point of the `sightline` command."""
    sys.exit(run(sys.argv[1:]))


if __name__ == "__main__":
    main()
