"""Commands that evaluate: demo, score, score detectors, faults, train. Shell."""

import hashlib
import os
import tempfile
import webbrowser
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from sightline.operator_side.cli.options import (
    ConfigFile,
    DetectorName,
    Device,
    Json,
    ScenarioNames,
    Sets,
    complete_detector,
    complete_mission,
    complete_robot_model,
    complete_scenario,
    numbers,
    plugin_prints,
    print_result,
)
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.preflight import needs
from sightline.operator_side.table import print_table
from sightline.operator_side.terminal import progress_bar
from sightline.protocol.errors import ConfigError, HardwareError
from sightline.protocol.log import error_text
from sightline.training.schedule import Training

if TYPE_CHECKING:
    from sightline.evaluation.checks import Check
    from sightline.evaluation.demo.run import DemoOptions
    from sightline.evaluation.faults.report import Results
    from sightline.evaluation.score.detector_report import DetectorReport, Subject
    from sightline.evaluation.score.photo_report import PhotoReport
    from sightline.operator_side.config.loading import Loaded
    from sightline.training.network import Weights


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline demo --scenario eight --latency-ms 100 --loss 0.1")(demo)
    group = typer.Typer(
        help=score.__doc__, rich_markup_mode=None, invoke_without_command=True, callback=score,
        epilog="Example: sightline score --scenario circle,eight --seeds 101,102,103",
    )
    group.command(epilog="Example: sightline score detectors hsv onnx --demand")(detectors)
    app.add_typer(group, name="score")
    app.command(epilog="Example: sightline faults --only vision.kill --only wire")(faults)
    app.command(epilog="Example: sightline train --out runs/train")(train)


MissionName = Annotated[
    str | None, typer.Option("--mission", autocompletion=complete_mission, help="Mission [default: of the scenario].")
]


def demo(
    *,
    scenario: Annotated[
        str, typer.Option(autocompletion=complete_scenario, help="A name from `sightline scenarios`, or a .toml file.")
    ] = "circle",
    mission: MissionName = None,
    detector: DetectorName = None,
    seconds: Annotated[
        float | None, typer.Option(help="Length; 0 runs until Ctrl-C [default: 20, or the length of the course].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the start and the noise.")] = 1,
    latency_ms: Annotated[float, typer.Option(help="Latency added from capture to command, half on each leg.")] = 0.0,
    loss: Annotated[float, typer.Option(help="Share of messages lost on each leg, e.g. 0.1.")] = 0.0,
    transport: Annotated[str, typer.Option(help="Link of the vision service: zenoh, websocket or legacy.")] = "zenoh",
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Run folder [default: runs/TIME-...].")] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Open the film at the end.")] = False,
    story: Annotated[bool, typer.Option("--story", help="Film the stops, then a naive robot at a wall.")] = False,
    as_json: Json = False,
) -> int:
    """Simulate, drive, score and film a run on this machine

    Simulation, robot and vision service run as real processes over Zenoh. The results go to --out.
    """
    _check_installed("pybullet", "av", "matplotlib", "mcap")
    with needs("all"):
        from sightline.evaluation.demo.report import report, summary, write_files
        from sightline.evaluation.demo.run import DemoOptions, run_demo, usual_s
        from sightline.sim.scenario import load_scenario
    show = _to_stderr if as_json else typer.echo
    if story:
        _check_story(DemoOptions(scenario, seconds or 0.0, seed, latency_ms, loss, out, transport, mission, detector))
        return _make_story(out, seed, show, as_json=as_json, open_it=open_it)
    lasting_s = usual_s(load_scenario(scenario)) if seconds is None else seconds
    options = DemoOptions(scenario, lasting_s, seed, latency_ms, loss, out, transport, mission, detector)
    with plugin_prints(as_json):
        run = run_demo(options, show)
        show("all three processes ended; scoring, replaying and filming the run")
        scored = report(run)
    code = print_result(scored.to_dict(), summary(scored), as_json)
    with plugin_prints(as_json):
        write_files(scored)  # after the results are printed, because a full disk must not lose them
    if open_it:
        webbrowser.open((scored.run.folder / "run.mp4").as_uri())
    return code


def _check_story(options: "DemoOptions") -> None:
    """Raise ConfigError for an option whose value the story fixes."""
    from dataclasses import fields

    for field in fields(options):
        if field.name not in ("seed", "out", "seconds") and getattr(options, field.name) != field.default:
            option = "--" + field.name.replace("_", "-")
            raise ConfigError(f"--story and {option} exclude each other: the story has its own scene; omit {option}")
    if options.seconds:
        raise ConfigError("--story and --seconds exclude each other: the story has its own length; omit --seconds")


def _make_story(out: Path | None, seed: int, show: Callable[[str], None], *, as_json: bool, open_it: bool) -> int:
    from sightline.evaluation.demo.story_run import FILM, make_story

    result = make_story(out, seed, show)
    code = print_result(result.to_dict(), result.lines(), as_json)
    if open_it:
        webbrowser.open((result.folder / FILM).as_uri())
    return code


def _check_installed(*packages: str) -> None:
    """Raise ConfigError for a package that is missing, before the run, even if only the report needs it."""
    with needs("all"):
        for package in packages:
            if find_spec(package) is None:
                raise ModuleNotFoundError(package, name=package)


def _to_stderr(line: str) -> None:
    typer.echo(line, err=True)


def score(
    context: typer.Context,
    *,
    scenario: ScenarioNames = "all",
    seeds: Annotated[str, typer.Option(help="Seeds, separated by commas; use seeds without tuning on them.")] = "1,2,3",
    latency_ms: Annotated[str, typer.Option(help="Added latencies in ms, separated by commas.")] = "50",
    loss: Annotated[str, typer.Option(help="Losses on each leg, separated by commas.")] = "0.1",
    seconds: Annotated[
        float | None, typer.Option(min=1, max=3600, help="Length of a run [default: of the scenario].")
    ] = None,
    mission: MissionName = None,
    robot_model: Annotated[
        str | None, typer.Option(autocompletion=complete_robot_model, help="Robot model [default: of the scenario].")
    ] = None,
    look: Annotated[str | None, typer.Option(help="Light, e.g. dim [default: of the scenario].")] = None,
    detector: Annotated[
        str | None,
        typer.Option(autocompletion=complete_detector, help="Detector, e.g. onnx [default: of the scenario]."),
    ] = None,
    sabotage: Annotated[
        list[str] | None, typer.Option(help="Break one part, e.g. wheels-dead, or `all`; each run must fail.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, max=256, help="Runs in parallel [default: one per core].")] = None,
    as_json: Json = False,
) -> int:
    """Score missions over many starts in virtual time

    It runs the logic of the services against the simulated truth and prints median and worst of each figure.
    """
    if context.invoked_subcommand is not None:
        return 0
    with needs("all"):
        from sightline.evaluation.score.runs import cases, run_all_sabotaged, run_cases, sabotaged, score_text
        from sightline.evaluation.score.sabotage import sabotages_named
        from sightline.sim.scenario import scenario_names
    wanted = cases(
        scenario_names() if scenario == "all" else [name.strip() for name in scenario.split(",")],
        numbers("--seeds", seeds, int), numbers("--latency-ms", latency_ms, float), numbers("--loss", loss, float),
        seconds, mission=mission, robot=robot_model, look=look, detector=detector,
    )
    if sabotage:
        wanted = sabotaged(wanted, sabotages_named(sabotage))
        with plugin_prints(as_json), progress_bar(len(wanted)) as advance:
            noticed = run_all_sabotaged(wanted, jobs or os.cpu_count() or 1, lambda _case: advance())
        return print_result(noticed.to_dict(), noticed.lines(), as_json)
    with plugin_prints(as_json), progress_bar(len(wanted)) as advance:
        report = run_cases(wanted, jobs or os.cpu_count() or 1, lambda _case: advance())
    return print_result(report.to_dict(), [score_text(report)], as_json)


# --- `score detectors`: detectors on the same labeled scenes -----------------------------------------------------


COMPARED = ("hsv", "onnx")
PHOTO_FRAMES, PHOTO_SEED = 60, 1
SHIPPED = "shipped"
_PHOTOS = f"Score balls put into these photographs, and false alarms; `{SHIPPED}` are those that come along."
_COLUMN = "`all`, or names separated by commas, e.g. blur,all at once. With --photos, one name: its camera takes them."
FRAMES = 100
FROM = 900_000
"""Equal to FROM in sim/scenes/model.py, whose imports are too slow for the command line. A test compares them."""


def detectors(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="NAME", autocompletion=complete_detector,
                       help="See `sightline detector list` [default: hsv onnx]."),
    ] = None,
    *,
    frames: Annotated[
        int | None, typer.Option(min=1, max=100_000, help="Scenes in each column [default: 100; with --demand 1000].")
    ] = None,
    seeds: Annotated[int, typer.Option(min=0, max=10**9, metavar="FROM", help="Seed of the first scene.")] = FROM,
    column: Annotated[str, typer.Option(help=_COLUMN)] = "all",
    photos: Annotated[Path | None, typer.Option(metavar="DIR", help=_PHOTOS)] = None,
    tracked: Annotated[bool, typer.Option("--tracked", help="Expect each ball where it is, as a track does.")] = False,
    colored: Annotated[bool, typer.Option("--colored", help="Set each ball's color, as `pick-color` does.")] = False,
    looks: Annotated[int, typer.Option(min=1, max=100, help="Detections of each scene; `adaptive` needs several.")] = 1,
    demand: Annotated[
        bool, typer.Option("--demand", help="Check the bounds of a learned detector; exit code 5 if it fails.")
    ] = False,
    device: Device = None,
    config: ConfigFile = None,
    sets: Sets = None,
    as_json: Json = False,
) -> int:
    """Compare detectors on generated scenes

    It prints hits, wrong objects, false alarms, center error and time. Seeds from 900000 are for scoring only.
    """
    with needs("all"):
        from sightline.evaluation.score.detector_report import FRAMES as DEMANDED_FRAMES
        from sightline.evaluation.score.detector_report import (
            LIGHT_SHARE,
            all_detector_checks,
            close_subjects,
            score_scenes,
        )
    if photos is not None:
        if demand:
            raise ConfigError("--demand checks the bounds of generated scenes; leave out --photos")
        return _score_photos(photos, lambda more: _subjects(names or COMPARED, config, (*(sets or ()), *more), device),
                             frames or PHOTO_FRAMES, looks, seed=PHOTO_SEED if seeds == FROM else seeds, column=column,
                             tracked=tracked, colored=colored, as_json=as_json)
    if tracked or colored:
        raise ConfigError("--tracked and --colored belong to --photos")
    if demand and seeds < FROM:
        raise ConfigError(f"--demand needs seeds from {FROM} up, which no training uses; {seeds} is lower")
    columns, shown = _columns(column), frames or (DEMANDED_FRAMES if demand else FRAMES)
    with plugin_prints(as_json):
        subjects = _subjects(names or COMPARED, config, sets or (), device)
        try:
            with progress_bar(int((len(columns) + LIGHT_SHARE) * shown)) as advance:
                report = score_scenes(subjects, shown, seeds, looks=looks, columns=columns, each=lambda _: advance())
        finally:
            close_subjects(subjects)
    return _print_report(report, all_detector_checks(report) if demand else None, as_json)


def _score_photos(photos: Path, build: "Callable[[Sequence[str]], list[Subject]]", each: int, looks: int, *,
                  seed: int, column: str, tracked: bool, colored: bool, as_json: bool) -> int:
    """Score detectors on photographs. `build` receives additional settings."""
    from sightline.evaluation import photographs as folder
    from sightline.evaluation.score.ball_textures import KINDS
    from sightline.evaluation.score.detector_report import close_subjects
    from sightline.evaluation.score.photo_report import COLORS, color_setting, colored_lines, photo_lines, score_photos
    from sightline.sim.scenes.model import COLUMNS

    columns = [] if column == "all" else _columns(column)
    if len(columns) > 1:
        raise ConfigError(f"--column {column}: with --photos one column at a time")
    camera = COLUMNS[columns[0]] if columns else None

    def scored(settings: Sequence[str], kinds: Sequence[str]) -> "PhotoReport":
        subjects = build(settings)
        try:
            return score_photos(subjects, photographs, each, seed, looks=looks, tracked=tracked, kinds=kinds,
                                column=camera, advance=advance)
        finally:
            close_subjects(subjects)

    photographs = folder.read_photographs(folder.SHIPPED if str(photos) == SHIPPED else photos)
    if not colored:
        with plugin_prints(as_json), progress_bar(len(KINDS) * each + len(photographs)) as advance:
            report = scored((), KINDS)
        return print_result(report.to_dict(), photo_lines(report), as_json)
    with plugin_prints(as_json), progress_bar(len(COLORS) * (each + len(photographs))) as advance:
        reports = {kind: scored((color_setting(kind),), (kind,)) for kind in COLORS}
    return print_result({kind: one.to_dict() for kind, one in reports.items()}, colored_lines(reports), as_json)


def _subjects(
    names: Sequence[str], file: str | None, sets: Sequence[str], device: str | None
) -> "list[Subject]":
    """Build the detectors as `sightline vision` does with the same options, but without the service."""
    from sightline.evaluation.score.detector_report import subjects

    loaded = load_service("vision", file=file, sets=sets, options={"detector.device": device}, environ=os.environ)
    settings: Any = loaded.config
    _check_device(names, settings)
    return subjects(names, settings, {_whose_options(names, loaded): settings.detector.options})


def _whose_options(names: Sequence[str], loaded: "Loaded") -> str:
    """Return the detector to which the options apply: the configured one, or the only compared one."""
    settings: Any = loaded.config
    is_named = loaded.origin(("detector", "kind")) != "default"
    whose: str = names[0] if len(names) == 1 and not is_named else settings.detector.kind
    if settings.detector.options and not is_named and whose not in names:
        raise ConfigError("detector.options belong to one detector; name it with --set detector.kind=NAME")
    return whose


def _check_device(names: Sequence[str], settings: Any) -> None:
    """Raise ConfigError if no detector in the list accepts a device."""
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


def _print_report(report: "DetectorReport", checks: "list[Check] | None", as_json: bool) -> int:
    from sightline.evaluation.checks import check_lines, to_dict
    from sightline.evaluation.score.detector_report import silence_lines, text

    for line in silence_lines(report):
        typer.echo(line, err=True)
    result = {**({} if checks is None else to_dict(checks)), **report.to_dict()}
    return print_result(result, [text(report), *check_lines(checks or ())], as_json)


def _columns(given: str) -> list[str]:
    from sightline.operator_side.config.errors import no_such_name
    from sightline.sim.scenes.model import COLUMNS

    names = list(COLUMNS) if given == "all" else [one.strip() for one in given.split(",")]
    for one in names:
        if one not in COLUMNS:
            raise ConfigError(f"--column: {no_such_name('column', one, list(COLUMNS))}")
    return names


# --- `faults` ----------------------------------------------------------------------------------------------------


JOBS = min(4, (os.cpu_count() or 1) + 1)
"""A row mostly waits, so several run in parallel. A row that other load disturbed too much runs again."""


def faults(
    *,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="ID", help="A row, or a group such as `wire`; repeatable.")
    ] = None,
    short: Annotated[bool, typer.Option("--short", help="Run the short set, as in CI.")] = False,
    repeat: Annotated[int, typer.Option(min=1, max=100, help="Runs of each row.")] = 1,
    jobs: Annotated[
        int, typer.Option(min=1, max=16, help="Rows in parallel; rows that need the whole machine run alone.")
    ] = JOBS,
    listing: Annotated[bool, typer.Option("--list", help="List the rows and their demands; run nothing.")] = False,
    as_json: Json = False,
) -> int:
    """Inject faults into real processes and check each stop

    Each row breaks one thing and checks the log of the simulated motors. Exit code 5 means that a row failed.
    """
    with needs("all"):
        from sightline.evaluation.faults.cases import chosen
        from sightline.evaluation.faults.report import (
            progress_line,
            to_dict,
        )
        from sightline.evaluation.faults.runner import run_cases
    rows = chosen(only or (), short=short)
    if listing:
        print_table((row.id, f"{row.what}: {row.demanded}") for row in rows)
        return 0
    folder = Path(tempfile.mkdtemp(prefix="sightline-faults-"))
    try:
        results = run_cases(
            rows, repeat, folder, jobs, lambda one, progress: typer.echo(progress_line(one, *progress), err=as_json)
        )
    except KeyboardInterrupt:
        _remove_if_empty(folder)
        if folder.exists():
            typer.echo(f"logs of failed and interrupted rows are in {folder}", err=True)
        raise
    _remove_if_empty(folder)
    return print_result(to_dict(results), [_summary(results, folder)], as_json)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):  # a failed row leaves its logs in the folder
        folder.rmdir()


def _summary(results: "Results", folder: Path) -> str:
    ran = [outcomes for outcomes in results if not outcomes[0].skipped]
    good = sum(all(one.ok for one in outcomes) for outcomes in ran)
    left = f"; logs of failed rows are in {folder}" if folder.exists() else ""
    return f"{good} of {len(ran)} rows passed, {len(results) - len(ran)} skipped on this machine{left}"


# --- `train` -----------------------------------------------------------------------------------------------------


STEPS = [15_000, 14_000, 13_000, 14_000, 20_000, 20_000]
SCENES = 100_000
BATCH = 32
RATE = 0.003
OVER_PHOTOS = 60_000
VALIDATED = 5000
"""The values of DRAWN in the card of the shipped model; a test compares them. The last round of the shipped model used
other code on a GPU, as the card states."""
OUT = Path("runs/train")
_STEPS = "Steps of one round; repeat the option for more rounds, each with a new learning rate and more scenes."
_START = "Train only the last round, starting from this model."
_LEAST_SHARE = 8
"""Least number of images per training process in a batch, because the normalization needs several."""


def train(
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of scenes, checkpoint, model and card.")] = OUT,
    scenes: Annotated[int, typer.Option(min=8, max=800_000, help="Scenes to generate, with seeds from 0 up.")] = SCENES,
    steps: Annotated[list[int], typer.Option(min=1, max=10_000_000, metavar="<int range>", help=_STEPS)] = STEPS,
    batch: Annotated[int, typer.Option(min=2, max=1024, help="Cut-outs of scenes in each step.")] = BATCH,
    rate: Annotated[float, typer.Option(min=1e-6, max=1.0, help="Highest learning rate of the first round.")] = RATE,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Seed of weights, cut-outs and defects.")] = 1,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Device that trains.")] = "cpu",
    jobs: Annotated[int | None, typer.Option(min=1, max=256, help="Processes [default: one per core].")] = None,
    start: Annotated[Path | None, typer.Option(metavar="MODEL", help=_START)] = None,
    photos: Annotated[Path | None, typer.Option(metavar="DIR", help="Ball-free photographs as backgrounds.")] = None,
    every: Annotated[int, typer.Option(min=1, max=1000, help="Use each n-th seed of the scenes only.")] = 1,
    over_photos: Annotated[int, typer.Option(min=8, max=800_000, help="Scenes over the photographs.")] = OVER_PHOTOS,
    validated: Annotated[int, typer.Option(min=5, max=100_000, help="Scenes per column for thresholds.")] = VALIDATED,
    scored: Annotated[
        int, typer.Option("--scored", "--judged", min=5, help="Scenes per column for the table of the card.")
    ] = 500,
) -> None:
    """Train the learned detector

    It generates labeled scenes and writes sightline.onnx with its card. An interrupted run continues where it ended.
    """
    with needs("train"):
        import torch

        from sightline.training.loop import TrainOptions, run_training
        from sightline.training.scenes import SceneSource
    if device == "cuda" and not torch.cuda.is_available():
        raise HardwareError("--device cuda: PyTorch finds no GPU; check `nvidia-smi` and that PyTorch is a CUDA "
                            "build, or use --device cpu")
    processes = jobs or os.cpu_count() or 1
    weights, digest = _begun(start) if start else (None, "")
    sharing = _sharing(batch, processes) if device == "cpu" else 1
    training = Training(tuple(steps), batch, rate, seed=seed, jobs=sharing, start=digest)
    source = SceneSource(scenes, over_photos if photos else 0, photos, every, start if photos else None)
    options = TrainOptions(out, source, training, device, processes, validated, scored, weights)
    try:
        out.mkdir(parents=True, exist_ok=True)
        model = run_training(options, _print_line, progress_bar)
    except OSError as error:
        raise ConfigError(f"--out {out}: {error.strerror or error}; free some space or name another folder") from None
    _print_line(f"{model}, {model.with_suffix('.md').name}: test it with `sightline score detectors onnx:{model}`")


def _begun(model: Path) -> "tuple[Weights, str]":
    """Return the weights of a model and its SHA-256."""
    from sightline.training.export import weights_in

    if model.exists() and not model.is_file():  # a pipe or a device may have no end
        raise ConfigError(f"--start {model} is not a regular file; name a model from `sightline train`")
    try:
        data = model.read_bytes()
        return weights_in(data), hashlib.sha256(data).hexdigest()
    except OSError as error:
        raise ConfigError(f"--start {model}: {error.strerror or error}") from None
    except Exception as error:  # onnx raises its own errors for another kind of model
        raise ConfigError(f"--start {model}: {error_text(error)}; name a model from `sightline train`") from None


def _sharing(batch: int, processes: int) -> int:
    """Return the number of processes that share a batch evenly."""
    return max(n for n in range(1, processes + 1) if n == 1 or (batch % n == 0 and batch // n >= _LEAST_SHARE))


def _print_line(line: str) -> None:
    typer.echo(line)
