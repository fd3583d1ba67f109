"""`sightline robot test-wheels` and `sightline calibrate drive`: tools of who builds a robot. Shell."""

import os
import sys
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from sightline.operator_side.cli.options import ConfigFile, Sets, numbers
from sightline.operator_side.out_file import check_out_file
from sightline.operator_side.service_settings import load_service
from sightline.operator_side.settings_errors import no_such_name
from sightline.operator_side.calibrate.wheels import check_confirmed, opened_drive, try_wheels, turn_for
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.hardware.gpio import table_of, table_text

TASKS: Final = ("test-wheels",)
_CHECK_FAILED: Final = 5
_LONGEST_WAY_M: Final = 20.0


def run_task(task: str, config: RobotConfig, confirmed: bool) -> int:
    """A task of `sightline robot`. Raises ConfigError for one that is none."""
    if task not in TASKS:
        hint = f" (a robot's id is given with --robot {task})" if not task.startswith("test") else ""
        raise ConfigError(no_such_name("task", task, TASKS) + hint)
    check_confirmed(confirmed, sys.stdin.isatty(), task)
    return 0 if try_wheels(config, None if confirmed else _prompt, typer.echo) else _CHECK_FAILED


def drive(
    *,
    config: ConfigFile = None,
    sets: Sets = None,
    duty: Annotated[
        str, typer.Option(metavar="LIST", help="Duties to drive at, rising, separated by commas.")
    ] = "0.3,0.4,0.5,0.6,0.8,1.0",
    seconds: Annotated[float, typer.Option(min=0.5, max=10, help="How long to drive at each.")] = 2.0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The table to write.")] = Path("drive.toml"),
    yes: Annotated[
        bool, typer.Option("--yes", help="Drive without asking: the way ahead is free. Distances come from stdin.")
    ] = False,
) -> None:
    """Measure duty against speed: the car drives straight on the floor, you type how far it went.

    For drives that work by duty (`gpio`). Give it room ahead; Ctrl-C stops it.
    """
    robot: Any = load_service("robot", file=config, sets=sets or (), environ=os.environ).config
    duties = _rising_duties(duty)
    check_confirmed(yes, sys.stdin.isatty(), "calibrate drive")
    check_out_file(out)
    rows = _measured_rows(robot, duties, seconds, confirmed=yes)
    text = table_text(rows, f"measured by `sightline calibrate drive`, {seconds:g} s at each duty")
    try:
        table_of(text, "these measurements")  # what could not be read back is not written
        out.write_text(text, "utf-8")
    except (ConfigError, OSError) as error:
        typer.echo(f"not written, so that nothing measured is lost:\n{text}", err=True)
        raise error if isinstance(error, ConfigError) else ConfigError(f"{out}: {error.strerror}; see --out") from None
    typer.echo(f"{out} is written; use it: sightline robot --set drive.options.table_file={out}")


def _rising_duties(text: str) -> list[float]:
    duties = numbers("--duty", text, float)
    if any(not 0 < one <= 1 for one in duties) or sorted(set(duties)) != duties:
        raise ConfigError(f"--duty {text!r}: rising numbers above 0 and up to 1, e.g. --duty 0.4,0.6,1")
    return duties


def _measured_rows(
    config: RobotConfig, duties: list[float], seconds: float, *, confirmed: bool
) -> list[tuple[float, float]]:
    rows: list[tuple[float, float]] = []
    with opened_drive(config) as opened:
        give = getattr(opened, "set_duty", None)
        if give is None:
            raise ConfigError(f"drive {config.drive.kind!r} does not work by duty, there is nothing to calibrate")
        for one in duties:
            if not confirmed:
                _prompt(f"duty {one:g} for {seconds:g} s: put the car on the floor, the way ahead free; Enter drives")
            turn_for(give, (one, one), seconds)
            way_m = _distance_m(f"duty {one:g}: how far did it go, metres (0: it did not move)")
            if way_m > 0:
                rows.append((one, way_m / seconds))
    if not rows:
        raise ConfigError("the car moved at no duty: look at its wiring with `sightline robot test-wheels`")
    return rows


def _distance_m(question: str) -> float:
    """Asked until it is a distance; a slip of the pen must not throw away what was measured before."""
    while True:
        answer = _prompt(question)
        try:
            way_m = float(answer.replace(",", "."))
        except ValueError:
            way_m = -1.0
        if 0 <= way_m <= _LONGEST_WAY_M:
            return way_m
        question = f"{answer!r} is no distance; metres from 0 to {_LONGEST_WAY_M:g}, e.g. 0.35"


def _prompt(question: str) -> str:
    answer: str = typer.prompt(question, default="", show_default=False, prompt_suffix=": ")
    return answer
