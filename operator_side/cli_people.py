"""Commands of a person at a robot: `robots`, `status`, `arm`, `disarm`, `stop`, `reset`. Shell."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any

import typer

from operator_side.requests import SOURCE, Operator, read_report
from operator_side.status_text import status_line, status_lines
from protocol.errors import LinkError, WireError
from protocol.messages import Reply, Status, Verb
from protocol.transports.link import Message
from protocol.transports.opening import open_link
from protocol.transports.zenoh import list_robots
from robot_side.config import DEFAULT_ENDPOINT

REFUSED_EXIT = 5

Robot = Annotated[str, typer.Argument(metavar="[ROBOT]", help="The robot's id.")]
Connect = Annotated[list[str], typer.Option("--connect", metavar="ENDPOINT", help="Where the robot or router listens.")]
Secure = Annotated[
    str, typer.Option("--secure", metavar="DIR", help="Keys made by `sightline keys`; endpoints are then tls/...")
]
Json = Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")]
DEFAULT_CONNECT = [DEFAULT_ENDPOINT]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline robots --connect tcp/192.168.1.20:7447")(robots)
    app.command(epilog="Example: sightline status r1 --watch")(status)
    app.command(epilog="Example: sightline arm r1 --connect tcp/192.168.1.20:7447")(arm)
    app.command(epilog="Example: sightline disarm")(disarm)
    app.command(epilog="Example: sightline stop")(stop)
    app.command(epilog="Example: sightline reset && sightline arm")(reset)


def robots(
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    seconds: Annotated[float, typer.Option(min=0.2, max=60, help="How long to listen.")] = 1.0,
    as_json: Json = False,
) -> None:
    """List the robots that are heard."""
    heard = list_robots(connect, seconds, secure)
    if as_json:
        typer.echo(json.dumps({"robots": [_as_object(name, heard[name]) for name in sorted(heard)]}))
        return
    for name in sorted(heard):
        typer.echo(_heard_line(name, heard[name]))
    if not heard:
        raise LinkError(f"no robot is heard at {', '.join(connect)} within {seconds:g} s; start one: sightline robot")


def _heard_line(name: str, message: Message) -> str:
    try:
        return status_line(name, read_report(message).status)
    except WireError as error:
        return f"{name}: not understood: {error.detail}"


def _as_object(name: str, message: Message) -> dict[str, Any]:
    try:
        return {"robot": name, **read_report(message).status.model_dump(mode="json")}
    except WireError as error:
        return {"robot": name, "error": error.detail}


def status(
    robot: Robot = "r1",
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    watch: Annotated[bool, typer.Option("--watch", help="Once a second, until Ctrl-C.")] = False,
    as_json: Json = False,
) -> None:
    """Say what a robot does and why: state, driver, twist, frame age, latency, every refusal."""
    with _operator(robot, connect, secure) as operator:
        while True:
            report = operator.wait_report()
            if as_json:
                typer.echo(json.dumps({"robot": robot, **report.status.model_dump(mode="json")}))
            else:
                typer.echo("\n".join(status_lines(robot, report.status)) + ("\n" if watch else ""))
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
        return _tell(robot, operator.arm(wait), as_json)


def disarm(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> int:
    """Wheels to zero; commands are judged but not obeyed until armed again."""
    with _operator(robot, connect, secure) as operator:
        return _tell(robot, operator.ask(Verb.DISARM), as_json)


def reset(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> int:
    """Leave STOPPED or FAULT. Permits arming, starts nothing."""
    with _operator(robot, connect, secure) as operator:
        return _tell(robot, operator.ask(Verb.RESET), as_json)


def stop(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> None:
    """STOP a robot: wheels to zero, latched until `sightline reset`. Not an emergency stop: it needs the network."""

    def on_slow() -> None:
        typer.echo(f"STOP of {robot} is not confirmed yet; repeating. Be ready to cut its power by hand", err=True)

    with _operator(robot, connect, secure) as operator:
        _tell_stopped(robot, operator.stop(on_slow), as_json)


def _tell_stopped(robot: str, state: Status, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps({"robot": robot, "ok": True, "state": state.state, "detail": state.reason}))
    else:
        typer.echo(status_line(robot, state))


def _tell(robot: str, reply: Reply, as_json: bool) -> int:
    """Print a reply; exit code 5 if the robot refused."""
    if as_json:
        typer.echo(json.dumps({"robot": robot, "ok": reply.ok, "state": reply.state, "detail": reply.detail}))
    elif reply.ok:
        typer.echo(f"{robot}: {reply.detail} ({reply.state})")
    else:
        typer.echo(f"error: {robot} refused: {reply.detail}", err=True)
    return 0 if reply.ok else REFUSED_EXIT


@contextmanager
def _operator(robot: str, connect: list[str], secure: str) -> Iterator[Operator]:
    with open_link(robot, connect=connect, role=SOURCE, secure=secure) as link:
        yield Operator(link)
