"""Commands that set up a machine: use, keys, install, doctor. Shell."""

import getpass
import json
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import chdir, suppress
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from sightline.operator_side.cli.options import (
    CameraKind,
    CameraSets,
    Json,
    Robot,
    RobotName,
    Secure,
    check_camera_sets,
    command_group,
    first_given,
    plugin_prints,
    print_result,
)
from sightline.operator_side.cli.services import check_names
from sightline.operator_side.client.pictures import viewer_role
from sightline.operator_side.client.requests import Operator
from sightline.operator_side.config import context as contexts
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.doctor.finding import Finding, as_object
from sightline.operator_side.preflight import needs
from sightline.operator_side.setup import install as units
from sightline.operator_side.table import print_table
from sightline.protocol.errors import ConfigError, LinkError, home_path
from sightline.protocol.transports.endpoints import check_endpoint, check_robot_id
from sightline.protocol.transports.open import open_link
from sightline.robot_side.config import RobotConfig

ANSWER_S = 5.0
"""Time limit for an answer from the address of `sightline use`."""

Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", metavar="NAME", help="Name or address of a listening machine; repeatable."),
]
Days = Annotated[int, typer.Option(min=1, max=825, help="Days that a certificate of a role is valid.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of keys.")]


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline use tcp/192.168.1.20:7447 --robot r1")(use)
    group = command_group("Create or show certificates for secure links")
    group.command(epilog="Example: sightline keys init keys --host robot.local --host 192.168.1.20")(init)
    group.command(epilog="Example: sightline keys add keys robot --host 10.0.0.7")(add)
    group.command(epilog="Example: sightline keys show keys")(show)
    app.add_typer(group, name="keys")
    app.command(epilog="Example: sightline install robot --config robot.toml --user pi")(install)
    app.command(epilog="Example: sightline doctor --peer tcp/192.168.1.20:7447")(doctor)


def use(
    address: Annotated[
        str | None, typer.Argument(metavar="ADDRESS", help="Address of the robot or router, e.g. tcp/ROBOT:7447.")
    ] = None,
    robot: RobotName = None,
    *,
    secure: Secure = "",
    clear: Annotated[bool, typer.Option("--clear", help="Remove the saved address.")] = False,
    no_check: Annotated[bool, typer.Option("--no-check", help="Save it even if it does not answer.")] = False,
    as_json: Json = False,
) -> None:
    """Save, show or clear the default robot address

    Client commands use --connect, else SIGHTLINE_CONNECT, else this address. Services ignore it.
    """
    options = {f"--robot {robot}": robot is not None, f"--secure {secure}": secure, "--no-check": no_check}
    if address is None and (option := first_given(options)):
        raise ConfigError(f"{option.split()[0]} needs ADDRESS; write sightline use ADDRESS {option}")
    path = contexts.context_path(os.environ)
    if path is None:
        raise ConfigError("this user has no home folder; set XDG_CONFIG_HOME to a folder that you may write")
    if clear:
        if address is not None:
            raise ConfigError(f"--clear and address '{address}' exclude each other; remove one")
        removed = contexts.clear_context(path)
        _print_use({"cleared": removed}, "saved address cleared" if removed else "no saved address", as_json)
        return
    if address is None:
        _show_target(as_json)
        return
    check_endpoint(address)
    robot = contexts.DEFAULT_ROBOT if robot is None else robot
    context = contexts.Context(address, check_robot_id(robot), _folder(secure))
    note = "" if no_check else _answer(context)
    contexts.write_context(path, context)
    saved = f"saved robot {robot} at {address} to {contexts.shown(path)}{note}"
    _print_use({"connect": address, "robot": robot, "secure": context.secure, "file": str(path)}, saved, as_json)


def _show_target(as_json: bool) -> None:
    target = contexts.find_address(os.environ, None, None)
    keys = f", keys {target.secure}" if target.secure else ""
    shown = {"connect": ",".join(target.connect), "robot": target.robot, "secure": target.secure,
             "origin": target.origin}
    _print_use(shown, f"{target}{keys}", as_json)


def _print_use(values: Mapping[str, object], line: str, as_json: bool) -> None:
    typer.echo(json.dumps(values) if as_json else line)


def _folder(secure: str) -> str:
    """Return the absolute path, because a later command may start in another folder."""
    return str(home_path(secure).absolute()) if secure else ""


def _answer(context: contexts.Context) -> str:
    """Connect to the address. Returns a note if its robot is silent. Raises LinkError without an answer."""
    role = viewer_role(context.secure)
    try:
        with open_link(
            context.robot, connect=[context.connect], role=role, secure=context.secure, timeout_s=ANSWER_S
        ) as link:
            Operator(link).wait_report()
    except LinkError as error:
        if not str(error).startswith("no status"):
            raise LinkError(f"{error}; or save the address with --no-check") from None
        return f"; note: {error}"
    return ""


def _keys() -> ModuleType:
    with needs("secure"):
        import_module("cryptography.x509")
    from sightline.operator_side.setup import keys

    return keys


def init(folder: Folder, host: Hosts = None, days: Days = 825) -> None:
    """Create an authority and the certificates of all roles

    The roles are robot, vision, operator, detector, viewer and router.
    """
    made = _keys()
    for file in made.make(home_path(folder), host or [], days):
        print(f"wrote {file}")
    if not host:
        print("these certificates are valid on this machine only; for others make another folder with --host NAME",
              file=sys.stderr)
    print("copy ca.pem and the files of its role to each machine, every *.token to a robot that listens on wss://, and "
          "stop.secret to robots, routers and operators; "
          f"copy ca.key to no machine; then use --secure {folder}")


def add(
    folder: Folder,
    role: Annotated[
        str, typer.Argument(metavar="ROLE", help="robot, vision, operator, detector, viewer, router or stop.")
    ],
    host: Hosts = None,
    days: Days = 825,
) -> None:
    """Create the certificate of one role again

    Without --host it keeps its addresses. `stop` creates the secret of STOP datagrams.
    """
    made, role_file = _keys(), f"{role}.pem"
    for file in made.add(home_path(folder), role, host or [], days):
        print(f"wrote {file}")
    with suppress(ConfigError):  # another certificate is damaged
        for one in made.look(home_path(folder)):
            if one.file.name == role_file and one.ends_with_authority:
                print(f"{role_file} ends with its authority, on {one.ends:%Y-%m-%d}; for a longer time create new "
                      f"keys: sightline keys init {folder}-new", file=sys.stderr)


def show(folder: Folder, as_json: Json = False) -> None:
    """Show role, hosts and validity of each certificate"""
    made, now = _keys(), datetime.now(UTC)
    found = made.look(home_path(folder))
    if as_json:
        print(json.dumps([{"file": str(one.file), "role": one.role, "hosts": one.hosts, "problem": one.problem(now),
                           "begins": one.begins.isoformat(), "ends": one.ends.isoformat()} for one in found]))
        return
    print_table((one.file.name, one.role, one.problem(now) or f"until {one.ends:%Y-%m-%d}", ", ".join(one.hosts))
                for one in found)


# --- `install` ---------------------------------------------------------------------------------------------------


def install(
    service: Annotated[
        str, typer.Argument(metavar="robot|vision", autocompletion=lambda: units.SERVICES, help="Service to install.")
    ],
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Its configuration [default: /etc/sightline/SERVICE.toml]."),
    ] = None,
    user: Annotated[str, typer.Option(help="Account of the service [default: yours, under sudo too].")] = "",
    instances: Annotated[
        int | None,
        typer.Option("--instances", metavar="N", min=1, max=units.MAX_INSTANCES,
                     help="Number of vision services that share the robots."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Write the unit, start it, and enable it at boot.")] = False,
) -> None:
    """Install a service under systemd

    Without --yes it only prints the files. For a `gpio` drive, a second file sets the pins low after each end.
    """
    program = Path(sys.executable).with_name("sightline")
    file = home_path(config or Path(f"/etc/sightline/{service}.toml")).absolute()  # systemd changes the folder
    if ".." in file.parts:  # systemd ignores such a WorkingDirectory
        file = file.parent.resolve() / file.name
    runs_it = user or os.environ.get("SUDO_USER") or getpass.getuser()
    planned, beside = units.plan(service, program, file, runs_it, units.UNIT_DIR, instances=instances), None
    # Only a service that can start is installed.
    loaded = load_service(service, file=str(file), environ={}).config if yes or file.exists() else None
    state_dir = None
    if isinstance(loaded, RobotConfig):
        beside = units.drop_in(loaded, program, file, units.UNIT_DIR)
        if loaded.state_dir != RobotConfig().state_dir:
            state_dir = loaded.state_dir
            planned = units.with_state_in(planned, state_dir)
    if not yes:
        _show(planned, beside)
        if not file.exists():
            second = "; with a gpio drive in it, a second file sets the pins low" if service == "robot" else ""
            typer.echo(f"{file} does not exist yet{second}; create it before --yes", err=True)
        return
    units.check_user(runs_it, program, file)
    with chdir(file.parent):  # the folder of the service, from which it loads plug-ins
        check_names(loaded)
    if state_dir is not None and not state_dir.is_dir():  # systemd would not start the service
        raise ConfigError(f"state_dir {state_dir} does not exist; run: sudo install -d -o {runs_it} {state_dir}")
    stale = units.drop_in_path(planned.path.parent)
    if service == "robot" and beside is None and units.take_away(stale):
        typer.echo(f"removed {stale}: the drive of this robot is not gpio")
    for unit in units.write(planned, beside):
        typer.echo(f"ended {unit}: it is not one of the units of this command")
    if beside is not None:
        typer.echo(f"wrote {beside.path}: the pins are set low first whenever the robot ends")
    started = planned.path.stem if instances is None else f"'{planned.path.stem}*'"
    typer.echo(f"wrote and started {planned.path}; check it with: systemctl status {started}")


def _show(planned: units.InstallPlan, beside: units.InstallPlan | None) -> None:
    typer.echo(planned.text, nl=False)
    started = "it" if "@" not in planned.path.stem else f"{planned.units[0]} to {planned.units[-1]}"
    typer.echo(f"nothing written; --yes writes this to {planned.path} and starts {started}", err=True)
    if beside is not None:
        typer.echo(f"\n{beside.text}", nl=False)
        typer.echo(f"and this to {beside.path}, which sets the pins low first", err=True)


# --- `doctor` ----------------------------------------------------------------------------------------------------


def doctor(
    *,
    robot: Robot = None,
    peer: Annotated[
        str | None,
        typer.Option("--peer", metavar="ENDPOINT",
                     help="Also check the link to it [default: SIGHTLINE_CONNECT or `sightline use`, if set; with "
                          "ROBOT, this machine]."),
    ] = None,
    camera: CameraKind = None,
    camera_sets: CameraSets = None,
    secure: Secure = "",
    as_json: Json = False,
) -> int:
    """Find common problems and print how to fix them

    It checks this machine, and with an address the link to a robot. Exit code 5 means that it found a problem.
    """
    if robot and "/" in robot:
        raise ConfigError(f"robot '{robot}' is an address; run `sightline doctor --peer {robot}`")
    check_camera_sets(camera, camera_sets)
    target = contexts.target_of(robot, None if peer is None else [peer], secure)
    peers = () if target.origin == "default" and robot is None else target.connect
    if peers and peer is None:
        typer.echo(str(target), err=True)
    found: list[Finding] = []
    with plugin_prints(as_json):
        for finding in _findings(target._replace(connect=peers), camera, camera_sets or []):
            found.append(finding)
            if not as_json:
                typer.echo(finding.line)
    bad = sum(one.ok is False for one in found)
    last = f"{bad or 'no'} problem{'s' if bad > 1 else ''} in {len(found)} checks"
    return print_result(as_object(found), [last], as_json)


def _findings(target: contexts.RobotAddress, camera: str | None, sets: list[str]) -> Iterator[Finding]:
    from sightline.operator_side.doctor import machine
    from sightline.operator_side.doctor import machine as cameras
    from sightline.operator_side.doctor import network as between

    yield from machine.findings(target.secure)
    yield from cameras.modes()
    if camera is not None:
        yield cameras.delivered(camera, sets)
    for peer in target.connect:
        yield from between.findings(peer, target.robot, target.secure)
