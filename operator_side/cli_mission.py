"""Commands that say what vision is to do: `mission`, `goto`. Shell."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from sightline.operator_side.cli.options import DEFAULT_CONNECT, REJECTED_EXIT, Connect, Json, Robot, Secure, options_of
from sightline.operator_side.mission_asking import MissionClient, request_of
from sightline.operator_side.mission_text import cannot, detector_line, mission_line
from sightline.operator_side.client.requests import SOURCE
from sightline.operator_side.client.missions import Waypoints, waypoints_of, waypoints_of_file
from sightline.protocol.errors import ConfigError
from sightline.protocol.mission_messages import MissionReport
from sightline.protocol.transports.open import open_link

Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the mission, e.g. linear_mps=0.2.")
]


def register_missions(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline mission r1 follow")(mission)
    app.command(
        epilog="Example: sightline goto r1 1.5 1.5 0 0 --wait",
        context_settings={"ignore_unknown_options": True},  # so that -1.5 is a number
    )(goto)


def mission(
    robot: Robot = "r1",
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="What to begin; without it, tell.")] = None,
    *,
    sets: Sets = None,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    as_json: Json = False,
) -> int:
    """Say what a robot's vision does, or what it is to do from now on. It comes to rest in between."""
    options = options_of(sets or ())
    if options and name is None:
        raise ConfigError("--set is for a mission to begin: name it, e.g. sightline mission r1 follow --set ...")
    if name is not None:
        request_of(0, name, (), options)  # what is wrong with it is said without a robot
    with _missions(robot, connect, secure) as desk:
        report = desk.report() if name is None else desk.ask(name, options=options)
        return _print_report(robot, report, as_json, asked=name is not None)


def goto(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", help="The robot's id.")],
    numbers: Annotated[
        list[str] | None, typer.Argument(metavar="X Y [X Y ...]", help="Metres, in the odometry frame.")
    ] = None,
    *,
    file: Annotated[
        Path | None, typer.Option("--file", metavar="FILE", help="One waypoint a line, X Y; # for remarks.")
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", help="Until it is there, or cannot get there.")] = False,
    sets: Sets = None,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    as_json: Json = False,
) -> int:
    """Send a robot to one place or several, round what its range sensors see. Ctrl-C does not stop it: `stop` does."""
    waypoints, options = _given(numbers or [], file), options_of(sets or ())
    request_of(0, "goto", waypoints, options)
    with _missions(robot, connect, secure) as desk:
        report = desk.ask("goto", waypoints, options)
        if report.refused or not wait:
            return _print_report(robot, report, as_json, asked=True)
        for report in desk.follow():
            if not as_json and not report.done:
                typer.echo(f"{robot}: {mission_line(report)}")
        code = _print_report(robot, report, as_json, asked=True)
        return REJECTED_EXIT if cannot(report) else code


def _given(numbers: list[str], file: Path | None) -> Waypoints:
    if file is None:
        return waypoints_of(numbers)
    if numbers:
        raise ConfigError("waypoints are given on the command line and in a file; give one of them")
    try:
        return waypoints_of_file(file.expanduser().read_text("utf-8"), str(file))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {getattr(error, 'strerror', None) or 'is no text'}") from None


@contextmanager
def _missions(robot: str, connect: list[str], secure: str) -> Iterator[MissionClient]:
    with open_link(robot, connect=connect, role=SOURCE, secure=secure) as link:
        yield MissionClient(link)


def _print_report(robot: str, report: MissionReport, as_json: bool, *, asked: bool) -> int:
    """Print a report; exit code 5 if vision refused what was asked."""
    refused = report.refused if asked else ""
    if as_json:
        ok = not refused and not cannot(report)
        typer.echo(json.dumps({"robot": robot, "ok": ok, **report.model_dump(mode="json")}))
    elif refused:
        typer.echo(f"error: vision of {robot} refused: {refused}", err=True)
    else:
        typer.echo(f"{robot}: {mission_line(report)}")
        if not asked and report.detector:
            typer.echo(f"detector: {detector_line(report)}")
    return REJECTED_EXIT if refused else 0
