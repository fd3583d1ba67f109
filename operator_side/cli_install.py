"""`sightline install robot|vision`: shows the systemd unit, and puts it in place with --yes. Shell."""

import getpass
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from sightline.operator_side.setup import install as units
from sightline.operator_side.service_settings import load_service
from sightline.robot_side.config import RobotConfig


def register_install(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline install robot --config robot.toml --user pi")(install)


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


def _beside(service: str, program: Path, file: Path) -> units.Plan | None:
    """Raises ConfigError where the service could not begin with this file."""
    loaded = load_service(service, file=str(file), environ={}).config
    return units.drop_in(loaded, program, file, units.UNIT_DIR) if isinstance(loaded, RobotConfig) else None


def _show(planned: units.Plan, beside: units.Plan | None) -> None:
    typer.echo(planned.text, nl=False)
    typer.echo(f"nothing is written; with --yes: this goes to {planned.path} and begins", err=True)
    if beside is not None:
        typer.echo(f"\n{beside.text}", nl=False)
        typer.echo(f"and this to {beside.path}: the pins go low first", err=True)
