"""Command `score detectors`: any set of detectors on the same labelled scenes. Shell."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from operator_side.extras import needs
from protocol.errors import ConfigError

if TYPE_CHECKING:
    from operator_side.score_scenes import Seen
    from operator_side.score_sheet import Sheet

COMPARED = ("hsv", "onnx")
FRAMES = 100
FROM = 900_000
"""As sim/scenes.py has it; that file needs more than the command line may at its start. A test compares them."""


def detectors(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Of `sightline detector list` [default: hsv onnx].")
    ] = None,
    *,
    frames: Annotated[int, typer.Option(min=1, max=100_000, help="Scenes in each column.")] = FRAMES,
    seeds: Annotated[int, typer.Option(min=0, max=10**9, metavar="FROM", help="The first scene's seed.")] = FROM,
    column: Annotated[str, typer.Option(help="`all`, or names separated by commas, e.g. blur,all at once.")] = "all",
    looks: Annotated[int, typer.Option(min=1, max=100, help="Each scene this often: `adaptive` has to make sure.")] = 1,
    sheet: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a PNG of scenes and answers.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> None:
    """Compare detectors on drawn scenes: hits, wrong objects, false alarms, centre error, time. Seeds from 900000 are
    for judging only: nothing may be trained or tuned on them.
    """
    with needs("all"):
        from operator_side.score_detectors_text import text
        from operator_side.score_scenes import LIGHT_SHARE, score_scenes, subjects
        from operator_side.score_sheet import Sheet
        from operator_side.score_table import progress
    columns = _columns(column)
    asked = subjects(names or list(COMPARED))
    drawn = Sheet(asked) if sheet else None
    with progress(int((len(columns) + LIGHT_SHARE) * frames)) as advance:
        report = score_scenes(asked, frames, seeds, looks=looks, columns=columns, each=_each(advance, drawn))
    typer.echo(json.dumps(report.to_dict()) if as_json else text(report))
    if sheet and drawn:
        _write(sheet, drawn)


def _columns(asked: str) -> list[str]:
    from operator_side.settings_errors import no_such_name
    from sim.scenes import COLUMNS

    names = list(COLUMNS) if asked == "all" else [one.strip() for one in asked.split(",")]
    for one in names:
        if one not in COLUMNS:
            raise ConfigError(f"--column: {no_such_name('column', one, list(COLUMNS))}")
    return names


def _each(advance: Callable[[], None], drawn: "Sheet | None") -> Callable[["Seen"], None]:
    def each(seen: "Seen") -> None:
        advance()
        if drawn is not None:
            drawn.add(seen)

    return each


def _write(path: Path, drawn: "Sheet") -> None:
    import cv2

    try:
        path.write_bytes(cv2.imencode(".png", drawn.picture())[1].tobytes())
    except OSError as error:
        raise ConfigError(f"--sheet {path}: {error.strerror}") from None
