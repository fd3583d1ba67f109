"""`sightline doctor`: what is wrong here, or on the way to a robot, and the line that mends it. Shell."""

import json
from collections.abc import Iterator
from typing import Annotated

import typer

from sightline.operator_side.doctor.finding import Finding, as_object
from sightline.protocol.transports.open import check_endpoint


def register_doctor(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline doctor --peer tcp/192.168.1.20:7447")(doctor)


def doctor(
    *,
    robot: Annotated[str, typer.Argument(metavar="[ROBOT]", help="The robot's id.")] = "r1",
    peer: Annotated[
        str | None, typer.Option("--peer", metavar="ENDPOINT", help="Also look at the way to this robot or router.")
    ] = None,
    camera: Annotated[
        str | None, typer.Option("--camera", metavar="KIND", help="Also look at a camera of this machine, e.g. v4l2.")
    ] = None,
    camera_sets: Annotated[
        list[str] | None, typer.Option("--camera-set", metavar="KEY=VALUE", help="An option of it, e.g. fps=15.")
    ] = None,
    secure: Annotated[str, typer.Option("--secure", metavar="DIR", help="Keys made by `sightline keys`.")] = "",
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> int:
    """Look for what commonly goes wrong, and say the exact line that mends it. Exit code 5 if something is wrong."""
    if peer is not None:
        check_endpoint(peer)
    found: list[Finding] = []
    for finding in _findings(robot, peer, camera, camera_sets or [], secure):
        found.append(finding)
        if not as_json:
            typer.echo(finding.line)
    report = as_object(found)
    if as_json:
        typer.echo(json.dumps(report))
    else:
        bad = sum(one.ok is False for one in found)
        typer.echo(f"{bad} of {len(found)} need mending" if bad else "nothing wrong found")
    return 0 if report["ok"] else 5


def _findings(robot: str, peer: str | None, camera: str | None, sets: list[str], secure: str) -> Iterator[Finding]:
    from sightline.operator_side.doctor import network as between, cameras, machine

    yield from machine.findings(secure)
    yield from cameras.modes()
    if camera is not None:
        yield cameras.delivered(camera, sets)
    if peer is not None:
        yield from between.findings(peer, robot, secure)
