"""`sightline keys`: certificates for `--secure`. Shell."""

import json
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated

import typer

from sightline.operator_side.preflight import needs

Hosts = Annotated[
    list[str] | None,
    typer.Option("--host", metavar="NAME", help="Name or address at which machines reach each other; repeatable."),
]
Days = Annotated[int, typer.Option(min=1, max=825, help="How long they are valid.")]
Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of keys.")]


def register_keys(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(help="Make and look at the certificates that --secure uses.", no_args_is_help=False,
                        rich_markup_mode=None)
    group.command(epilog="Example: sightline keys init keys --host robot.local --host 192.168.1.20")(init)
    group.command(epilog="Example: sightline keys add keys robot --host 10.0.0.7")(add)
    group.command(epilog="Example: sightline keys show keys")(show)
    app.add_typer(group, name="keys")


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
