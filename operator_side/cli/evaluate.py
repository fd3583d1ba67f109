"""Commands that judge: `demo`, `score`. Shell. Exit code 5 when a check is outside its bound."""

import json
import os
import webbrowser
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from sightline.operator_side.cli.options import CHECK_FAILED, Json, numbers
from sightline.operator_side.cli_score_detectors import detectors
from sightline.operator_side.preflight import needs


def register_demo_and_score(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    app.command(epilog="Example: sightline demo --scenario eight --latency-ms 100 --loss 0.1")(demo)
    group = typer.Typer(
        help=score.__doc__, rich_markup_mode=None, invoke_without_command=True, callback=score,
        epilog="Example: sightline score --scenario circle,eight --seeds 101,102,103",
    )
    group.command(epilog="Example: sightline score detectors hsv onnx --sheet runs/sheet.png")(detectors)
    app.add_typer(group, name="score")


def demo(
    *,
    scenario: Annotated[str, typer.Option(help="A name of `sightline scenarios`, or a .toml.")] = "circle",
    mission: Annotated[str | None, typer.Option(help="In place of the scenario's own, e.g. a baseline law.")] = None,
    detector: Annotated[str | None, typer.Option(help="Of `sightline detector list` [default: hsv].")] = None,
    seconds: Annotated[
        float | None, typer.Option(help="How long; 0: until Ctrl-C [default: 20, or what the course takes].")
    ] = None,
    seed: Annotated[int, typer.Option(help="Draws the start and the noise.")] = 1,
    latency_ms: Annotated[float, typer.Option(help="Added from capture to command, half on each leg.")] = 0.0,
    loss: Annotated[float, typer.Option(help="Share of messages lost on each leg, e.g. 0.1.")] = 0.0,
    transport: Annotated[str, typer.Option(help="How vision reaches the robot: zenoh, websocket, legacy.")] = "zenoh",
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Run folder [default: runs/TIME-...].")] = None,
    open_it: Annotated[bool, typer.Option("--open", help="Show the film when it is over.")] = False,
    as_json: Json = False,
) -> int:
    """Follow a ball by sight, or what else a scenario is about: simulation, robot and vision as real processes over
    Zenoh, scored and filmed.
    """
    _check_installed("pybullet", "av", "matplotlib", "mcap")
    with needs("all"):
        from sightline.operator_side.demo import DemoOptions, run_demo
        from sightline.evaluation.demo.report import report, summary
    say = _to_stderr if as_json else typer.echo
    lasting_s = _seconds(scenario, seconds)
    run = run_demo(DemoOptions(scenario, lasting_s, seed, latency_ms, loss, out, transport, mission, detector), say)
    say("all three have ended; the run is being scored, replayed and filmed")
    judged = report(run)
    if as_json:
        typer.echo(json.dumps(judged.to_dict()))
    else:
        typer.echo("\n".join(summary(judged)))
    if open_it:
        webbrowser.open((judged.run.folder / "run.mp4").as_uri())
    return 0 if judged.ok else CHECK_FAILED


def _seconds(scenario: str, asked: float | None) -> float:
    """A ball is followed for as long as one likes; a course is driven to its end."""
    from sightline.sim.scenario import load_scenario

    if asked is not None:
        return asked
    loaded = load_scenario(scenario)
    return loaded.seconds if loaded.goals_m or loaded.light else 20.0


def _check_installed(*packages: str) -> None:
    """So that what the end needs is missed at the beginning. Raises ConfigError."""
    with needs("all"):
        for package in packages:
            if find_spec(package) is None:
                raise ModuleNotFoundError(package, name=package)


def _to_stderr(line: str) -> None:
    typer.echo(line, err=True)


def score(
    context: typer.Context,
    *,
    scenario: Annotated[str, typer.Option(help="`all`, or names separated by commas.")] = "all",
    seeds: Annotated[str, typer.Option(help="Separated by commas; judge with seeds nobody tuned on.")] = "1,2,3",
    latency_ms: Annotated[str, typer.Option(help="Added latencies, separated by commas.")] = "50",
    loss: Annotated[str, typer.Option(help="Losses on each leg, separated by commas.")] = "0.1",
    seconds: Annotated[float | None, typer.Option(min=1, max=3600, help="[default: the scenario's own]")] = None,
    mission: Annotated[str | None, typer.Option(help="In place of the scenario's own, e.g. a baseline law.")] = None,
    robot_model: Annotated[str | None, typer.Option(help="In place of the scenario's own robot.")] = None,
    look: Annotated[str | None, typer.Option(help="In place of the scenario's own light, e.g. dim.")] = None,
    detector: Annotated[str | None, typer.Option(help="In place of the scenario's own, e.g. onnx.")] = None,
    page: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Run every behaviour and its baseline, and write this page.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, max=256, help="Runs at once [default: one per core].")] = None,
    as_json: Json = False,
) -> int:
    """Drive in virtual time, many times, and judge: the services' own logic, world truth, median and worst."""
    if context.invoked_subcommand is not None:
        return 0
    with needs("all"):
        from sightline.evaluation.score.runs import cases, run_cases
        from sightline.operator_side.score_table import progress, score_text
        from sightline.sim.scenario import scenario_names
    if page is not None:
        return _write_page(page, numbers("--seeds", seeds, int), jobs or os.cpu_count() or 1)
    wanted = cases(
        scenario_names() if scenario == "all" else scenario.split(","),
        numbers("--seeds", seeds, int), numbers("--latency-ms", latency_ms, float), numbers("--loss", loss, float),
        seconds, mission=mission, robot=robot_model, look=look, detector=detector,
    )
    with progress(len(wanted)) as advance:
        report = run_cases(wanted, jobs or os.cpu_count() or 1, lambda _case: advance())
    typer.echo(json.dumps(report.to_dict()) if as_json else score_text(report))
    return 0 if report.ok else CHECK_FAILED


def _write_page(page: Path, seeds: list[int], jobs: int) -> int:
    with needs("all"):
        from sightline.operator_side.behaviours import write_page
        from sightline.operator_side.score_table import progress
    return 0 if write_page(page, seeds, jobs, progress) else CHECK_FAILED


