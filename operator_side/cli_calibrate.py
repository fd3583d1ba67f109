"""`sightline calibrate camera`: measures a camera and writes its model. Shell; heavy imports are inside."""

import json
import math
import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import Json, RobotName, Secure, ServiceConnect
from sightline.operator_side.cli.calibrate import drive
from sightline.operator_side.preflight import needs
from sightline.operator_side.out_file import check_out_file
from sightline.protocol.errors import ConfigError
from sightline.robot_side.config import DEFAULT_ENDPOINT

if TYPE_CHECKING:
    from sightline.operator_side.calibrate.camera import Ball, Board, Calibration, Mounting

_BOARD = re.compile(r"([0-9]{1,2})x([0-9]{1,2})")
_BALL_PICTURES = 20
_MOST_IN_FOLDER = 100  # all of a folder is used, within reason: the fit's time grows with every view

PluginName = Annotated[
    str | None, typer.Option("--camera", metavar="KIND", help="A camera of this machine: v4l2, picamera, video, ...")
]
PluginSets = Annotated[
    list[str] | None,
    typer.Option("--camera-set", metavar="KEY=VALUE", help="One of its options, e.g. device=/dev/video2."),
]
Metres = Annotated[float | None, typer.Option(help="Where the lens is, from the axle's middle on the floor.")]


def register_calibrate(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(help="Measure what a robot is made of.", rich_markup_mode=None)
    group.callback()(_calibrate)
    group.command(epilog="Example: sightline calibrate camera --camera v4l2 --board 9x6 --square-m 0.025")(camera)
    group.command(epilog="Example: sightline calibrate drive --config raspberry-car.toml")(drive)
    app.add_typer(group, name="calibrate")


def _calibrate() -> None:
    """Measure what a robot is made of."""


def camera(
    *,
    pictures: Annotated[Path | None, typer.Option(metavar="DIR", help="A folder of JPEGs.")] = None,
    camera: PluginName = None,
    camera_sets: PluginSets = None,
    robot: RobotName = None,
    connect: ServiceConnect = None,
    secure: Secure = "",
    board: Annotated[str, typer.Option(metavar="CxR", help="Inner corners of the chessboard.")] = "9x6",
    square_m: Annotated[float, typer.Option(min=0.001, max=1, help="Side of one square, metres.")] = 0.025,
    ball_radius_m: Annotated[float | None, typer.Option(min=0.005, max=2, help="Use a ball of this radius.")] = None,
    distance_m: Annotated[float | None, typer.Option(min=0.1, max=20, help="Lens to ball, over the floor.")] = None,
    config: Annotated[str | None, typer.Option(metavar="FILE", help="Vision's TOML: the ball's colour.")] = None,
    views: Annotated[int, typer.Option(min=5, max=100, help="Views of the board to take from a live camera.")] = 15,
    seconds: Annotated[float, typer.Option(min=1, max=600, help="Look at a live camera for at most this.")] = 90.0,
    x_m: Metres = None,
    y_m: Metres = None,
    z_m: Metres = None,
    pitch_rad: Annotated[float | None, typer.Option(help="Tilt of the lens, up positive.")] = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The model to write.")] = Path("camera.toml"),
    as_json: Json = False,
) -> None:
    """Measure a camera with a chessboard, or with a ball of known size at a known distance, and write its model.

    Pictures come from --pictures, from --camera, or from a running robot (--robot, --connect).
    """
    check_out_file(out)
    wanted = _subject(board, square_m, ball_radius_m, distance_m)
    given = {"x_m": x_m, "y_m": y_m, "z_m": z_m, "pitch_rad": pitch_rad}
    with needs("vision"), ExitStack() as ending:
        source, mounted = _source(ending, pictures, (camera, camera_sets or []), (robot, connect, secure), seconds)
        mounting = _mounting(mounted, given)
        say = _quiet if as_json else _print_board
        most = _MOST_IN_FOLDER if pictures is not None else views
        made = _measure(source, wanted, mounting, views=most, config=config, say=say)
    _write(out, made)
    typer.echo(json.dumps(_as_object(out, made)) if as_json else _summary(out, made))


def _subject(board: str, square_m: float, radius_m: float | None, distance_m: float | None) -> "Board | Ball":
    with needs("vision"):
        from sightline.operator_side.calibrate.camera import Ball, Board
    if radius_m is not None and distance_m is not None:
        return Ball(radius_m, distance_m)
    if radius_m is not None or distance_m is not None:
        raise ConfigError("a ball needs both --ball-radius-m and --distance-m")
    match = _BOARD.fullmatch(board)
    if match is None or min(int(match[1]), int(match[2])) < 3:
        raise ConfigError(f"--board {board!r} is no board: inner corners as COLUMNSxROWS, each at least 3, e.g. 9x6")
    return Board(int(match[1]), int(match[2]), square_m)


def _source(
    ending: ExitStack,
    folder: Path | None,
    plugin: tuple[str | None, list[str]],
    robot: tuple[str | None, list[str] | None, str],
    seconds: float,
) -> tuple[Iterator[bytes], dict[str, float]]:
    """The pictures, and the mounting that is known already. Exactly one source must be named."""
    from sightline.operator_side import calibrate_pictures as sources

    if sum((folder is not None, plugin[0] is not None, robot[:2] != (None, None))) != 1:
        raise ConfigError("say where the pictures come from, once: --pictures DIR, --camera KIND, or --robot ID")
    if folder is not None:
        return sources.folder_pictures(folder), {}
    if plugin[0] is not None:
        from sightline.operator_side.calibrate.local_camera import local_camera

        opened = ending.enter_context(local_camera(plugin[0], plugin[1]))
        return sources.camera_pictures(opened, seconds), {}
    from sightline.operator_side.pictures import viewer_role
    from sightline.protocol.transports.open import open_link

    name, connect, secure = robot
    role = viewer_role(secure) if secure else sources.ROLE
    at = connect or [DEFAULT_ENDPOINT]
    link = ending.enter_context(open_link(name or "r1", connect=at, role=role, secure=secure))
    model = sources.robot_model(link)
    mounted = {"x_m": model.x_m, "y_m": model.y_m, "z_m": model.z_m, "pitch_rad": model.pitch_rad}
    return sources.robot_pictures(link, seconds, role, secure), mounted


def _mounting(known: dict[str, float], given: dict[str, float | None]) -> "Mounting":
    from sightline.operator_side.calibrate.camera import Mounting

    return Mounting(**{**known, **{name: value for name, value in given.items() if value is not None}})


def _measure(
    pictures: Iterator[bytes],
    wanted: "Board | Ball",
    mounting: "Mounting",
    *,
    views: int,
    config: str | None,
    say: Callable[[str], None],
) -> "Calibration":
    from sightline.operator_side.calibrate import camera as calibrate
    from sightline.operator_side.calibrate_pictures import collect

    if isinstance(wanted, calibrate.Board):
        boards = collect(pictures, lambda _: lambda jpeg: calibrate.find_board(jpeg, wanted), calibrate.is_new_view,
                         views, say)
        return calibrate.from_boards(boards.found, wanted, boards.size, boards.given, mounting)
    hsv = _vision_config(config).hsv
    balls = collect(pictures, lambda size: calibrate.ball_finder(size, hsv), lambda *_: True, _BALL_PICTURES, _quiet)
    return calibrate.from_balls(balls.found, wanted, balls.size, balls.given, mounting)


def _vision_config(file: str | None) -> Any:
    from sightline.operator_side.service_settings import load_service

    return load_service("vision", file=file, environ=os.environ).config


def _write(path: Path, made: "Calibration") -> None:
    from sightline.operator_side.config.toml_text import toml_text

    head = f"# {made.used} of {made.given} pictures, {made.error:.2f} {made.error_unit}\n"
    try:
        path.write_text(head + toml_text(made.model.model_dump(mode="json")), "utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}; see --out") from None


def _hfov_deg(made: "Calibration") -> float:
    return math.degrees(2 * math.atan(made.model.width_px / 2 / made.model.fx_px))


def _summary(path: Path, made: "Calibration") -> str:
    model = made.model
    return (
        f"{model.width_px}x{model.height_px}: fx {model.fx_px:.1f}, fy {model.fy_px:.1f} px ({_hfov_deg(made):.1f} "
        f"degrees wide), from {made.used} of {made.given} pictures, {made.error:.2f} {made.error_unit}\n"
        f"{path} is written; use it: sightline robot --set camera.options.model_file={path}"
    )


def _as_object(path: Path, made: "Calibration") -> dict[str, Any]:
    return {
        "ok": True, "file": str(path), "model": made.model.model_dump(mode="json"), "used": made.used,
        "given": made.given, "error": made.error, "error_unit": made.error_unit,
    }


def _print_board(line: str) -> None:
    typer.echo(f"board {line}; move it, and tilt it")


def _quiet(_line: str) -> None:
    """Nothing to say: a ball lies still, and with --json only the object is printed."""
