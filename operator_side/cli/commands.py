"""The table of all commands. A command's module is imported when the command is used. Shell.

The help of the program comes from the table, so it imports no command.
"""

from collections.abc import Iterator, Mapping
from functools import cache
from importlib import import_module
from typing import Annotated, Any, Final, NamedTuple

import typer
from typer.core import TyperGroup

EXIT_CODES: Final = {
    0: "success",
    1: "unexpected error; please report it",
    2: "invalid usage or configuration",
    3: "a device or the simulation cannot be used",
    4: "no connection, or no answer",
    5: "a check failed, or the robot rejected the request",
    130: "interrupted by Ctrl-C",
    141: "the program that reads the output has ended",
}
"""Exit codes of all commands, with their meaning."""


class Entry(NamedTuple):
    """A command in the program's help: its heading, the module in this folder that registers it, its summary."""

    heading: str
    module: str
    summary: str


COMMANDS: Final = {
    "demo": Entry("Run", "evaluate", "Simulate, drive, score and film a run on this machine"),
    "sim": Entry("Run", "services", "Simulate a robot's hardware"),
    "robot": Entry("Run", "services", "Run a robot: motors, camera and link"),
    "vision": Entry("Run", "services", "Run a vision service that steers a robot"),
    "router": Entry("Run", "services", "Run a router to which all machines of a site connect"),
    "scenarios": Entry("Run", "services", "List scenarios, or write the configuration of one"),
    "arm": Entry("Drive", "operate", "Arm a robot so that it may move"),
    "disarm": Entry("Drive", "operate", "Stop the wheels and disarm a robot"),
    "stop": Entry("Drive", "operate", "STOP a robot and latch the stop until reset"),
    "reset": Entry("Drive", "operate", "Clear a latched STOP or a drive fault"),
    "teleop": Entry("Drive", "operate", "Drive a robot with the keyboard or a gamepad"),
    "mission": Entry("Drive", "operate", "Show or start a robot's mission"),
    "goto": Entry("Drive", "operate", "Send a robot to one or more waypoints"),
    "robots": Entry("Observe", "operate", "List robots and the services connected to them"),
    "status": Entry("Observe", "operate", "Show a robot's state and its reason"),
    "watch": Entry("Observe", "watch", "Show a robot's images or messages live"),
    "capture": Entry("Observe", "watch", "Save an image, a video or a recording of a robot"),
    "metrics": Entry("Observe", "services", "Serve a robot's status to Prometheus"),
    "use": Entry("Set up", "admin", "Save, show or clear the default robot address"),
    "config": Entry("Set up", "services", "Check or show a service's configuration"),
    "keys": Entry("Set up", "admin", "Create or show certificates for secure links"),
    "install": Entry("Set up", "admin", "Install a service under systemd"),
    "doctor": Entry("Set up", "admin", "Find common problems and print how to fix them"),
    "calibrate": Entry("Set up", "calibrate", "Measure a robot's camera or drive"),
    "pick-color": Entry("Set up", "calibrate", "Pick the target's color in an image"),
    "score": Entry("Evaluate", "evaluate", "Score missions over many starts in virtual time"),
    "faults": Entry("Evaluate", "evaluate", "Inject faults into real processes and check each stop"),
    "bench": Entry("Evaluate", "bench", "Measure performance on this machine"),
    "conform": Entry("Develop", "conform", "Test a robot, vision service or codec against the protocol"),
    "detector": Entry("Develop", "detector", "List, check or serve detectors"),
    "labels": Entry("Develop", "services", "Publish the simulation's labels in place of a detector"),
    "train": Entry("Develop", "evaluate", "Train the learned detector"),
}
"""All commands, in the order of the help."""

class _Commands(Mapping[str, Any]):
    """The commands by name. A lookup of a command imports its module."""

    def __getitem__(self, name: str) -> Any:
        return _registered(COMMANDS[name].module)[name]

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


@cache
def _registered(module: str) -> Mapping[str, Any]:
    group = typer.Typer(rich_markup_mode=None)
    import_module(f"sightline.operator_side.cli.{module}").register(group)
    return typer.main.get_group(group).commands


class _Program(TyperGroup):
    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings | {"commands": _Commands()})

    def format_commands(self, _ctx: Any, formatter: Any) -> None:
        width = max(map(len, COMMANDS))
        for heading in dict.fromkeys(entry.heading for entry in COMMANDS.values()):
            with formatter.section(heading):
                formatter.write_dl([(f"{name:{width}}", entry.summary) for name, entry in COMMANDS.items()
                                    if entry.heading == heading])
        with formatter.section("Exit codes"):
            formatter.write_dl([(f"{code:<{width}}", meaning) for code, meaning in EXIT_CODES.items()])


app = typer.Typer(
    name="sightline",
    cls=_Program,
    help="Steer a small robot from a bigger computer over Wi-Fi\n\n"
    "The robot ignores commands that answer an old image, and stops. Start with the simulated robot; it needs no "
    "hardware.\n\n"
    "Example: sightline demo",
    epilog="`sightline COMMAND --help` describes a command.",
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"sightline {version('sightline-robot')}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _help_by_default(
    context: typer.Context,
    _version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="Show the version and exit.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
