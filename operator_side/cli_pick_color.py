"""The command `pick-color`: a place in a picture becomes a colour range that vision follows. Shell."""

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import DEFAULT_CONNECT, Connect, Json, Port, Secure
from sightline.operator_side.preflight import needs
from sightline.operator_side.pictures import Pictures, viewer_role
from sightline.protocol.channels import FRAME
from sightline.protocol.errors import ConfigError
from sightline.protocol.transports.open import open_link

if TYPE_CHECKING:
    from sightline.operator_side.calibrate.color import Box, Image, Ranges
    from sightline.operator_side.calibrate.color_page import Gallery

_MASK = Path("pick-color-mask.png")
_WAIT_S = 0.2
_LAST_WORD_S = 0.3  # for the page to hear what became of it


def register_pick_color(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("pick-color", epilog="Example: sightline pick-color r1 --config vision.toml")(pick_color)


def pick_color(
    robot: Annotated[str | None, typer.Argument(metavar="[ROBOT]", help="Its pictures [default: r1].")] = None,
    *,
    picture: Annotated[Path | None, typer.Option("--picture", metavar="FILE", help="From a picture instead.")] = None,
    video: Annotated[Path | None, typer.Option("--video", metavar="FILE", help="From a video instead.")] = None,
    at: Annotated[str | None, typer.Option("--at", metavar="X,Y", help="Pick this pixel; no browser.")] = None,
    box: Annotated[str | None, typer.Option("--box", metavar="X,Y,W,H", help="Pick this box; no browser.")] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, max=200, help="Pictures that the range is tried on.")] = 20,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Vision's configuration, to write it into.")
    ] = None,
    mask: Annotated[
        Path | None, typer.Option("--mask", metavar="FILE", help="What it marks [default: pick-color-mask.png].")
    ] = None,
    port: Port = 0,
    connect: Connect = DEFAULT_CONNECT,
    secure: Secure = "",
    as_json: Json = False,
) -> None:
    """Click, or draw a box, on what is to be followed: gives its colour range, tries it, and writes it where told.

    Opens a page for a browser on this machine; with --at or --box it needs none.
    """
    sources = [name for name, given in (("ROBOT", robot), ("--picture", picture), ("--video", video)) if given]
    if len(sources) > 1:
        raise ConfigError(f"{' and '.join(sources)}: pictures come from one of them; give one")
    place = place_of(at, box)
    if as_json and place is None:
        raise ConfigError("--json is for scripts, which have no browser: add --at X,Y or --box X,Y,W,H")
    with needs("vision"):
        from sightline.operator_side.pick_color_file import check_config
    config = config.expanduser() if config else None
    if config is not None:
        check_config(config)
    source = _Source(robot or "r1", picture, video, connect, secure)
    if place is None:
        _on_page(source, frames, config, port)
    else:
        _at_once(source.pictures(frames), place, config, mask or _MASK, as_json)


def place_of(at: str | None, box: str | None) -> "Box | None":
    """The place of `--at` or `--box`; None for neither. Raises ConfigError for what is no place."""
    with needs("vision"):
        from sightline.operator_side.calibrate.color import Box
    if at and box:
        raise ConfigError("--at is one pixel and --box a part of the picture; give one of them")
    for option, text, form in (("--at", at, "X,Y"), ("--box", box, "X,Y,W,H")):
        if text is None:
            continue
        parts = [part.strip() for part in text.split(",")]
        right = len(parts) == form.count(",") + 1 and all(p.isascii() and p.isdigit() and len(p) < 6 for p in parts)
        if not right or (option == "--box" and "0" in (parts[2].lstrip("0") or "0", parts[3].lstrip("0") or "0")):
            raise ConfigError(f"{option} {text!r} is no place: write {form} in whole pixels, e.g. {option} "
                              f"{'160,120' if option == '--at' else '150,110,20,20'}")
        return Box(*(int(part) for part in parts))
    return None


class _Source:
    """Where pictures come from."""

    def __init__(self, robot: str, picture: Path | None, video: Path | None, connect: list[str], secure: str) -> None:
        self._robot, self._picture, self._video, self._connect, self._secure = robot, picture, video, connect, secure

    def pictures(self, frames: int) -> "list[Image]":
        """At most `frames`, the newest last."""
        from sightline.operator_side.calibrate.color_page import of_robot

        still = self._of_file(frames)
        if still is not None:
            return still
        role = viewer_role(self._secure)
        with open_link(self._robot, connect=self._connect, role=role, secure=self._secure) as link:
            return of_robot(Pictures(link, role, FRAME, self._secure), frames)

    @contextmanager
    def gallery(self, frames: int) -> "Iterator[Gallery]":
        """For a page."""
        from sightline.operator_side.calibrate.color_page import LiveGallery, StillGallery
        from sightline.operator_side.cockpit.frame_buffer import FrameBuffer, fill

        still = self._of_file(frames)
        if still is not None:
            yield StillGallery(still)
            return
        role, ending = viewer_role(self._secure), threading.Event()
        with open_link(self._robot, connect=self._connect, role=role, secure=self._secure) as link:
            pictures, reel = Pictures(link, role, FRAME, self._secure), FrameBuffer(frames)
            filling = threading.Thread(target=fill, args=(reel, pictures, ending), name="pictures", daemon=True)
            filling.start()
            try:
                yield LiveGallery(reel)
            finally:
                ending.set()
                filling.join(2.0)

    @property
    def title(self) -> str:
        """What the page is about."""
        return str(self._picture or self._video or f"robot {self._robot}")

    def _of_file(self, frames: int) -> "list[Image] | None":
        from sightline.operator_side.calibrate.color_page import of_picture, of_video

        if self._picture is not None:
            return of_picture(self._picture.expanduser())
        return of_video(self._video.expanduser(), frames) if self._video is not None else None


def _at_once(pictures: "list[Image]", place: "Box", config: Path | None, mask: Path, as_json: bool) -> None:
    from sightline.operator_side.calibrate.color import check_trial, pick, ranges_text, trial_text, try_out
    from sightline.operator_side.pick_color_file import write_mask

    ranges = pick(pictures[-1], place)
    trial = try_out(ranges, pictures)
    write_mask(mask.expanduser(), ranges, pictures[-1])
    check_trial(trial)
    said = _use(ranges, config)
    if as_json:
        found: dict[str, Any] = {"ranges": [one.model_dump() for one in ranges], "trial": asdict(trial)}
        typer.echo(json.dumps({**found, "mask": str(mask), "written": str(config) if config else None}))
        return
    typer.echo(f"{ranges_text(ranges)}\n{trial_text(trial)}\nmask: {mask}\n{said}")


def _on_page(source: _Source, frames: int, config: Path | None, port: int) -> None:
    from sightline.operator_side.loopback_page import served
    from sightline.operator_side.pick_color_page import PickPage

    said: list[str] = []

    def use(ranges: "Ranges") -> str:
        said.append(_use(ranges, config))
        return f"written into {config}; restart vision to see by it" if config else "printed in the terminal"

    with source.gallery(frames) as gallery:
        picking = PickPage(gallery, source.title, use)
        with served(picking.routes, port) as address:
            typer.echo(f"pick-color: {source.title} is on {address} for a browser on this machine; Ctrl-C ends it")
            while not picking.done.wait(_WAIT_S):
                pass
            time.sleep(_LAST_WORD_S)
    typer.echo(said[-1])


def _use(ranges: "Ranges", config: Path | None) -> str:
    """Write the ranges where told, and say what was done, or what a person can paste."""
    from sightline.operator_side.pick_color_file import write_ranges
    from sightline.operator_side.calibrate.color_file import ranges_toml

    if config is None:
        return f"for vision's configuration:\n[hsv]\nranges = {ranges_toml(ranges)}"
    write_ranges(config, ranges)
    return f"written: {config}, hsv.ranges"
