"""Commands that run a service: `sim`, `robot`, `vision`. Shell."""

import os
from importlib import import_module
from typing import Annotated, Any

import typer

from sightline.operator_side.cli.options import (
    ConfigFile,
    Listen,
    LogForm,
    MaybeSecure,
    RobotName,
    Secure,
    ServiceConnect,
    Sets,
    SocketDir,
)
from sightline.operator_side.preflight import needs
from sightline.operator_side.service_settings import load_service
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import set_log_format
from sightline.robot_side.config import DEFAULT_ENDPOINT


def register_services(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline sim --scenario eight --seed 3")(sim)
    app.command(epilog="Example: sightline robot --listen tcp/0.0.0.0:7447 --set safety.max_linear_mps=0.3")(robot)
    app.command(epilog="Example: sightline vision --connect tcp/192.168.1.20:7447")(vision)
    app.command(epilog="Example: sightline router --listen tcp/0.0.0.0:7447")(router)


def sim(
    *,
    scenario: Annotated[
        str | None, typer.Option(help="A name of `sightline scenarios`, or a .toml file [default: circle].")
    ] = None,
    robot_model: Annotated[
        str | None, typer.Option(help="raspberry, gazebo-raspi, thymio, chaser, or a .toml [default: the scenario's].")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Draws the start and the noise.")] = None,
    motor_log: Annotated[str | None, typer.Option(metavar="FILE", help="CSV of every motor command.")] = None,
    seconds: Annotated[float | None, typer.Option(help="End by itself after this long.")] = None,
    socket_dir: SocketDir = None,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    """Simulate a robot's hardware, in place of a real one, until Ctrl-C."""
    from sightline.sim.service import run

    set_log_format(log, "sim")
    options = {
        "scenario": scenario, "robot": robot_model, "seed": seed, "motor_log": motor_log, "seconds": seconds,
        "socket_dir": socket_dir,
    }
    loaded = load_service("sim", file=config, sets=sets or (), options=options, environ=os.environ)
    with needs("sim"):
        return run(loaded.config)  # type: ignore[arg-type]


def robot(
    task: Annotated[
        str | None,
        typer.Argument(metavar="[test-wheels]", help="Turn each wheel by itself, off the ground, instead of running."),
    ] = None,
    *,
    robot: RobotName = None,
    listen: Listen = None,
    connect: ServiceConnect = None,
    secure: MaybeSecure = None,
    profile: Annotated[str | None, typer.Option(help="`sim`: simulated, armed without a person.")] = None,
    zero_motors: Annotated[
        bool, typer.Option("--zero-motors", help="Only set the motors to zero, e.g. after a crash, and end.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With test-wheels: the wheels are off the ground, ask nothing.")
    ] = False,
    socket_dir: SocketDir = None,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    """Run a robot: its wheels, its camera, its link, until Ctrl-C. Listens on this machine only unless told otherwise.

    With no configuration its hardware is the simulation (`sightline sim`).
    """
    from sightline.robot_side.driver.process import run
    from sightline.robot_side.driver.process import zero_motors as set_to_zero

    set_log_format(log, "robot")
    options: dict[str, Any] = {"robot": robot, "listen": _ends(listen), "connect": _ends(connect), "secure": secure}
    options |= {f"{device}.options.socket_dir": socket_dir for device in ("camera", "drive")}
    loaded = load_service(
        "robot", profile=profile, file=config, sets=sets or (), options=options, environ=os.environ
    )
    if task is not None:
        from sightline.operator_side.cli.calibrate import run_task

        return run_task(task, loaded.config, yes)  # type: ignore[arg-type]
    with needs("zenoh"):
        return (set_to_zero if zero_motors else run)(loaded.config)  # type: ignore[arg-type]


def vision(
    *,
    robot: RobotName = None,
    listen: Listen = None,
    connect: ServiceConnect = None,
    secure: MaybeSecure = None,
    config: ConfigFile = None,
    sets: Sets = None,
    detector: Annotated[
        str | None,
        typer.Option("--detector", metavar="NAME", help="Of `sightline detector list`, e.g. onnx:PATH [default: hsv]."),
    ] = None,
    device: Annotated[
        str | None, typer.Option("--device", help="Of a model: auto, cpu, cuda or tensorrt [default: auto].")
    ] = None,
    shadow: Annotated[
        str | None, typer.Option("--shadow", metavar="NAME", help="A second detector that looks on and never steers.")
    ] = None,
    mission: Annotated[
        str | None, typer.Option("--mission", metavar="NAME", help="What to do with what is seen [default: follow].")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what is seen and steer nothing.")] = False,
    camera: Annotated[
        str | None, typer.Option("--camera", metavar="KIND", help="With --dry-run: a camera of this machine.")
    ] = None,
    camera_sets: Annotated[
        list[str] | None, typer.Option("--camera-set", metavar="KEY=VALUE", help="An option of it, e.g. fps=15.")
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option("--metrics", metavar="[HOST:]PORT", help="Serve /metrics and /health there, e.g. 9465."),
    ] = None,
    log: LogForm = None,
    shape: Annotated[str | None, typer.Option("--shape", hidden=True)] = None,
) -> int:
    """Look at a robot's pictures and steer it, until Ctrl-C."""
    set_log_format(log, "vision")
    if camera is not None and not dry_run:
        raise ConfigError("--camera looks without a robot, so there is nothing to steer: add --dry-run")
    if camera_sets and camera is None:
        raise ConfigError("--camera-set is for the camera of --camera; name one, e.g. --camera v4l2")
    if robot is not None and "://" in robot:  # the address of a robot that has one endpoint and no other name
        connect, robot = [*(connect or ()), robot], None
    options = {"robot": robot, "listen": _ends(listen), "connect": _ends(connect), "secure": secure,
               "detector.kind": detector, "detector.device": device, "detector.shadow": shadow,
               "mission.kind": mission}
    loaded = load_service("vision", file=config, sets=sets or (), options=options, environ=os.environ)
    with needs("vision"):
        if dry_run:
            return _dry_run(loaded.config, camera, camera_sets or [])
        if shape is not None:
            from sightline.operator_side.shaped_vision import run_shaped

            return run_shaped(loaded.config, shape)  # type: ignore[arg-type]
        from sightline.vision_side.serving.process import run

        if metrics is not None:
            return _measured(run, loaded.config, metrics)
        return run(loaded.config)  # type: ignore[arg-type]


def _measured(run: Any, config: Any, where: str) -> int:
    with needs("metrics"):
        import_module("prometheus_client")
    from sightline.operator_side.cockpit.vision_metrics import served

    with served(where) as observe:
        return int(run(config, observe))


def router(listen: Listen = None, connect: ServiceConnect = None, secure: Secure = "", log: LogForm = None) -> int:
    """Run the place where robots, visions and people of one site meet, until Ctrl-C. All of them connect to it."""
    set_log_format(log, "router")
    with needs("zenoh"):
        from sightline.operator_side.setup.router import run

        return run(listen or [DEFAULT_ENDPOINT], connect or [], secure)


def _dry_run(config: Any, camera: str | None, camera_sets: list[str]) -> int:
    from sightline.operator_side.calibrate.local_camera import local_camera
    from sightline.vision_side.detect.registry import check_takes_pictures, check_vision
    from sightline.vision_side.serving.dry_run import watch_camera, watch_robot

    if config.detector.kind == "boxes":
        raise ConfigError("--dry-run looks with vision's own eyes; name a detector, e.g. --detector hsv")
    if camera is None:
        return watch_robot(config, typer.echo, None)
    check_takes_pictures(config.detector.kind)
    check_vision(config)
    with local_camera(camera, camera_sets) as opened:
        return watch_camera(config, opened, typer.echo, None)


def _ends(endpoints: list[str] | None) -> tuple[str, ...] | None:
    return tuple(endpoints) if endpoints else None
