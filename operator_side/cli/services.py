"""Commands that run or configure a service: sim, robot, vision, router, labels, scenarios, config, metrics. Shell."""

import json
import logging
import os
import signal
import threading
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from pydantic import BaseModel

from sightline.operator_side.cli.options import (
    CameraKind,
    CameraSets,
    ConfigFile,
    Connect,
    DetectorName,
    Device,
    Json,
    Listen,
    LogForm,
    MaybeSecure,
    Robot,
    RobotName,
    Secure,
    ServiceConnect,
    Sets,
    SocketDir,
    check_camera_sets,
    command_group,
    complete_detector,
    complete_mission,
    complete_robot,
    complete_robot_model,
    complete_scenario,
)
from sightline.operator_side.config.context import target_of
from sightline.operator_side.config.loading import SERVICES, load_service, model_of
from sightline.operator_side.config.toml_text import toml_text
from sightline.operator_side.preflight import needs
from sightline.operator_side.table import print_table
from sightline.protocol.errors import ConfigError, home_path
from sightline.protocol.log import start_log
from sightline.protocol.transports.endpoints import DEFAULT_ENDPOINT, own_stop_addresses
from sightline.protocol.transports.open import check_link, open_link
from sightline.protocol.transports.security import ROBOT_ROLE

if TYPE_CHECKING:
    from sightline.robot_side.config import RobotConfig

_log: Final = logging.getLogger(__name__)


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline sim --scenario eight --seed 3")(sim)
    app.command(epilog="Example: sightline robot --listen tcp/0.0.0.0:7447")(robot)
    app.command(epilog="Example: sightline vision --connect tcp/192.168.1.20:7447")(vision)
    app.command(epilog="Example: sightline router --listen tcp/0.0.0.0:7447")(router)
    app.command(epilog="Example: sightline scenarios thymio --out runs/thymio")(scenarios)
    app.command(epilog="Example: sightline labels r1")(labels)
    group = command_group("Check or show a service's configuration")
    group.command(epilog="Example: sightline config check robot robot.toml")(check)
    group.command(epilog="Example: sightline config show robot robot.toml --origin")(show)
    group.command(epilog="Example: sightline config schema vision")(schema)
    app.add_typer(group, name="config")
    app.command(epilog="Example: sightline metrics r1 --connect tcp/192.168.1.20:7447 --port 9464")(metrics)


Share = Annotated[
    bool, typer.Option("--share", help="Share all robots, or those of --robot, with other services that share.")
]
ShareName = Annotated[str | None, typer.Option("--name", help="With --share: a name of its own among the services.")]
Weight = Annotated[
    float | None, typer.Option("--weight", help="With --share: its share of the robots [default: 1].")
]


def sim(
    *,
    scenario: Annotated[
        str | None,
        typer.Option(autocompletion=complete_scenario,
                     help="A name from `sightline scenarios`, or a .toml file [default: circle]."),
    ] = None,
    robot_model: Annotated[
        str | None,
        typer.Option(autocompletion=complete_robot_model,
                     help="raspberry, gazebo-raspi, thymio, chaser, chaser-small, or a .toml [default: scenario's]."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the start and the noise.")] = None,
    motor_log: Annotated[
        str | None, typer.Option(metavar="FILE", help="Write every motor command to this CSV file.")
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="End after this many seconds.")] = None,
    socket_dir: SocketDir = None,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    """Simulate a robot's hardware

    It runs until Ctrl-C. `sightline robot` connects to it.
    """
    from sightline.sim.process import run

    start_log(log, "sim")
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
        typer.Argument(metavar="test-wheels", help="Only turn each wheel alone, with the wheels off the ground."),
    ] = None,
    *,
    robot: RobotName = None,
    listen: Listen = None,
    connect: ServiceConnect = None,
    secure: MaybeSecure = None,
    profile: Annotated[str | None, typer.Option(help="`sim`: simulated hardware, armed without an operator.")] = None,
    zero_motors: Annotated[
        bool, typer.Option("--zero-motors", help="Only set the motors to zero and end, e.g. after a crash.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="With test-wheels: confirm that the wheels are off the ground.")
    ] = False,
    socket_dir: SocketDir = None,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    """Run a robot: motors, camera and link

    It runs until Ctrl-C and accepts only clients of this machine, unless --listen permits others. Without a
    configuration it uses the hardware of `sightline sim`.
    """
    from sightline.robot_side.driver.process import run
    from sightline.robot_side.driver.process import zero_motors as set_to_zero
    from sightline.robot_side.guardian.start import become_guardian

    start_log(log, "robot")
    options: dict[str, Any] = {"robot": robot, "listen": _ends(listen), "connect": _ends(connect), "secure": secure}
    options |= {f"{device}.options.socket_dir": socket_dir for device in ("camera", "drive")}
    loaded = load_service(
        "robot", profile=profile, file=config, sets=sets or (), options=options, environ=os.environ
    )
    given: Any = loaded.config
    if zero_motors:  # first, because no task may turn the wheels then
        return set_to_zero(given)
    if task is not None:
        from sightline.operator_side.cli.calibrate import run_task

        return run_task(task, given, yes)
    if given.motors.kind == "sim":
        from sightline.robot_side.plugins import DRIVES
        from sightline.sim.bus import await_simulation

        await_simulation(DRIVES.load(given.motors)[1].socket_dir)
    with needs("zenoh"):
        return run(given, become_guardian(given, restarts=True))


def vision(
    *,
    robot: RobotName = None,
    listen: Listen = None,
    connect: ServiceConnect = None,
    secure: MaybeSecure = None,
    config: ConfigFile = None,
    sets: Sets = None,
    detector: DetectorName = None,
    device: Device = None,
    shadow: Annotated[
        str | None,
        typer.Option("--shadow", metavar="NAME", autocompletion=complete_detector,
                     help="A second detector, which never steers."),
    ] = None,
    mission: Annotated[
        str | None,
        typer.Option("--mission", metavar="NAME", autocompletion=complete_mission, help="Mission [default: follow]."),
    ] = None,
    share: Share = False,
    name: ShareName = None,
    weight: Weight = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the detections and do not steer.")] = False,
    camera: CameraKind = None,
    camera_sets: CameraSets = None,
    metrics: Annotated[
        str | None,
        typer.Option("--metrics", metavar="[HOST:]PORT", help="Serve /metrics, /live, /ready at this port, e.g. 9465."),
    ] = None,
    log: LogForm = None,
    shape: Annotated[str | None, typer.Option("--shape", hidden=True)] = None,
) -> int:
    """Run a vision service that steers a robot

    It runs until Ctrl-C. --dry-run also accepts --camera, a camera of this machine.
    """
    start_log(log, "vision")
    _check_vision_options(camera, camera_sets, dry_run=dry_run, share=share)
    if robot is not None and "://" in robot:  # the address of a robot without an id
        connect, robot = [*(connect or ()), robot], None
    options = {"robot": robot, "listen": _ends(listen), "connect": _ends(connect), "secure": secure,
               "detector.kind": detector, "detector.device": device, "detector.shadow": shadow,
               "mission.kind": mission, "share.name": name, "share.weight": weight}
    loaded = load_service("vision", profile="shared" if share else None, file=config, sets=sets or (),
                          options=options, environ=os.environ)
    with needs("vision"):
        if dry_run:
            return _dry_run(loaded.config, camera, camera_sets or [])
        if shape is not None:
            from sightline.evaluation.demo.shaped_vision import run_shaped

            return run_shaped(loaded.config, shape)  # type: ignore[arg-type]
        from sightline.vision_side.serving.process import run

        if metrics is not None:
            return _measured(run, loaded.config, metrics)
        return run(loaded.config)  # type: ignore[arg-type]


def _check_vision_options(camera: str | None, camera_sets: list[str] | None, *, dry_run: bool, share: bool) -> None:
    if camera is not None and not dry_run:
        raise ConfigError("--camera has no robot to steer; add --dry-run")
    check_camera_sets(camera, camera_sets)
    if share and dry_run:
        raise ConfigError("--share has no robot to steer with --dry-run; leave one of them out")


def _measured(run: Any, config: Any, where: str) -> int:
    with needs("metrics"):
        import_module("prometheus_client")
    from sightline.operator_side.cockpit.vision_metrics import served

    with served(where) as observe:
        return int(run(config, observe))


def router(
    listen: Annotated[
        list[str] | None,
        typer.Option("--listen", metavar="ENDPOINT", help="Listen here, e.g. tcp/0.0.0.0:7447 or tls/0.0.0.0:7447."),
    ] = None,
    connect: ServiceConnect = None,
    secure: Secure = "",
    log: LogForm = None,
) -> int:
    """Run a router to which all machines of a site connect

    It runs until Ctrl-C. Robots, vision services and clients reach each other through it.
    """
    start_log(log, "router")
    with needs("zenoh"):
        from sightline.operator_side.setup.router import run

        return run(listen or [DEFAULT_ENDPOINT], connect or [], secure)


def _dry_run(config: Any, camera: str | None, camera_sets: list[str]) -> int:
    from sightline.operator_side.calibrate.local_camera import local_camera
    from sightline.vision_side.detect.registry import check_takes_pictures, check_vision
    from sightline.vision_side.serving.dry_run import watch_camera, watch_robot

    if config.detector.kind == "boxes":
        raise ConfigError("--dry-run needs a local detector; name one, e.g. --detector hsv")
    if camera is None:
        return watch_robot(config, _log.info, None)
    check_takes_pictures(config.detector.kind)
    check_vision(config)
    with local_camera(camera, camera_sets) as opened:
        return watch_camera(config, opened, _log.info, None)


def _ends(endpoints: list[str] | None) -> tuple[str, ...] | None:
    return tuple(endpoints) if endpoints else None


# --- `scenarios` and `labels` ------------------------------------------------------------------------------------


def scenarios(
    name: Annotated[
        str | None,
        typer.Argument(metavar="NAME", autocompletion=complete_scenario, help="A scenario, or a .toml file."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write sim.toml, robot.toml and vision.toml there.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Seed of the start.")] = 1,
    as_json: Json = False,
) -> None:
    """List scenarios, or write the configuration of one

    With NAME it prints the configuration of the three services; --out writes it to files.
    """
    if name is None:
        if out is not None:
            raise ConfigError("--out needs a scenario; name it, e.g. sightline scenarios ball --out DIR")
        _list(as_json)
        return
    files = _files(name, seed)
    if out is not None:
        _write(home_path(out), name, files)
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
    print_table((one.name, one.robot, one.mission, one.summary) for one in all_of_them)


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

    texts = {out / f"{service}.toml": toml_text(table) for service, table in files.items()}
    try:
        out.mkdir(parents=True, exist_ok=True)
        for file, text in texts.items():
            if file.exists() and file.read_bytes() != text.encode():
                raise ConfigError(f"{file} exists with other content; choose another --out")
        for file, text in texts.items():
            file.write_text(text, "utf-8")
    except OSError as error:
        raise ConfigError(f"cannot write --out {out}: {error.strerror}; choose a folder that you may write") from None
    typer.echo(f"sightline sim --config {out}/sim.toml\nsightline robot --profile sim --config {out}/robot.toml\n"
               f"sightline vision --config {out}/vision.toml")
    if load_scenario(name).labels:
        typer.echo("sightline labels r1")


def labels(
    robot: Annotated[str, typer.Argument(metavar="ROBOT", autocompletion=complete_robot, help="Robot id.")] = "r1",
    connect: ServiceConnect = None,
    secure: Secure = "",
    socket_dir: SocketDir = None,
) -> int:
    """Publish the simulation's labels in place of a detector

    It runs until Ctrl-C. The labels are the exact boxes of the objects in each image.
    """
    start_log(None, "labels")
    with needs("zenoh"):
        from sightline.evaluation.labels import run
        from sightline.sim.bus import default_socket_dir

        return run(robot, connect or [DEFAULT_ENDPOINT], secure, socket_dir or default_socket_dir(), _log.info)


# --- `config check | show | schema` ------------------------------------------------------------------------------


ServiceName = Annotated[
    str, typer.Argument(metavar="SERVICE", autocompletion=lambda: SERVICES, help="robot, vision or sim.")
]
File = Annotated[str | None, typer.Argument(metavar="FILE", help="TOML file of the service.")]
Profile = Annotated[str | None, typer.Option(help="Profile below the file, e.g. sim.")]


def check(service: ServiceName, file: File = None, profile: Profile = None, sets: Sets = None) -> None:
    """Check a configuration

    Exit code 2 means that it is invalid; the error names the value.
    """
    loaded = load_service(service, profile=profile, file=file, sets=sets or (), environ=os.environ)
    check_names(loaded.config)
    typer.echo(f"{file or service}: valid, {len(loaded.given)} values set, the others are defaults")


def check_names(config: BaseModel | None) -> None:
    """Check that devices, scenario, robot, detectors and missions exist, and their options. Opens no device."""
    # Here, because each service starts a fifth sooner without the models of the others.
    from sightline.robot_side.config import RobotConfig
    from sightline.sim.process import SimConfig
    from sightline.vision_side.config import VisionConfig

    if isinstance(config, RobotConfig):
        _check_devices(config)
    if isinstance(config, SimConfig):
        from sightline.sim.robot import load_robot
        from sightline.sim.scenario import load_scenario

        load_robot(config.robot or load_scenario(config.scenario).robot)
    if isinstance(config, VisionConfig):
        with needs("vision"):
            from sightline.vision_side.detect.registry import check_vision
        check_link(config.listen, config.connect, "vision", config.secure)
        check_vision(config)


def _check_devices(config: "RobotConfig") -> None:
    from sightline.robot_side.guardian.start import zero_of
    from sightline.robot_side.hardware.cameras.lens import LensConfig
    from sightline.robot_side.hardware.gpio import GpioDriveConfig
    from sightline.robot_side.plugins import DEVICE_GROUPS

    home_path(config.state_dir)
    own_stop_addresses(config.listen)
    check_link(config.doors, config.connect, ROBOT_ROLE, config.secure)
    for group in DEVICE_GROUPS:
        choice = config.devices[group.key]
        options = group.load(choice)[1] if choice else None
        if isinstance(options, LensConfig):
            options.given_model()
        if isinstance(options, GpioDriveConfig):
            options.rows()
    zero_of(config)


def show(
    *,
    service: ServiceName,
    file: File = None,
    profile: Profile = None,
    sets: Sets = None,
    origin: Annotated[bool, typer.Option("--origin", help="Show where each value comes from.")] = False,
    as_json: Json = False,
) -> None:
    """Print the configuration that a service runs with

    The output is a valid TOML file. Later sources win: defaults, profile, file, environment, --set.
    """
    loaded = load_service(service, profile=profile, file=file, sets=sets or (), environ=os.environ)
    table = loaded.config.model_dump(mode="json")
    if as_json:
        origins = {".".join(key): given.origin for key, given in loaded.given.items()}
        typer.echo(json.dumps({"config": table, "origins": origins} if origin else table, indent=2))
    else:
        typer.echo(toml_text(table, loaded.origin if origin else lambda _key: ""), nl=False)


def schema(service: ServiceName) -> None:
    """Print the JSON Schema of a configuration, for editors"""
    typer.echo(json.dumps(model_of(service).model_json_schema(), indent=2))


# --- `metrics` ---------------------------------------------------------------------------------------------------


ROLE = "metrics"


def metrics(
    robot: Robot = None,
    connect: Connect = None,
    secure: Secure = "",
    host: Annotated[
        str, typer.Option(help="Address to listen on; 0.0.0.0 accepts every network, :: also IPv6.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=1, max=65535, help="Port to listen on.")] = 9464,
) -> int:
    """Serve a robot's status to Prometheus

    It serves /metrics, /live and /ready until Ctrl-C.
    """
    with needs("metrics"):
        import_module("prometheus_client")
    from sightline.operator_side.cockpit.metrics import Watched, serving

    if not host:
        raise ConfigError("invalid --host '': expected an address of this machine, e.g. 127.0.0.1")
    target, ending = target_of(robot, connect, secure), threading.Event()
    with (
        open_link(target.robot, connect=target.connect, role=ROLE, secure=target.secure) as link,
        serving(Watched(link), host, port) as address,
    ):
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda _number, _frame: ending.set())
        typer.echo(f"metrics of {target.robot}: {address}metrics")
        ending.wait()
    return 0
