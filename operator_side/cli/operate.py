"""Commands of a person at a robot: `robots`, `status`, `arm`, `disarm`, `stop`, `reset`. Shell."""

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from sightline.operator_side.around import discover_all
from sightline.operator_side.cli.options import (
    DEFAULT_CONNECT,
    REJECTED_EXIT,
    Connect,
    Json,
    MaybeConnect,
    Robot,
    Secure,
)
from sightline.operator_side.mission_asking import MissionClient
from sightline.operator_side.mission_text import mission_lines
from sightline.operator_side.pictures import viewer_role
from sightline.operator_side.client.requests import SOURCE, Operator
from sightline.operator_side.client.status import status_line, status_lines
from sightline.protocol.messages import Reply, Status, Verb
from sightline.protocol.transports.open import open_link

_REPORT_S = 0.8  # vision reports twice a second; where one drives, that is worth waiting for

def register_operator(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline robots --connect tcp/192.168.1.20:7447")(robots)
    app.command(epilog="Example: sightline status r1 --watch")(status)
    app.command(epilog="Example: sightline arm r1 --connect tcp/192.168.1.20:7447")(arm)
    app.command(epilog="Example: sightline disarm")(disarm)
    app.command(epilog="Example: sightline stop")(stop)
    app.command(epilog="Example: sightline reset && sightline arm")(reset)


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
        desk = MissionClient(link)
        while True:
            state = desk.operator.wait_report().status
            seen_to = state.holder is not None and state.holder.source == "vision"
            mission = desk.newest(_REPORT_S if seen_to else 0.0)
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
        return _print_reply(robot, operator.ask(Verb.DISARM), as_json)


def reset(robot: Robot = "r1", connect: Connect = DEFAULT_CONNECT, secure: Secure = "", as_json: Json = False) -> int:
    """Leave STOPPED or FAULT. Permits arming, starts nothing."""
    with _operator(robot, connect, secure) as operator:
        return _print_reply(robot, operator.ask(Verb.RESET), as_json)


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
