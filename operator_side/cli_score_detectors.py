"""Command `score detectors`: any set of detectors on the same labelled scenes. Shell."""

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import ConfigFile, Device, Sets
from sightline.operator_side.preflight import needs
from sightline.operator_side.out_file import check_out_file
from sightline.operator_side.service_settings import load_service
from sightline.protocol.errors import ConfigError

if TYPE_CHECKING:
    from sightline.evaluation.checks import Check
    from sightline.evaluation.score.detector_report import Report, ScoredScene, Subject
    from sightline.operator_side.score_sheet import Sheet
    from sightline.operator_side.config.loading import Loaded

COMPARED = ("hsv", "onnx")
FRAMES = 100
FROM = 900_000
"""As sim/scenes/model.py has it; that file needs more than the command line may at its start. A test compares them."""


def detectors(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[NAME]...", help="Of `sightline detector list` [default: hsv onnx].")
    ] = None,
    *,
    frames: Annotated[
        int | None, typer.Option(min=1, max=100_000, help="Scenes in each column [default: 100; with --demand 500].")
    ] = None,
    seeds: Annotated[int, typer.Option(min=0, max=10**9, metavar="FROM", help="The first scene's seed.")] = FROM,
    column: Annotated[str, typer.Option(help="`all`, or names separated by commas, e.g. blur,all at once.")] = "all",
    looks: Annotated[int, typer.Option(min=1, max=100, help="Each scene this often: `adaptive` has to make sure.")] = 1,
    demand: Annotated[
        bool, typer.Option("--demand", help="Judge by what is demanded of a learned detector; exit code 5 if it fails.")
    ] = False,
    device: Device = None,
    config: ConfigFile = None,
    sets: Sets = None,
    sheet: Annotated[Path | None, typer.Option(metavar="FILE", help="Write a PNG of scenes and answers.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object, for scripts.")] = False,
) -> int:
    """Compare detectors on drawn scenes: hits, wrong objects, false alarms, centre error, time. Seeds from 900000 are
    for judging only: nothing may be trained or tuned on them.
    """
    with needs("all"):
        from sightline.operator_side.score_detectors_bounds import FRAMES as DEMANDED_FRAMES
        from sightline.operator_side.score_detectors_bounds import all_detector_checks
        from sightline.evaluation.score.detector_report import LIGHT_SHARE, close_subjects, score_scenes
        from sightline.operator_side.score_sheet import Sheet
        from sightline.operator_side.score_table import progress
    if demand and seeds < FROM:
        raise ConfigError(f"--demand judges, which only seeds from {FROM} up are for, not {seeds}")
    if sheet is not None:
        check_out_file(sheet)
    columns, shown = _columns(column), frames or (DEMANDED_FRAMES if demand else FRAMES)
    asked = _subjects(names or COMPARED, config, sets or (), device)
    try:
        drawn = Sheet(asked) if sheet else None
        with progress(int((len(columns) + LIGHT_SHARE) * shown)) as advance:
            report = score_scenes(asked, shown, seeds, looks=looks, columns=columns, each=_each(advance, drawn))
    finally:
        close_subjects(asked)
    code = _print_report(report, all_detector_checks(report) if demand else None, as_json)
    if sheet and drawn:
        _write_sheet(sheet, drawn)
    return code


def _subjects(
    names: Sequence[str], file: str | None, sets: Sequence[str], device: str | None
) -> "list[Subject]":
    """As `sightline vision` with the same options would build them; only the detectors, nothing that goes around."""
    from sightline.evaluation.score.detector_report import subjects

    loaded = load_service("vision", file=file, sets=sets, options={"detector.device": device}, environ=os.environ)
    settings: Any = loaded.config
    _check_device(names, settings)
    return subjects(names, settings, {_whose_options(names, loaded): settings.detector.options})


def _whose_options(names: Sequence[str], loaded: "Loaded") -> str:
    """Of the detector that the configuration names, or else of the only one that is compared."""
    settings: Any = loaded.config
    is_named = loaded.origin(("detector", "kind")) != "default"
    whose: str = names[0] if len(names) == 1 and not is_named else settings.detector.kind
    if settings.detector.options and not is_named and whose not in names:
        raise ConfigError("detector.options are one detector's: say whose with --set detector.kind=NAME")
    return whose


def _check_device(names: Sequence[str], settings: Any) -> None:
    """Raise ConfigError where none of them has a device to choose."""
    from sightline.vision_side.detect.registry import check_device

    alone = {"fallback": "", "shadow": ""}
    errors = []
    for name in names:
        own = settings.detector.model_copy(update={"kind": name, **alone})
        try:
            check_device(settings.model_copy(update={"detector": own}))
        except ConfigError as error:
            errors.append(error)
    if len(errors) == len(names):
        raise errors[0]


def _print_report(report: "Report", checks: "list[Check] | None", as_json: bool) -> int:
    from sightline.operator_side.cli.options import CHECK_FAILED
    from sightline.operator_side.score_detectors_text import check_lines, silence_lines, text

    ok = all(check.ok for check in checks or ())
    judged = {} if checks is None else {"ok": ok, "checks": [asdict(check) for check in checks]}
    for line in silence_lines(report):
        typer.echo(line, err=True)
    if as_json:
        typer.echo(json.dumps({**judged, **report.to_dict()}))
    else:
        typer.echo("\n".join([text(report), *check_lines(checks or ())]))
    return 0 if ok else CHECK_FAILED


def _columns(asked: str) -> list[str]:
    from sightline.operator_side.settings_errors import no_such_name
    from sightline.sim.scenes.model import COLUMNS

    names = list(COLUMNS) if asked == "all" else [one.strip() for one in asked.split(",")]
    for one in names:
        if one not in COLUMNS:
            raise ConfigError(f"--column: {no_such_name('column', one, list(COLUMNS))}")
    return names


def _each(advance: Callable[[], None], drawn: "Sheet | None") -> Callable[["ScoredScene"], None]:
    def each(seen: "ScoredScene") -> None:
        advance()
        if drawn is not None:
            drawn.add(seen)

    return each


def _write_sheet(path: Path, drawn: "Sheet") -> None:
    import cv2

    try:
        path.write_bytes(cv2.imencode(".png", drawn.picture())[1].tobytes())
    except OSError as error:
        raise ConfigError(f"--sheet {path}: {error.strerror}") from None
