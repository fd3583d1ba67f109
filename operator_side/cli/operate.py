"""Commands for a running robot: robots, status, arm, disarm, stop, reset, mission, goto, teleop. Shell."""

import json
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from sightline.operator_side.cli.app import send_stop
from sightline.operator_side.cli.options import (
    CHECK_FAILED,
    Connect,
    Json,
    Robot,
    Secure,
    complete_mission,
    complete_robot,
)
from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.operator_side.client.status import reply_line, short_lines, status_lines
from sightline.operator_side.config.context import RobotAddress, stop_secret_of, target_of
from sightline.operator_side.table import print_block
from sightline.protocol.errors import ConfigError, LinkError, home_path
from sightline.protocol.log import printable
from sightline.protocol.messages import MissionReport, Reply, State, Status, Verb
from sightline.protocol.transports.open import open_link

if TYPE_CHECKING:
    from sightline.operator_side.client.missions import MissionClient, Waypoints
    from sightline.protocol.transports.link import Link

_PERIOD_S: Final = 0.25
_REPORT_S: Final = 0.8  # longest wait of `status` for a report; the vision service reports twice a second


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline robots --connect tcp/192.168.1.20:7447")(robots)
    app.command(epilog="Example: sightline status r1 --watch")(status)
    app.command(epilog="Example: sightline arm r1 --connect tcp/192.168.1.20:7447")(arm)
    app.command(epilog="Example: sightline disarm r1")(disarm)
    app.command(epilog="Example: sightline stop r1 --connect tcp/192.168.1.20:7447")(stop)
    app.command(epilog="Example: sightline reset r1 && sightline arm r1")(reset)
    app.command(epilog="Example: sightline mission r1 follow")(mission)
    app.command(
        epilog="Example: sightline goto r1 1.5 1.5 0 0 --wait",
        context_settings={"ignore_unknown_options": True},  # so that -1.5 is parsed as a number
    )(goto)
    app.command(epilog="Example: sightline teleop r1 --connect tcp/192.168.1.20:7447 --linear 0.15")(teleop)


def robots(
    connect: Connect = None,
    secure: Secure = "",
    seconds: Annotated[float, typer.Option(min=0.2, max=60, help="Listen for this long.")] = 0.6,
    as_json: Json = False,
) -> int:
    """List robots and the services connected to them

    Without an address the command looks on this machine, then sends a multicast to the network.
    """
    from sightline.operator_side.client.discovery import discover_all

    target = target_of(None, connect, secure)
    places = None if target.origin == "default" else target.connect
    found = discover_all(places, seconds, target.secure)
    typer.echo(json.dumps(found.as_object()) if as_json else "\n".join(map(printable, found.lines())))
    return 0


def status(
    robot: Robot = None,
    connect: Connect = None,
    *,
    secure: Secure = "",
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show every field.")] = False,
    watch: Annotated[bool, typer.Option("--watch", help="Show it again four times a second, until Ctrl-C.")] = False,
    as_json: Json = False,
) -> int:
    """Show a robot's state and its reason

    The lines name the driver, the wheels, the frame age and the mission. With --json --watch each line is one object.
    """
    from sightline.operator_side.client.missions import MissionClient
    from sightline.operator_side.client.pictures import viewer_role

    target = target_of(robot, connect, secure)
    role = viewer_role(target.secure) if target.secure else SOURCE  # the keys of a viewer are sufficient
    with _link(target, role) as link:
        missions = MissionClient(link)
        if watch:
            return follow_status(missions, verbose=verbose, as_json=as_json)
        state = missions.operator.wait_report().status
        # A robot sends images only to a vision service or a viewer. In HOLD its camera may be gone.
        is_seen_to = state.holder is not None or state.stream.fps > 0 or state.state is State.HOLD
        report = missions.newest(_REPORT_S if is_seen_to else 0.0)
        if as_json:
            typer.echo(_status_json(target.robot, state, report))
        else:
            print_block(_status_block(target.robot, state, report, verbose))
    return 0


def follow_status(
    missions: "MissionClient", *, verbose: bool, as_json: bool = False, ends_s: float = float("inf")
) -> int:
    """Show a robot's status, or its silence, until `ends_s` (monotonic) or Ctrl-C; in place on a terminal."""
    from sightline.operator_side.terminal import LiveBlock

    with LiveBlock() as live:
        while time.monotonic() < ends_s:
            try:
                state = missions.operator.wait_report().status
            except LinkError as error:
                if as_json:
                    typer.echo(json.dumps({"robot": missions.operator.robot, "error": str(error)}))
                else:
                    live.show([str(error)])
                continue
            report = missions.newest(0.0)
            if as_json:
                typer.echo(_status_json(missions.operator.robot, state, report))
            else:
                live.show(_status_block(missions.operator.robot, state, report, verbose))
            time.sleep(_PERIOD_S)
    return 0


def _status_json(robot: str, state: Status, report: MissionReport | None) -> str:
    about = report and report.model_dump(mode="json")
    return json.dumps({"robot": robot, **state.model_dump(mode="json"), "mission": about})


def _status_block(robot: str, state: Status, report: MissionReport | None, verbose: bool) -> list[str]:
    from sightline.operator_side.client.missions import mission_line, mission_lines, vision_fault_lines

    if verbose:
        return [*status_lines(robot, state), *(mission_lines(report) if report else ())]
    if report is None:
        return list(short_lines(robot, state))
    return [*short_lines(robot, state), f"mission   {mission_line(report)}", *vision_fault_lines(report)]


def arm(
    robot: Robot = None,
    connect: Connect = None,
    secure: Secure = "",
    wait: Annotated[float, typer.Option(min=0, max=60, help="Wait this many seconds for valid commands.")] = 5.0,
    as_json: Json = False,
) -> int:
    """Arm a robot so that it may move

    The robot must already receive valid commands. Motion starts from zero.
    """
    with _operator(target_of(robot, connect, secure, announce=True)) as operator:
        return _print_reply(operator, Verb.ARM, operator.arm(wait), as_json)


def disarm(robot: Robot = None, connect: Connect = None, secure: Secure = "", as_json: Json = False) -> int:
    """Stop the wheels and disarm a robot

    The robot validates commands but does not apply them until it is armed again.
    """
    with _operator(target_of(robot, connect, secure, announce=True)) as operator:
        return _print_reply(operator, Verb.DISARM, operator.request(Verb.DISARM), as_json)


def stop(robot: Robot = None, connect: Connect = None, secure: Secure = "", as_json: Json = False) -> int:
    """STOP a robot and latch the stop until reset

    The wheels stay at zero until `sightline reset`. STOP needs the network, so it is not an emergency stop.
    """
    return send_stop(robot, connect, secure, as_json)


def reset(robot: Robot = None, connect: Connect = None, secure: Secure = "", as_json: Json = False) -> int:
    """Clear a latched STOP or a drive fault

    The robot is disarmed afterwards, and does not move.
    """
    with _operator(target_of(robot, connect, secure, announce=True)) as operator:
        return _print_reply(operator, Verb.RESET, operator.reset(), as_json)


def _print_reply(operator: Operator, verb: Verb, reply: Reply, as_json: bool) -> int:
    """Print a reply. Returns exit code 5 if the robot rejected the request."""
    robot = operator.robot
    if as_json:
        typer.echo(json.dumps({"robot": robot, "ok": reply.ok, "state": reply.state, "detail": reply.detail}))
    else:
        driver = operator.report.status.holder if operator.report else None
        line = printable(reply_line(robot, verb, reply, driver.source if driver else ""))
        typer.echo(line if reply.ok else f"error: {line}", err=not reply.ok)
    return 0 if reply.ok else CHECK_FAILED


@contextmanager
def _link(target: RobotAddress, role: str) -> "Iterator[Link]":
    with open_link(target.robot, connect=target.connect, role=role, secure=target.secure) as link:
        yield link


@contextmanager
def _operator(target: RobotAddress) -> Iterator[Operator]:
    with _link(target, SOURCE) as link:
        yield Operator(link)


# --- `mission` and `goto` ----------------------------------------------------------------------------------------


Sets = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the mission, e.g. linear_mps=0.2.")
]


Label = Annotated[str, typer.Option("--label", metavar="LABEL", help="Label to follow, e.g. person [default: any].")]


def mission(
    robot: Robot = None,
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", autocompletion=complete_mission,
                       help="Mission to start; without it, show the mission."),
    ] = None,
    *,
    label: Label = "",
    sets: Sets = None,
    connect: Connect = None,
    secure: Secure = "",
    as_json: Json = False,
) -> int:
    """Show or start a robot's mission

    The robot comes to rest before the new mission starts.
    """
    from sightline.operator_side.client.missions import request_of
    from sightline.operator_side.config.toml_text import options_of

    options = options_of(sets or ())
    key = "label" if name == "legs" else "target.label"
    if label and key in options:
        raise ConfigError(f"--label and --set {key} exclude each other; remove one")
    if label:
        options[key] = label
    if options and name is None:
        option, example = ("--set", "--set KEY=VALUE") if sets else ("--label", f"--label {label}")
        raise ConfigError(f"{option} needs a mission to start; name it, e.g. sightline mission r1 follow {example}")
    if name is not None:
        request_of(0, name, (), options)  # reports invalid values without a robot
    target = target_of(robot, connect, secure, announce=name is not None)
    with _missions(target) as missions:
        report = missions.report() if name is None else missions.request(name, options=options)
        return _print_report(target.robot, report, as_json, is_answer=name is not None)


def goto(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", autocompletion=complete_robot, help="Robot id.")],
    numbers: Annotated[
        list[str] | None, typer.Argument(metavar="X Y [X Y ...]", help="Waypoints in meters, in the odometry frame.")
    ] = None,
    *,
    file: Annotated[
        Path | None, typer.Option("--file", metavar="FILE", help="One waypoint X Y per line; # starts a comment.")
    ] = None,
    wait: Annotated[
        bool, typer.Option("--wait", help="Wait until the robot arrives (exit code 0) or cannot arrive (5).")
    ] = False,
    sets: Sets = None,
    connect: Connect = None,
    secure: Secure = "",
    as_json: Json = False,
) -> int:
    """Send a robot to one or more waypoints

    The robot drives around obstacles that it detects. Ctrl-C does not stop it; `sightline stop` does.
    """
    from sightline.operator_side.client.missions import cannot, mission_line, request_of
    from sightline.operator_side.config.toml_text import options_of

    if re.fullmatch(r"-?[0-9.]+", robot) and len(numbers or ()) % 2:
        raise ConfigError(f"the robot is missing: write sightline goto ROBOT {' '.join((robot, *(numbers or ())))}")
    waypoints, options = _waypoints(numbers or [], file), options_of(sets or ())
    request_of(0, "goto", waypoints, options)
    target = target_of(robot, connect, secure, announce=True)
    with _missions(target) as missions:
        report = missions.request("goto", waypoints, options)
        if report.refused or not wait:
            return _print_report(target.robot, report, as_json, is_answer=True)
        _print_obstacle(missions)
        shown = ""
        for report in missions.follow():
            before, shown = shown, mission_line(report)
            if not as_json and not report.done and shown != before:
                typer.echo(f"{target.robot}: {shown}")
        code = _print_report(target.robot, report, as_json, is_answer=True)
        return CHECK_FAILED if cannot(report) else code


_MAX_WAYPOINTS_BYTES = 1_000_000


def _waypoints(numbers: list[str], file: Path | None) -> "Waypoints":
    from sightline.operator_side.client.missions import waypoints_of, waypoints_of_file

    if file is None:
        return waypoints_of(numbers)
    if numbers:
        raise ConfigError("waypoints on the command line and --file exclude each other; remove one")
    try:
        with home_path(file).open("rb") as opened:
            content = opened.read(_MAX_WAYPOINTS_BYTES + 1)
        if len(content) > _MAX_WAYPOINTS_BYTES:  # e.g. /dev/zero
            raise ConfigError(f"cannot read {file}: more than {_MAX_WAYPOINTS_BYTES} bytes; name a file of waypoints")
        return waypoints_of_file(content.decode("utf-8-sig"), str(file))
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "not a text file"
        raise ConfigError(f"cannot read {file}: {why}; name a file with one waypoint X Y per line") from None


def _print_obstacle(missions: "MissionClient") -> None:
    """Print the command that is still necessary before the robot drives."""
    from sightline.operator_side.client.status import next_step

    robot, report = missions.operator.robot, missions.operator.report
    if report and (command := next_step(robot, report.status)):
        typer.echo(f"{robot} is {report.status.state} ({report.status.reason}); to drive, run `{command}`", err=True)


@contextmanager
def _missions(target: RobotAddress) -> "Iterator[MissionClient]":
    from sightline.operator_side.client.missions import MissionClient

    with _link(target, SOURCE) as link:
        yield MissionClient(link)


def _print_report(robot: str, report: MissionReport, as_json: bool, *, is_answer: bool) -> int:
    """Print a report. Returns exit code 5 if the vision service rejected the request."""
    from sightline.operator_side.client.missions import cannot, detector_line, mission_line

    refused = report.refused if is_answer else ""
    if as_json:
        ok = not refused and not cannot(report)
        typer.echo(json.dumps({"robot": robot, "ok": ok, **report.model_dump(mode="json")}))
    elif refused:
        typer.echo(f"error: the vision service of {robot} rejected the request: {printable(refused)}", err=True)
    else:
        typer.echo(f"{robot}: {mission_line(report)}")
        if not is_answer and report.detector:
            typer.echo(f"detector: {detector_line(report)}")
    return CHECK_FAILED if refused else 0


# --- `teleop` ----------------------------------------------------------------------------------------------------


_Gamepad = Annotated[
    str | None,
    typer.Option("--gamepad", metavar="DEVICE", help="Use a gamepad too: /dev/input/event5, or `auto` for the first."),
]


def teleop(
    robot: Robot = None,
    *,
    connect: Connect = None,
    secure: Secure = "",
    linear: Annotated[float, typer.Option(min=0.02, max=3, help="Initial speed, m/s.")] = 0.2,
    angular: Annotated[float, typer.Option(min=0.1, max=10, help="Initial turn rate, rad/s.")] = 1.0,
    keys: Annotated[
        str, typer.Option("--keys", metavar="LAYOUT", help="wasd, or legacy: u i o / j k l / m , .")
    ] = "wasd",
    gamepad: _Gamepad = None,
) -> None:
    """Drive a robot with the keyboard or a gamepad

    Hold W A S D or an arrow key to drive; Space stops, Enter sends STOP, Q quits. The first press arms.
    """
    from sightline.operator_side.client.stop import StopSender
    from sightline.operator_side.teleop.control import SOURCE as ROLE
    from sightline.operator_side.teleop.control import Speeds, Teleop, layout_of
    from sightline.operator_side.teleop.gamepad import Gamepad
    from sightline.operator_side.teleop.terminal import Cockpit, check_terminal

    layout = layout_of(keys)
    check_terminal()
    target, session = target_of(robot, connect, secure, announce=True), secrets.token_hex(4)
    with ExitStack() as ending:
        pad = Gamepad(gamepad) if gamepad else None
        if pad is not None:
            ending.callback(pad.close)
        link = ending.enter_context(_link(target, ROLE))
        secret_file = stop_secret_of(target, partial(typer.echo, err=True))
        steered = Teleop(session, Speeds(linear, angular), layout)
        Cockpit(link, steered, lambda: StopSender(target.robot, target.connect, secret_file), pad).run()
