"""Commands that set up a machine: keys, install, doctor. Shell."""

import getpass
import json
import os
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from sightline.operator_side.cli.options import print_result
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.doctor.finding import Finding, as_object
from sightline.operator_side.preflight import needs
from sightline.operator_side.setup import install as units
from sightline.protocol.transports.open import check_endpoint
from sightline.robot_side.config import RobotConfig

Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", metavar="NAME", help="Name or address at which machines reach each other; repeatable."),
]
Days = Annotated[int, typer.Option(min=1, max=825, help="How long they are valid.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of keys.")]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(help="Make and look at the certificates that --secure uses.", no_args_is_help=False,
                        rich_markup_mode=None)
    group.command(epilog="Example: sightline keys init keys --host robot.local --host 192.168.1.20")(init)
    group.command(epilog="Example: sightline keys add keys robot --host 10.0.0.7")(add)
    group.command(epilog="Example: sightline keys show keys")(show)
    app.add_typer(group, name="keys")
    app.command(epilog="Example: sightline install robot --config robot.toml --user pi")(install)
    app.command(epilog="Example: sightline doctor --peer tcp/192.168.1.20:7447")(doctor)


def _keys() -> ModuleType:
    with needs("secure"):
        import_module("cryptography.x509")
    from sightline.operator_side.setup import keys

    return keys


def init(folder: Folder, host: Hosts = None, days: Days = 825) -> None:
    """Make a private authority and certificates for robot, vision, operator, detector and viewer."""
    made = _keys()
    for file in made.make(folder, host or [], days):
        print(f"made {file}")
    print("copy ca.pem and the files of its role to each machine, every *.token to a robot that listens on wss://, and "
          f"ca.key to none; then: --secure {folder}")


def add(
    folder: Folder,
    role: Annotated[str, typer.Argument(help="robot, vision, operator, detector or viewer.")],
    host: Hosts = None,
    days: Days = 825,
) -> None:
    """Make the certificate of one role anew, e.g. for other addresses."""
    made = _keys()
    for file in made.add(folder, role, host or [], days):
        print(f"made {file}")


def show(folder: Folder, as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False) -> None:
    """Say of each certificate whose it is, for which hosts, and until when."""
    made = _keys()
    found = made.look(folder)
    if as_json:
        print(json.dumps([{"file": str(one.file), "role": one.role, "hosts": one.hosts,
                           "ends": one.ends.isoformat()} for one in found]))
        return
    for one in found:
        print(f"{one.file.name:14} {one.role:20} until {one.ends:%Y-%m-%d}  {', '.join(one.hosts)}")


# `sightline install robot|vision`: shows the systemd unit, and puts it in place with --yes. Shell.


def install(
    service: Annotated[str, typer.Argument(metavar="robot|vision", help="Which service.")],
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Its configuration [default: /etc/sightline/SERVICE.toml]."),
    ] = None,
    user: Annotated[str, typer.Option(help="Who runs it [default: you, by sudo too].")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Write it and begin, now and whenever the machine does.")] = False,
) -> None:
    """Run a service for good, by systemd; where a robot's drive is `gpio`, also what puts its pins low after every end.

    Without --yes it only shows what it would do.
    """
    program = Path(sys.executable).with_name("sightline")
    file = (config or Path(f"/etc/sightline/{service}.toml")).expanduser().absolute()  # systemd begins elsewhere
    runs_it = user or os.environ.get("SUDO_USER") or getpass.getuser()
    planned = units.plan(service, program, file, runs_it, units.UNIT_DIR)
    if not yes:
        _show(planned, _beside(service, program, file) if file.exists() else None)
        if service == "robot" and not file.exists():
            typer.echo(f"{file} is not there yet; if its drive is gpio, a second file puts the pins low", err=True)
        return
    beside = _beside(service, program, file)  # a service that cannot begin is not installed
    stale = units.drop_in_path(planned.path.parent)
    if service == "robot" and beside is None and units.take_away(stale):
        typer.echo(f"{stale} is gone: this robot's drive is not gpio")
    units.write(planned, beside)
    if beside is not None:
        typer.echo(f"{beside.path} is in place: the pins go low first whenever the robot ends")
    typer.echo(f"{planned.path} is in place and runs; look at it with: systemctl status {planned.path.stem}")


def _beside(service: str, program: Path, file: Path) -> units.InstallPlan | None:
    """Raises ConfigError where the service could not begin with this file."""
    loaded = load_service(service, file=str(file), environ={}).config
    return units.drop_in(loaded, program, file, units.UNIT_DIR) if isinstance(loaded, RobotConfig) else None


def _show(planned: units.InstallPlan, beside: units.InstallPlan | None) -> None:
    typer.echo(planned.text, nl=False)
    typer.echo(f"nothing is written; with --yes: this goes to {planned.path} and begins", err=True)
    if beside is not None:
        typer.echo(f"\n{beside.text}", nl=False)
        typer.echo(f"and this to {beside.path}: the pins go low first", err=True)


# `sightline doctor`: what is wrong here, or on the way to a robot, and the line that mends it. Shell.


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
    bad = sum(one.ok is False for one in found)
    last = f"{bad} of {len(found)} need mending" if bad else "nothing wrong found"
    return print_result(as_object(found), [last], as_json)


def _findings(robot: str, peer: str | None, camera: str | None, sets: list[str], secure: str) -> Iterator[Finding]:
    from sightline.operator_side.doctor import machine
    from sightline.operator_side.doctor import machine as cameras
    from sightline.operator_side.doctor import network as between

    yield from machine.findings(secure)
    yield from cameras.modes()
    if camera is not None:
        yield cameras.delivered(camera, sets)
    if peer is not None:
        yield from between.findings(peer, robot, secure)
