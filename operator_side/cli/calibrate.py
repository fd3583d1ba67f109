"""Commands that measure a robot: calibrate camera, calibrate drive, robot test-wheels, pick-color. Shell."""

import json
import math
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from sightline.operator_side.calibrate.wheels import check_confirmed, opened_drive, try_wheels, turn_for
from sightline.operator_side.cli.options import (
    CHECK_FAILED,
    CameraKind,
    CameraSets,
    ConfigFile,
    Connect,
    Json,
    Port,
    Robot,
    RobotName,
    Secure,
    ServiceConnect,
    Sets,
    check_camera_sets,
    command_group,
    numbers,
    plugin_prints,
)
from sightline.operator_side.client.pictures import Pictures, viewer_role
from sightline.operator_side.config.context import RobotAddress, target_of
from sightline.operator_side.config.errors import no_such_name
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.preflight import check_out_file, needs, write_whole
from sightline.protocol.channels import FRAME
from sightline.protocol.errors import ConfigError, SightlineError, home_path
from sightline.protocol.transports.open import open_link
from sightline.robot_side.config import RobotConfig
from sightline.robot_side.hardware.gpio import table_of, table_text
from sightline.robot_side.plugins import DRIVES

if TYPE_CHECKING:
    from sightline.operator_side.calibrate.camera import Ball, Board, Calibration, Mounting
    from sightline.operator_side.calibrate.color import Box, Image, Ranges
    from sightline.operator_side.calibrate.color_page import Gallery
    from sightline.protocol.transports.link import Link
    from sightline.robot_side.guardian.start import GuardianEnd


TASKS: Final = ("test-wheels",)
_LONGEST_WAY_M: Final = 20.0


def run_task(task: str, config: RobotConfig, confirmed: bool) -> int:
    """Run a task of `sightline robot`. Raises ConfigError for an unknown task."""
    if task not in TASKS:
        what, option = ("configuration", "--config") if task.endswith(".toml") else ("robot's id", "--robot")
        hint = f" (a {what} is given with {option} {task})" if not task.startswith("test") else ""
        raise ConfigError(no_such_name("task", task, TASKS) + hint)
    check_confirmed(confirmed, sys.stdin.isatty(), task, "lift the robot")
    is_right = try_wheels(config, None if confirmed else _prompt, typer.echo, _guard)
    return 0 if is_right else CHECK_FAILED


def _guard(config: RobotConfig) -> "GuardianEnd":
    """Start a guardian for this command. The command exits with code 3 if the guardian must stop it."""
    from sightline.robot_side.guardian.start import become_guardian

    return become_guardian(config, restarts=False)


def drive(
    *,
    config: ConfigFile = None,
    sets: Sets = None,
    duty: Annotated[
        str, typer.Option(metavar="LIST", help="Rising duties, separated by commas.")
    ] = "0.3,0.4,0.5,0.6,0.8,1.0",
    seconds: Annotated[float, typer.Option(min=0.5, max=10, help="Seconds at each duty.")] = 2.0,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Table to write.")] = Path("drive.toml"),
    yes: Annotated[
        bool, typer.Option("--yes", help="Confirm that the way is free; read the distances from stdin.")
    ] = False,
) -> None:
    """Measure the speed of a drive at each duty

    A car with a `gpio` drive drives straight on the floor, and you type the distance. Ctrl-C stops the car.
    """
    robot: Any = load_service("robot", file=config, sets=sets or (), environ=os.environ).config
    duties = _rising_duties(duty)
    check_confirmed(yes, sys.stdin.isatty(), "calibrate drive", "put the robot on the floor, free the way ahead")
    check_out_file(out)
    rows: list[tuple[float, float]] = []
    try:
        _measure_rows(robot, duties, seconds, rows, confirmed=yes)
        text = _table(rows, seconds)
        table_of(text, "these measurements")  # validates the text before it is written
        write_whole(out, text, "choose another --out")
    except (SightlineError, typer.Abort, KeyboardInterrupt):  # Abort also means the end of stdin
        if rows:
            typer.echo(f"not written; the measured table is:\n{_table(rows, seconds)}", err=True)
        raise
    typer.echo(f"wrote {out}; use it: sightline robot --set drive.options.table_file={out}")


def _rising_duties(text: str) -> list[float]:
    duties = numbers("--duty", text, float)
    if any(not 0 < one <= 1 for one in duties) or sorted(set(duties)) != duties:
        raise ConfigError(f"invalid --duty '{text}': expected rising numbers above 0 up to 1, e.g. --duty 0.4,0.6,1")
    return duties


def _table(rows: list[tuple[float, float]], seconds: float) -> str:
    return table_text(rows, f"measured by `sightline calibrate drive`, {seconds:g} s at each duty")


def _measure_rows(
    config: RobotConfig, duties: list[float], seconds: float, rows: list[tuple[float, float]], *, confirmed: bool
) -> None:
    """Drive at each duty and append the duty and its speed to `rows`."""
    if not hasattr(DRIVES.load(config.motors)[0], "set_duty"):
        raise ConfigError(f"drive '{config.drive.kind}' has no duty to calibrate; use a gpio drive")
    with opened_drive(config, _guard) as (opened, guardian):
        give = opened.set_duty  # type: ignore[attr-defined]
        for one in duties:
            if not confirmed:
                _prompt(f"duty {one:g} for {seconds:g} s: put the car on the floor, the way ahead free; Enter drives")
            turn_for(give, (one, one), seconds, guardian)
            way_m = _distance_m(f"duty {one:g}: distance in meters (0: it did not move)")
            if way_m > 0:
                rows.append((one, way_m / seconds))
    if not rows:
        raise ConfigError("the car did not move at any duty; check its wiring with `sightline robot test-wheels`")


def _distance_m(question: str) -> float:
    """Prompt until the answer is a distance. A typing error must not discard earlier rows."""
    while True:
        answer = _prompt(question)
        try:
            way_m = float(answer.replace(",", "."))
        except ValueError:
            way_m = -1.0
        if 0 <= way_m <= _LONGEST_WAY_M:
            return way_m
        question = f"invalid distance '{answer}'; meters from 0 to {_LONGEST_WAY_M:g}, e.g. 0.35"


def _prompt(question: str) -> str:
    answer: str = typer.prompt(question, default="", show_default=False, prompt_suffix=": ")
    return answer


# --- `calibrate camera` ------------------------------------------------------------------------------------------


_BOARD = re.compile(r"([0-9]{1,2})x([0-9]{1,2})")
_BALL_PICTURES = 20
_FARTHEST_LENS_M = 100.0
_MOST_IN_FOLDER = 100  # limit for a folder, because the time of the fit grows with every view

_MOUNTED: Final = "[default: of the robot, or 0]."


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = command_group("Measure a robot's camera or drive")
    group.command(epilog="Example: sightline calibrate camera --camera v4l2 --board 9x6")(camera)
    group.command(epilog="Example: sightline calibrate drive --config raspberry-car.toml")(drive)
    app.add_typer(group, name="calibrate")
    app.command("pick-color", epilog="Example: sightline pick-color r1 --config vision.toml")(pick_color)


def camera(
    *,
    pictures: Annotated[
        Path | None, typer.Option("--images", "--pictures", metavar="DIR", help="Folder of JPEG images.")
    ] = None,
    camera: CameraKind = None,
    camera_sets: CameraSets = None,
    robot: RobotName = None,
    connect: ServiceConnect = None,
    secure: Secure = "",
    board: Annotated[str, typer.Option(metavar="CxR", help="Inner corners of the chessboard.")] = "9x6",
    square_m: Annotated[float, typer.Option(min=0.001, max=1, help="Ignored: it does not change the model.")] = 0.025,
    ball_radius_m: Annotated[float | None, typer.Option(min=0.005, max=2, help="Radius of a ball, m.")] = None,
    distance_m: Annotated[float | None, typer.Option(min=0.1, max=20, help="Lens to ball along the floor, m.")] = None,
    config: Annotated[
        str | None, typer.Option(metavar="FILE", help="TOML file of the vision service, with the color of the ball.")
    ] = None,
    views: Annotated[int, typer.Option(min=5, max=100, help="Views of the board from a live camera.")] = 15,
    seconds: Annotated[float, typer.Option(min=1, max=600, help="Longest time for a live camera, s.")] = 90.0,
    x_m: Annotated[float | None, typer.Option(help="Lens ahead of the axle's center, m " + _MOUNTED)] = None,
    y_m: Annotated[float | None, typer.Option(help="Lens left of the axle's center, m " + _MOUNTED)] = None,
    z_m: Annotated[float | None, typer.Option(help="Lens above the floor, m " + _MOUNTED)] = None,
    pitch_rad: Annotated[float | None, typer.Option(help="Tilt of the lens up, rad " + _MOUNTED)] = None,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Model to write.")] = Path("camera.toml"),
    as_json: Json = False,
) -> None:
    """Measure a camera and write its model

    Use a chessboard, or a ball of known size and distance. Images come from --images, --camera or a running robot.
    """
    check_out_file(out)
    check_camera_sets(camera, camera_sets)
    wanted = _subject(board, square_m, ball_radius_m, distance_m)
    given = {"x_m": x_m, "y_m": y_m, "z_m": z_m, "pitch_rad": pitch_rad}
    _check_mounting(given)
    with needs("vision"), plugin_prints(as_json), ExitStack() as ending:
        source, mounted = _source(ending, pictures, (camera, camera_sets or []), (robot, connect, secure), seconds)
        mounting = _mounting(mounted, given)
        report = _quiet if as_json else _print_board
        if pictures is None and not as_json:
            searched = "the ball" if ball_radius_m is not None else f"a board of {board} inner corners"
            typer.echo(f"searching the live images for {searched}, for {seconds:g} s or until Ctrl-C")
        most = _MOST_IN_FOLDER if pictures is not None else views
        made = _measure(source, wanted, mounting, views=most, config=config, report=report, is_live=pictures is None)
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
        raise ConfigError(
            f"invalid --board '{board}': expected inner corners as COLUMNSxROWS, each at least 3, e.g. 9x6"
        )
    return Board(int(match[1]), int(match[2]), square_m)


def _source(
    ending: ExitStack,
    folder: Path | None,
    plugin: tuple[str | None, list[str]],
    robot: tuple[str | None, list[str] | None, str],
    seconds: float,
) -> tuple[Iterator[bytes], dict[str, float]]:
    """Open the images and return them with the known mounting. Raises ConfigError unless one source is given."""
    from sightline.operator_side.calibrate import camera as sources

    if sum((folder is not None, plugin[0] is not None, robot[:2] != (None, None))) != 1:
        raise ConfigError("expected one source of images; give --images DIR, --camera KIND or --robot ID")
    if folder is not None:
        return sources.folder_pictures(folder), {}
    if plugin[0] is not None:
        from sightline.operator_side.calibrate.local_camera import local_camera

        opened = ending.enter_context(local_camera(plugin[0], plugin[1]))
        return sources.camera_pictures(opened, seconds), {}
    target = target_of(*robot)
    secure = target.secure
    role = viewer_role(secure) if secure else sources.ROLE
    link = ending.enter_context(open_link(target.robot, connect=target.connect, role=role, secure=secure))
    model = sources.robot_model(link)
    mounted = {"x_m": model.x_m, "y_m": model.y_m, "z_m": model.z_m, "pitch_rad": model.pitch_rad}
    return sources.robot_pictures(link, seconds, role, secure), mounted


def _check_mounting(given: Mapping[str, float | None]) -> None:
    """Raise ConfigError before the measurement for a value that no model may have."""
    for name, value in given.items():
        bound, unit = (round(math.pi / 2, 3), "radians") if name == "pitch_rad" else (_FARTHEST_LENS_M, "meters")
        if value is not None and not -bound <= value <= bound:
            option = f"--{name.replace('_', '-')}"
            raise ConfigError(f"invalid {option} {value:g}: expected {unit} from -{bound:g} to {bound:g}")


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
    report: Callable[[str], None],
    is_live: bool,
) -> "Calibration":
    from sightline.operator_side.calibrate import camera as calibrate
    from sightline.operator_side.calibrate.camera import collect

    if isinstance(wanted, calibrate.Board):
        boards = collect(pictures, lambda _: lambda jpeg: calibrate.find_board(jpeg, wanted), calibrate.is_new_view,
                         views, report, is_live=is_live)
        _print_skipped(boards.skipped)
        return calibrate.from_boards(boards.found, wanted, boards.size, boards.given, mounting,
                                     repeated=boards.repeated)
    hsv = _vision_config(config).hsv
    balls = collect(pictures, lambda size: calibrate.ball_finder(size, hsv), lambda *_: True, _BALL_PICTURES, _quiet,
                    is_live=is_live)
    _print_skipped(balls.skipped)
    return calibrate.from_balls(balls.found, wanted, balls.size, balls.given, mounting)


def _vision_config(file: str | None) -> Any:
    from sightline.operator_side.config.loading import load_service

    return load_service("vision", file=file, environ=os.environ).config


def _write(path: Path, made: "Calibration") -> None:
    from sightline.operator_side.config.toml_text import toml_text

    head = f"# {made.used} of {made.given} images, {made.error:.2f} {made.error_unit}\n"
    text = head + toml_text(made.model.model_dump(mode="json"))
    try:
        write_whole(path, text, "choose another --out")
    except ConfigError:
        typer.echo(f"not written; the measured model is:\n{text}", err=True)
        raise


def _hfov_deg(made: "Calibration") -> float:
    return math.degrees(2 * math.atan(made.model.width_px / 2 / made.model.fx_px))


def _summary(path: Path, made: "Calibration") -> str:
    model = made.model
    return (
        f"{model.width_px}x{model.height_px}: fx {model.fx_px:.1f}, fy {model.fy_px:.1f} px ({_hfov_deg(made):.1f} "
        f"degrees wide), from {made.used} of {made.given} images, {made.error:.2f} {made.error_unit}\n"
        f"wrote {path}; use it: sightline robot --set camera.options.model_file={path}"
    )


def _as_object(path: Path, made: "Calibration") -> dict[str, Any]:
    return {
        "ok": True, "file": str(path), "model": made.model.model_dump(mode="json"), "used": made.used,
        "given": made.given, "error": made.error, "error_unit": made.error_unit,
    }


def _print_board(line: str) -> None:
    typer.echo(f"board {line}; move and tilt it")


def _print_skipped(count: int) -> None:
    if count:
        typer.echo(f"skipped {count} damaged images or images of another size", err=True)


def _quiet(_line: str) -> None:
    """Print nothing, because a ball does not move, and --json prints only the result."""


# --- `pick-color` ------------------------------------------------------------------------------------------------


_MASK = Path("pick-color-mask.png")
_WAIT_S = 0.2
_PAGE_S = 0.3  # time for the page to fetch the result


def pick_color(
    robot: Robot = None,
    *,
    picture: Annotated[
        Path | None, typer.Option("--image", "--picture", metavar="FILE", help="Use an image file.")
    ] = None,
    video: Annotated[Path | None, typer.Option("--video", metavar="FILE", help="Use a video file.")] = None,
    at: Annotated[str | None, typer.Option("--at", metavar="X,Y", help="Pick this pixel without a browser.")] = None,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,W,H", help="Pick this box without a browser.")
    ] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, max=200, help="Images for the test of the range.")] = 20,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Write the range to this vision configuration.")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option("--mask", metavar="FILE", help="Image of the result [default: pick-color-mask.png].")
    ] = None,
    port: Port = 0,
    connect: Connect = None,
    secure: Secure = "",
    as_json: Json = False,
) -> None:
    """Pick the target's color in an image

    Click or draw a box on a page for a browser on this machine, or use --at or --box. It tests and prints the range.
    """
    sources = [name for name, given in (("ROBOT", robot), ("--image", picture), ("--video", video)) if given]
    if len(sources) > 1:
        raise ConfigError(f"{' and '.join(sources)} exclude each other; give one source of images")
    place = place_of(at, box)
    if as_json and place is None:
        raise ConfigError("--json works without a browser; add --at X,Y or --box X,Y,W,H")
    with needs("vision"):
        from sightline.operator_side.calibrate.color_file import check_config
    config = home_path(config) if config else None
    if config is not None:
        check_config(config)
    mask = mask or _MASK
    _check_mask(mask, {"--image": picture, "--video": video, "--config": config})
    source = _Source(target_of(robot, connect, secure), picture, video)
    if place is None:
        _on_page(source, frames, config, port)
    else:
        _at_once(source.pictures(frames), place, config, mask, as_json)


def _check_mask(mask: Path, others: Mapping[str, Path | None]) -> None:
    """Raise ConfigError for a mask that would replace another file of the command, or that is not a PNG."""
    if mask.suffix.lower() != ".png":
        raise ConfigError(f"invalid --mask {mask}: expected a .png file, e.g. --mask mask.png")
    for option, path in others.items():
        if path is not None and os.path.realpath(home_path(mask)) == os.path.realpath(home_path(path)):
            raise ConfigError(f"--mask {mask} is also the file of {option}; name another .png file")


def place_of(at: str | None, box: str | None) -> "Box | None":
    """Parse the place of `--at` or `--box`; None without both. Raises ConfigError for an invalid place."""
    with needs("vision"):
        from sightline.operator_side.calibrate.color import Box
    if at and box:
        raise ConfigError("--at and --box exclude each other; give one")
    for option, text, form in (("--at", at, "X,Y"), ("--box", box, "X,Y,W,H")):
        if text is None:
            continue
        parts = [part.strip() for part in text.split(",")]
        right = len(parts) == form.count(",") + 1 and all(p.isascii() and p.isdigit() and len(p) < 6 for p in parts)
        if not right or (option == "--box" and "0" in (parts[2].lstrip("0") or "0", parts[3].lstrip("0") or "0")):
            raise ConfigError(f"invalid {option} '{text}': expected {form} in whole pixels, e.g. {option} "
                              f"{'160,120' if option == '--at' else '150,110,20,20'}")
        return Box(*(int(part) for part in parts))
    return None


class _Source:
    """A source of images: a robot, an image file or a video file."""

    def __init__(self, target: RobotAddress, picture: Path | None, video: Path | None) -> None:
        self._target, self._picture, self._video = target, picture, video

    def pictures(self, frames: int) -> "list[Image]":
        """Return at most `frames` images, the newest last."""
        from sightline.operator_side.calibrate.color_page import of_robot

        still = self._of_file(frames)
        if still is not None:
            return still
        with self._link() as (link, role):
            return of_robot(Pictures(link, role, FRAME, self._target.secure), frames)

    @contextmanager
    def _link(self) -> "Iterator[tuple[Link, str]]":
        target, role = self._target, viewer_role(self._target.secure)
        with open_link(target.robot, connect=target.connect, role=role, secure=target.secure) as link:
            yield link, role

    @contextmanager
    def gallery(self, frames: int) -> "Iterator[Gallery]":
        """Yield the images for a page."""
        from sightline.operator_side.calibrate.color_page import LiveGallery, StillGallery
        from sightline.operator_side.cockpit.frame_buffer import fill

        still = self._of_file(frames)
        if still is not None:
            yield StillGallery(still)
            return
        ending = threading.Event()
        with self._link() as (link, role):
            pictures, gallery = Pictures(link, role, FRAME, self._target.secure), LiveGallery(frames)
            filling = threading.Thread(
                target=fill, args=(gallery.buffer, pictures, ending), name="pictures", daemon=True)
            filling.start()
            try:
                yield gallery
            finally:
                ending.set()
                filling.join(2.0)

    @property
    def title(self) -> str:
        """Return the title of the page."""
        return str(self._picture or self._video or f"robot {self._target.robot}")

    def _of_file(self, frames: int) -> "list[Image] | None":
        from sightline.operator_side.calibrate.color_page import of_picture, of_video

        if self._picture is not None:
            return of_picture(home_path(self._picture))
        return of_video(home_path(self._video), frames) if self._video is not None else None


def _at_once(pictures: "list[Image]", place: "Box", config: Path | None, mask: Path, as_json: bool) -> None:
    from sightline.operator_side.calibrate.color import check_trial, pick, ranges_text, trial_text, try_out
    from sightline.operator_side.calibrate.color_file import write_mask

    ranges = pick(pictures[-1], place)
    trial = try_out(ranges, pictures)
    write_mask(home_path(mask), ranges, pictures[-1])
    check_trial(trial)
    note = _use(ranges, config)
    if as_json:
        found: dict[str, Any] = {"ranges": [one.model_dump() for one in ranges], "trial": asdict(trial)}
        typer.echo(json.dumps({**found, "mask": str(mask), "written": str(config) if config else None}))
        return
    typer.echo(f"{ranges_text(ranges)}\n{trial_text(trial)}\nmask: {mask}\n{note}")


def _on_page(source: _Source, frames: int, config: Path | None, port: int) -> None:
    from sightline.operator_side.calibrate.color_page import PickPage
    from sightline.operator_side.cockpit.http_server import served

    notes: list[str] = []

    def use(ranges: "Ranges") -> str:
        notes.append(_use(ranges, config))
        return f"written to {config}; restart the vision service to use it" if config else "printed in the terminal"

    with source.gallery(frames) as gallery:
        picking = PickPage(gallery, source.title, use)
        with served(picking.routes, port) as address:
            typer.echo(f"pick-color: {source.title} is at {address} for a browser on this machine; Ctrl-C ends it")
            while not picking.done.wait(_WAIT_S):
                pass
            time.sleep(_PAGE_S)
    typer.echo(notes[-1])


def _use(ranges: "Ranges", config: Path | None) -> str:
    """Write the ranges to `config`. Returns a note, or the lines to paste."""
    from sightline.operator_side.calibrate.color_file import ranges_toml, write_ranges

    if config is None:
        return f"add to the configuration of the vision service:\n[hsv]\nranges = {ranges_toml(ranges)}"
    write_ranges(config, ranges)
    return f"wrote hsv.ranges to {config}"
