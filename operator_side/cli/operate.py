"""Commands for a running robot: robots, status, arm, disarm, stop, reset, mission, goto, teleop. Shell."""

import json
import secrets
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Annotated

import typer

from sightline.operator_side.cli.options import (
    DEFAULT_CONNECT,
    REJECTED_EXIT,
    Connect,
    Json,
    MaybeConnect,
    Robot,
    Secure,
)
from sightline.operator_side.client.discovery import discover_all
from sightline.operator_side.client.missions import (
    MissionClient,
    Waypoints,
    cannot,
    detector_line,
    mission_line,
    mission_lines,
    request_of,
    waypoints_of,
    waypoints_of_file,
)
from sightline.operator_side.client.pictures import viewer_role
from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.operator_side.client.status import status_line, status_lines
from sightline.operator_side.config.toml_text import options_of
from sightline.protocol.errors import ConfigError
from sightline.protocol.messages import MissionReport, Reply, Status, Verb
from sightline.protocol.transports.open import open_link

_REPORT_S = 0.8  # vision reports twice a second; where one drives, that is worth waiting for


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline robots --connect tcp/192.168.1.20:7447")(robots)
    app.command(epilog="Example: sightline status r1 --watch")(status)
    app.command(epilog="Example: sightline arm r1 --connect tcp/192.168.1.20:7447")(arm)
    app.command(epilog="Example: sightline disarm")(disarm)
    app.command(epilog="Example: sightline stop")(stop)
    app.command(epilog="Example: sightline reset && sightline arm")(reset)
    app.command(epilog="Example: sightline mission r1 follow")(mission)
    app.command(
        epilog="Example: sightline goto r1 1.5 1.5 0 0 --wait",
        context_settings={"ignore_unknown_options": True},  # so that -1.5 is a number
    )(goto)
    app.command(epilog="Example: sightline teleop r1 --connect tcp/192.168.1.20:7447 --linear 0.15")(teleop)


def robots(
    connect: MaybeConnect = None,
    secure: Secure = "",
    seconds: Annotated[float, typer.Option(min=0.2, max=60, help="How long to listen.")] = 0.6,
    as_json: Json = False,
) -> int:
    """List who is there: robots and their state, who sees and steers, versions and round-trip times.

    Without --connect it looks on this machine, then asks the network (multicast).
    """
    found = discover_all(connect, seconds, secure)
    if as_json:
        typer.echo(json.dumps(found.as_object()))
    else:
        typer.echo("\n".join(found.lines()))
    return 0


def status(
    robot: Robot = "r1",
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    watch: Annotated[bool, typer.Option("--watch", help="Once a second, until Ctrl-C.")] = False,
    as_json: Json = False,
) -> None:
    """Say what a robot does and why: state, driver, twist, frame age, latency, every refusal; its vision's mission."""
    role = viewer_role(secure) if secure else SOURCE  # a viewer's keys are enough to look
    with open_link(robot, connect=connect, role=role, secure=secure) as link:
        missions = MissionClient(link)
        while True:
            state = missions.operator.wait_report().status
            seen_to = state.holder is not None and state.holder.source == "vision"
            mission = missions.newest(_REPORT_S if seen_to else 0.0)
            if as_json:
                about = mission and mission.model_dump(mode="json")
                typer.echo(json.dumps({"robot": robot, **state.model_dump(mode="json"), "mission": about}))
            else:
                lines = [*status_lines(robot, state), *(mission_lines(mission) if mission else ())]
                typer.echo("\n".join(lines) + ("\n" if watch else ""))
            if not watch:
                return
            time.sleep(1.0)


def arm(
    robot: Robot = "r1",
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    wait: Annotated[float, typer.Option(min=0, max=60, help="Seconds to wait for live commands.")] = 5.0,
    as_json: Json = False,
) -> int:
    """Let whoever drives a robot move its wheels. The robot must be seeing live commands."""
    with _operator(robot, connect, secure) as operator:
        return _print_reply(robot, operator.arm(wait), as_json)


def disarm(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> int:
    """Wheels to zero; commands are judged but not obeyed until armed again."""
    with _operator(robot, connect, secure) as operator:
        return _print_reply(robot, operator.request(Verb.DISARM), as_json)


def reset(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> int:
    """Leave STOPPED or FAULT. Permits arming, starts nothing."""
    with _operator(robot, connect, secure) as operator:
        return _print_reply(robot, operator.request(Verb.RESET), as_json)


def stop(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> None:
    """STOP a robot: wheels to zero, latched until `sightline reset`. Not an emergency stop: it needs the network."""

    def on_slow() -> None:
        typer.echo(f"STOP of {robot} is not confirmed yet; repeating. Be ready to cut its power by hand", err=True)

    with _operator(robot, connect, secure) as operator:
        _print_stopped(robot, operator.stop(on_slow), as_json)


def _print_stopped(robot: str, state: Status, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"robot": robot, "ok": True, "state": state.state, "detail": state.reason}))
    else:
        typer.echo(status_line(robot, state))


def _print_reply(robot: str, reply: Reply, as_json: bool) -> int:
    """Print a reply; exit code 5 if the robot refused."""
    if as_json:
        typer.echo(json.dumps({"robot": robot, "ok": reply.ok, "state": reply.state, "detail": reply.detail}))
    elif reply.ok:
        typer.echo(f"{robot}: {reply.detail} ({reply.state})")
    else:
        typer.echo(f"error: {robot} refused: {reply.detail}", err=True)
    return 0 if reply.ok else REJECTED_EXIT


@contextmanager
def _operator(robot: str, connect: list[str], secure: str) -> Iterator[Operator]:
    with open_link(robot, connect=connect, role=SOURCE, secure=secure) as link:
        yield Operator(link)


# Commands that say what vision is to do: `mission`, `goto`. Shell.


Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the mission, e.g. linear_mps=0.2.")
]


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
    with _missions(robot, connect, secure) as missions:
        report = missions.report() if name is None else missions.request(name, options=options)
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
    with _missions(robot, connect, secure) as missions:
        report = missions.request("goto", waypoints, options)
        if report.refused or not wait:
            return _print_report(robot, report, as_json, asked=True)
        for report in missions.follow():
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


# `sightline teleop`: a person drives with the keyboard or a gamepad. Shell.


_Gamepad = Annotated[
    str | None,
    typer.Option(
        "--gamepad", metavar="DEVICE", help="A gamepad too: /dev/input/event5, or `auto` for the first one found."
    ),
]


def teleop(
    robot: Robot = "r1",
    *,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    linear: Annotated[float, typer.Option(min=0.02, max=3, help="Speed to begin with, m/s.")] = 0.2,
    angular: Annotated[float, typer.Option(min=0.1, max=10, help="Turn rate to begin with, rad/s.")] = 1.0,
    gamepad: _Gamepad = None,
) -> None:
    """Drive a robot by hand: hold a key of u i o j l m , . and let go to stop. `a` hands over to vision.

    The first press arms the robot. STOP is another command (`sightline stop`), and no key starts a stopped robot.
    """
    from sightline.operator_side.teleop.control import SOURCE, Speeds, Teleop
    from sightline.operator_side.teleop.gamepad import Gamepad
    from sightline.operator_side.teleop.terminal import Cockpit, check_terminal
    from sightline.protocol.transports.open import open_link

    check_terminal()
    session = secrets.token_hex(4)
    with ExitStack() as ending:
        pad = Gamepad(gamepad) if gamepad else None
        if pad is not None:
            ending.callback(pad.close)
        link = ending.enter_context(open_link(robot, connect=connect, role=SOURCE, secure=secure))
        Cockpit(link, Teleop(session, Speeds(linear, angular)), pad).run()
