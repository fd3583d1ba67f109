"""Options and exit codes that several command groups share. Shell (typer)."""

import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from typing import Annotated, Any, Final, TypeVar

import typer

from sightline.operator_side.config.context import find_address
from sightline.protocol.config import PluginRegistry
from sightline.protocol.errors import CheckError, ConfigError

CHECK_FAILED: Final = CheckError.exit_code
"""Exit code: a check failed, or the robot rejected the request."""

# What a shell completes. These functions import no plug-in and open no link.
complete_camera, complete_detector, complete_mission = (
    PluginRegistry(kind, f"sightline.{kind}s").names for kind in ("camera", "detector", "mission")
)


def complete_scenario() -> list[str]:
    """Return the names of the scenarios."""
    from sightline.sim.scenario import scenario_names

    return scenario_names()


def complete_robot_model() -> list[str]:
    """Return the names of the simulated robots."""
    from sightline.sim.robot import robot_names

    return robot_names()


def complete_robot() -> list[str]:
    """Return the robot of `sightline use`, or the default. Returns no robot if a saved or given address is invalid."""
    with suppress(ConfigError):
        return [find_address(os.environ, None, None).robot]
    return []


Robot = Annotated[
    str | None,
    typer.Argument(metavar="ROBOT", autocompletion=complete_robot,
                   help="Robot id [default: the one of `sightline use`, or r1]."),
]

Connect = Annotated[
    list[str] | None,
    typer.Option(
        "--connect", metavar="ENDPOINT",
        help="Address of the robot or router [default: SIGHTLINE_CONNECT, `sightline use`, or tcp/127.0.0.1:7447].",
    ),
]  # fmt: skip

Secure = Annotated[
    str, typer.Option("--secure", metavar="DIR", help="Folder of `sightline keys`, for tls/ and wss:// endpoints.")
]

MaybeSecure = Annotated[
    str | None,
    typer.Option("--secure", metavar="DIR", help="Folder of `sightline keys`, for tls/ and wss:// endpoints."),
]

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object, for scripts.")]

ConfigFile = Annotated[
    str | None, typer.Option("--config", metavar="FILE", help="TOML file; see `sightline config --help`.")
]

ServiceConnect = Annotated[
    list[str] | None,
    typer.Option("--connect", metavar="ENDPOINT", help="Connect to this address, e.g. tcp/192.168.1.20:7447."),
]

Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Set one value; `sightline config show SERVICE` lists all."),
]

Listen = Annotated[
    list[str] | None,
    typer.Option("--listen", metavar="ENDPOINT", help="Listen here, e.g. tcp/0.0.0.0:7447 or ws://0.0.0.0:9090."),
]

RobotName = Annotated[str | None, typer.Option("--robot", metavar="ID", help="Robot id [default: r1].")]

LogForm = Annotated[
    str | None, typer.Option("--log", metavar="FORM", help="text, or json: one object per line [default: text].")
]

SocketDir = Annotated[
    str | None, typer.Option("--socket-dir", metavar="DIR", help="Folder of the simulation's sockets.")
]

Port = Annotated[
    int, typer.Option("--port", min=0, max=65535, help="Port of the page on this machine; 0 takes a free one.")
]

Device = Annotated[str | None, typer.Option("--device", help="auto, cpu, cuda or tensorrt [default: auto].")]

CameraKind = Annotated[
    str | None,
    typer.Option("--camera", metavar="KIND", autocompletion=complete_camera,
                 help="A camera of this machine: v4l2, picamera, video ..."),
]

ScenarioNames = Annotated[
    str, typer.Option("--scenario", autocompletion=complete_scenario, help="`all`, or names separated by commas.")
]

DetectorName = Annotated[
    str | None,
    typer.Option("--detector", metavar="NAME", autocompletion=complete_detector,
                 help="Detector, see `sightline detector list` [default: auto]."),
]

CameraSets = Annotated[
    list[str] | None,
    typer.Option("--camera-set", metavar="KEY=VALUE", help="An option of the camera, e.g. device=/dev/video2."),
]

Number = TypeVar("Number", int, float)


@contextmanager
def plugin_prints(as_json: bool) -> Iterator[None]:
    """With `--json`, redirect the output of plug-ins and their C code to stderr: stdout contains only the result."""
    if not as_json:
        yield
        return
    import ctypes

    sys.stdout.flush()
    stdout = os.dup(1)
    try:
        os.dup2(2, 1)
        with redirect_stdout(sys.stderr):
            yield
    finally:
        sys.stdout.flush()  # of a plug-in that imported it by name
        ctypes.CDLL(None).fflush(None)  # C keeps in its buffer what it prints to a pipe
        os.dup2(stdout, 1)
        os.close(stdout)


def print_result(result: dict[str, Any], lines: Iterable[str], as_json: bool) -> int:
    """Print the result of a command with checks as JSON or as `lines`, and return the exit code.

    A result whose `ok` is missing or None cannot fail.
    """
    for line in (json.dumps(_finite(result), allow_nan=False),) if as_json else lines:
        typer.echo(line)
    return CHECK_FAILED if result.get("ok") is False else 0


def _finite(value: Any) -> Any:
    """Replace each number that JSON does not support, e.g. an infinite limit, by None."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def first_given(given: Mapping[str, object]) -> str:
    """Return the first option with a value, or ""."""
    return next((option for option, is_given in given.items() if is_given), "")


def check_camera_sets(camera: str | None, camera_sets: list[str] | None) -> None:
    """Raise ConfigError for camera options without a camera."""
    if camera_sets and camera is None:
        raise ConfigError("--camera-set needs --camera; name a camera, e.g. --camera v4l2")


def numbers(option: str, text: str, kind: Callable[[str], Number]) -> list[Number]:
    """Parse the numbers of an option, separated by commas. Raises ConfigError with an example."""
    try:
        return [kind(part) for part in text.split(",")]
    except ValueError:
        raise ConfigError(
            f"invalid {option} '{text}': expected numbers separated by commas, e.g. {option} 1,2,3"
        ) from None


def command_group(summary: str) -> typer.Typer:
    """Create a group of subcommands. Without a subcommand it lists them."""
    group = typer.Typer(help=summary, rich_markup_mode=None, invoke_without_command=True)
    group.callback(invoke_without_command=True)(_list_subcommands)
    return group


def _list_subcommands(context: typer.Context) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
