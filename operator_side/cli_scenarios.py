"""Commands `scenarios`, which lists them and writes what each needs, and `labels`, which plays a detector. Shell."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from sightline.operator_side.preflight import needs
from sightline.operator_side.config.toml_text import toml_text
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import DEFAULT_ENDPOINT


def register_scenarios(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline scenarios thymio --out runs/thymio")(scenarios)
    app.command(epilog="Example: sightline labels r1")(labels)


def scenarios(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="One of them, or a .toml file.")] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Write sim, robot and vision.toml for it.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Draws the start.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> None:
    """List what can be simulated; for one scenario, show or write the configuration that its three services need."""
    if name is None:
        if out is not None:
            raise ConfigError("--out writes the configuration of one scenario: name it, e.g. sightline scenarios ball")
        _list(as_json)
        return
    files = _files(name, seed)
    if out is not None:
        _write(out, name, files)
    elif as_json:
        typer.echo(json.dumps(files))
    else:
        for service, table in files.items():
            typer.echo(f"# {service}.toml\n{toml_text(table)}")


def _list(as_json: bool) -> None:
    from sightline.sim.scenario import load_scenario, scenario_names

    all_of_them = [load_scenario(name) for name in scenario_names()]
    if as_json:
        keys = {"name", "summary", "robot", "mission", "seconds"}
        typer.echo(json.dumps({"scenarios": [one.model_dump(include=keys) for one in all_of_them]}))
        return
    for one in all_of_them:
        typer.echo(f"{one.name:<20} {one.robot:<13} {one.mission:<20} {one.summary}")


def _files(name: str, seed: int) -> dict[str, dict[str, Any]]:
    with needs("vision"):
        from sightline.evaluation.scenario_config import (
            robot_config,
            robot_of,
            robot_table,
            vision_config,
            vision_table,
        )
        from sightline.sim.scenario import load_scenario
        from sightline.vision_side.missions.registry import configured_mission
    scenario = load_scenario(name)
    model = robot_of(scenario)
    robot_config(model)
    configured_mission(vision_config(scenario, model, seed))
    return {
        "sim": {"scenario": name, "robot": scenario.robot, "seed": seed}, "robot": robot_table(model),
        "vision": vision_table(scenario, model, seed),
    }


def _write(out: Path, name: str, files: dict[str, dict[str, Any]]) -> None:
    from sightline.sim.scenario import load_scenario

    try:
        out.mkdir(parents=True, exist_ok=True)
        for service, table in files.items():
            (out / f"{service}.toml").write_text(toml_text(table), "utf-8")
    except OSError as error:
        raise ConfigError(f"--out {out}: {error.strerror}") from None
    typer.echo(f"sightline sim --config {out}/sim.toml\nsightline robot --profile sim --config {out}/robot.toml\n"
               f"sightline vision --config {out}/vision.toml")
    if load_scenario(name).labels:
        typer.echo("sightline labels r1")


def labels(
    robot: Annotated[str, typer.Argument(metavar="[ROBOT]", help="The robot's id.")] = "r1",
    connect: Annotated[
        list[str] | None, typer.Option("--connect", metavar="ENDPOINT", help="Where the robot or router listens.")
    ] = None,
    secure: Annotated[str, typer.Option("--secure", metavar="DIR", help="Keys made by `sightline keys`.")] = "",
    socket_dir: Annotated[
        str | None, typer.Option("--socket-dir", metavar="DIR", help="Where the simulation's sockets are.")
    ] = None,
) -> int:
    """Publish what the simulation labels in its pictures as boxes, in place of a detector, until Ctrl-C."""
    with needs("zenoh"):
        from sightline.operator_side.labels_service import run
        from sightline.sim.bus import default_socket_dir

        return run(robot, connect or [DEFAULT_ENDPOINT], secure, socket_dir or default_socket_dir(), _print_line)


def _print_line(line: str) -> None:
    print(line, flush=True)
