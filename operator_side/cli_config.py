"""Commands about configuration: `config check | show | schema`. Shell."""

import json
import os
from typing import Annotated

import typer
from pydantic import BaseModel

from sightline.operator_side.cli.options import Sets
from sightline.operator_side.preflight import needs
from sightline.operator_side.service_settings import load_service
from sightline.operator_side.config.loading import model_of
from sightline.operator_side.config.toml_text import toml_text
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.plugins import load_device
from sightline.sim.robot import load_robot
from sightline.sim.scenario import load_scenario
from sightline.sim.service import SimConfig
from sightline.vision_side.config import VisionConfig

ServiceName = Annotated[str, typer.Argument(metavar="SERVICE", help="robot, vision or sim.")]
File = Annotated[str | None, typer.Argument(metavar="[FILE]", help="The service's TOML file.")]
Profile = Annotated[str | None, typer.Option(help="Lay this profile under it, e.g. sim.")]


def register_config(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(
        help="Check, show and describe a service's configuration: defaults < profile < file < environment < --set.",
        no_args_is_help=False, rich_markup_mode=None,
    )
    group.command(epilog="Example: sightline config check robot robot.toml")(check)
    group.command(epilog="Example: sightline config show robot robot.toml --origin")(show)
    group.command(epilog="Example: sightline config schema vision")(schema)
    app.add_typer(group, name="config")


def check(service: ServiceName, file: File = None, profile: Profile = None, sets: Sets = None) -> None:
    """Say whether a configuration is good; exit 2 and name what is wrong if not."""
    loaded = load_service(service, profile=profile, file=file, sets=sets or (), environ=os.environ)
    _check_names(loaded.config)
    typer.echo(f"{file or service}: ok, {len(loaded.given)} values set, the rest by default")


def _check_names(config: BaseModel) -> None:
    """What the configuration names, with its options: devices, scenario, robot, detectors, missions. Opens none."""
    if isinstance(config, RobotConfig):
        named = {"cameras": config.camera, "drives": config.motors, "range_sensors": config.ranging}
        for group, choice in named.items():
            if choice is not None:
                load_device(group, choice)
    if isinstance(config, SimConfig):
        load_robot(config.robot or load_scenario(config.scenario).robot)
    if isinstance(config, VisionConfig):
        with needs("vision"):
            from sightline.vision_side.detect.registry import check_vision
        check_vision(config)


def show(
    *,
    service: ServiceName,
    file: File = None,
    profile: Profile = None,
    sets: Sets = None,
    origin: Annotated[bool, typer.Option("--origin", help="Say where each value comes from.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Print the configuration that a service would run with, as a TOML file that it would accept."""
    loaded = load_service(service, profile=profile, file=file, sets=sets or (), environ=os.environ)
    table = loaded.config.model_dump(mode="json")
    if as_json:
        origins = {".".join(key): given.origin for key, given in loaded.given.items()}
        typer.echo(json.dumps({"config": table, "origins": origins} if origin else table, indent=2))
    else:
        typer.echo(toml_text(table, loaded.origin if origin else lambda _key: ""), nl=False)


def schema(service: ServiceName) -> None:
    """Print a service's configuration as JSON Schema, for editors."""
    typer.echo(json.dumps(model_of(service).model_json_schema(), indent=2))
