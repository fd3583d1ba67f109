"""Options and exit codes that several command groups share. Shell (typer)."""

import json
from collections.abc import Callable, Iterable
from typing import Annotated, Any, TypeVar

import typer

from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT

REJECTED_EXIT = 5

CHECK_FAILED = 5

DEFAULT_CONNECT = [DEFAULT_ENDPOINT]

Robot = Annotated[str, typer.Argument(metavar="[ROBOT]", help="The robot's id.")]

Connect = Annotated[list[str], typer.Option("--connect", metavar="ENDPOINT", help="Where the robot or router listens.")]

MaybeConnect = Annotated[
    list[str] | None, typer.Option("--connect", metavar="ENDPOINT", help="Where a robot or router listens.")
]

Secure = Annotated[
    str, typer.Option("--secure", metavar="DIR", help="Keys made by `sightline keys`; endpoints are then tls/...")
]

_SECURE = typer.Option("--secure", metavar="DIR", help="Keys made by `sightline keys`; endpoints are then tls/...")

MaybeSecure = Annotated[str | None, _SECURE]

Json = Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")]

ConfigFile = Annotated[str | None, typer.Option("--config", metavar="FILE", help="TOML file; see `sightline config`.")]

ServiceConnect = Annotated[
    list[str] | None, typer.Option("--connect", metavar="ENDPOINT", help="Connect here, e.g. tcp/192.168.1.20:7447.")
]

Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one value; `sightline config show SERVICE` lists the keys."),
]

Listen = Annotated[
    list[str] | None, typer.Option("--listen", metavar="ENDPOINT", help="Listen here, e.g. tcp/0.0.0.0:7447 or ws://0.0.0.0:9090.")
]

RobotName = Annotated[str | None, typer.Option("--robot", metavar="ID", help="The robot's id [default: r1].")]

LogForm = Annotated[
    str | None, typer.Option("--log", metavar="FORM", help="text, or json: one object a line [default: text].")
]

SocketDir = Annotated[
    str | None, typer.Option("--socket-dir", metavar="DIR", help="Where the simulation's sockets are.")
]

Port = Annotated[int, typer.Option("--port", min=0, max=65535, help="Of the page, on this machine; 0 is any free one.")]

Device = Annotated[str | None, typer.Option("--device", help="auto, cpu, cuda or tensorrt [default: auto].")]

Number = TypeVar("Number", int, float)


def print_result(result: dict[str, Any], lines: Iterable[str], as_json: bool) -> int:
    """Print the result of a command with checks: as JSON, or as `lines`. Returns its exit code.

    A result without `ok` has nothing that can fail.
    """
    for line in (json.dumps(result),) if as_json else lines:
        typer.echo(line)
    return 0 if result.get("ok", True) else CHECK_FAILED


def numbers(option: str, text: str, kind: Callable[[str], Number]) -> list[Number]:
    """The numbers of an option, separated by commas. Raises ConfigError with an example."""
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(f"{option} {text!r}: numbers separated by commas, e.g. {option} 1,2,3") from None
