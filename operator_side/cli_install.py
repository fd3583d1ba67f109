"""`sightline install robot|vision`: shows the systemd unit, and puts it in place with --yes. Shell."""

import getpass
import sys
from pathlib import Path
from typing import Annotated

import typer

from operator_side import install as units
from operator_side.service_settings import load_service


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command(epilog="Example: sightline install robot --config robot.toml --user pi")(install)


def install(
    service: Annotated[str, typer.Argument(metavar="robot|vision", help="Which service.")],
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="FILE", help="Its configuration [default: /etc/sightline/SERVICE.toml]."),
    ] = None,
    user: Annotated[str, typer.Option(help="Who runs it [default: you].")] = "",
    yes: Annotated[bool, typer.Option("--yes", help="Write it and begin, now and whenever the machine does.")] = False,
) -> None:
    """Run a service for good, by systemd. Without --yes it only shows what it would do."""
    program, file = Path(sys.executable).with_name("sightline"), config or Path(f"/etc/sightline/{service}.toml")
    planned = units.plan(service, program, file, user or getpass.getuser())
    if not yes:
        typer.echo(planned.text, nl=False)
        typer.echo(f"nothing is written; with --yes: this goes to {planned.path} and begins", err=True)
        return
    load_service(service, file=str(file), environ={})  # a service that cannot begin is not installed
    units.write(planned)
    typer.echo(f"{planned.path} is in place and runs; look at it with: systemctl status {planned.path.stem}")
