"""`sightline bench`: what things cost on this machine. Shell. Exit code 5 when a check is outside its bound."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sightline.operator_side.cli_bench_detector import register_detector_benches
from sightline.operator_side.cli_bench_loop import register_loop_benches
from sightline.operator_side.cli_bench_network import register_network_bench
from sightline.operator_side.cli.options import CHECK_FAILED, Json, numbers
from sightline.operator_side.preflight import needs

if TYPE_CHECKING:
    from sightline.evaluation.checks import Check


def register_benches(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(help="Measure what things cost on this machine.", rich_markup_mode=None)
    group.command(epilog="Example: sightline bench codec --json")(codec)
    group.command(epilog="Example: sightline bench gate")(gate)
    group.command(epilog="Example: sightline bench pipeline")(pipeline)
    group.command(epilog="Example: sightline bench odometry")(odometry)
    group.command(epilog="Example: sightline bench robot --seconds 60")(robot)
    group.command(epilog="Example: sightline bench demo --scenario circle --seeds 201,202,203")(demo)
    group.command(epilog="Example: sightline bench report --section loop --section watchers")(report)
    register_loop_benches(group)
    register_network_bench(group)
    register_detector_benches(group)
    app.add_typer(group, name="bench")


def codec(*, as_json: Json = False) -> int:
    """Encode and decode a frame header and a twist."""
    from sightline.benchmarks.costs import measure_codec
    from sightline.evaluation.checks import Check

    costs = measure_codec()
    return print_checks([Check(cost.name, cost.median_us, "us", cost.bound_us, cost.ok) for cost in costs], as_json)


def gate(*, as_json: Json = False) -> int:
    """Judge one command and decide one step, as the driver does."""
    from sightline.benchmarks.gate import GATE_BOUND_US, measure_gate
    from sightline.evaluation.checks import Check

    took_us = measure_gate()
    return print_checks([Check("offer and step", took_us, "us", GATE_BOUND_US, took_us <= GATE_BOUND_US)], as_json)


def pipeline(*, as_json: Json = False) -> int:
    """Picture in, command out: decode, detect, track, steer. And the learned detector's network."""
    with needs("vision"):
        from sightline.benchmarks.pipeline import LEARNED_BOUND_US, time_learned, time_steps
    from sightline.evaluation.checks import Check

    checks = []
    for one in time_steps():
        size = f"{one.width_px}x{one.height_px}"
        checks.append(Check(
            f"step at {size}, hot (best round {one.alone_us:.0f}, paced {one.paced_us:.0f}, "
            f"decode {one.decode_us:.0f})",
            one.median_us, "us", one.bound_us, one.median_us <= one.bound_us and one.phase == "tracking",
        ))
        checks.append(Check(f"hsv at {size}, decoding included, hot (best round {one.hsv_alone_us:.0f})",
                            one.hsv_us, "us", one.bound_us, one.hsv_us <= one.bound_us))
    eyes = time_learned()
    checks.append(Check(
        f"onnx at 320x240, network only, hot (best round {eyes.alone_us:.0f}, from JPEG to boxes {eyes.whole_us:.0f}, "
        f"decode {eyes.decode_us:.0f}; {eyes.engine})",
        eyes.network_us, "us", LEARNED_BOUND_US, eyes.network_us <= LEARNED_BOUND_US,
    ))
    checks.append(Check("pictures in which onnx finds no ball", eyes.missed, "", 0, eyes.missed == 0))
    return print_checks(checks, as_json)


def odometry(
    *,
    robot_model: Annotated[
        list[str] | None, typer.Option(help="Only this robot, a name or a .toml; may be given again [default: all].")
    ] = None,
    as_json: Json = False,
) -> int:
    """Dead reckoning against the simulated world's truth, of every simulated robot."""
    with needs("sim"):
        from sightline.benchmarks.odometry import measure_odometry
    from sightline.evaluation.checks import Check

    errors = measure_odometry(robot_model or ())
    checks = [Check(one.name, one.percent, "%", one.bound_percent, one.percent <= one.bound_percent) for one in errors]
    return print_checks(checks, as_json)


def robot(
    *, seconds: Annotated[float, typer.Option(min=5, max=600, help="How long to drive.")] = 60.0, as_json: Json = False
) -> int:
    """The robot service in a bare environment of its own: frame rate and memory. Needs a checkout and pip."""
    with needs("all"):
        from sightline.benchmarks.light_robot import NETWORK_BOUND_MB, measure_light_robot
    from sightline.evaluation.checks import Check

    seen = measure_light_robot(seconds)
    checks = [
        Check("heavy packages installed", len(seen.heavy_packages), "", 0, not seen.heavy_packages),
        Check("missing from 30 fps", 30 - seen.fps, "fps", 0.6, seen.fps >= 29.4),
        Check("time not driving", 100 - seen.driving_percent, "%", 2.0, seen.driving_percent >= 98),
        Check("memory, network process", seen.network_mb, "MB", NETWORK_BOUND_MB, seen.network_mb <= NETWORK_BOUND_MB),
        Check("memory, driver", seen.driver_mb, "MB", NETWORK_BOUND_MB, seen.driver_mb <= NETWORK_BOUND_MB),
    ]
    return print_checks(checks, as_json)


def demo(
    *,
    scenario: Annotated[str, typer.Option(help="`all`, or names separated by commas.")] = "all",
    seeds: Annotated[str, typer.Option(help="Separated by commas.")] = "201,202,203",
    seconds: Annotated[
        float | None, typer.Option(min=5, max=3600, help="Of each demo [default: 20, or what the course takes].")
    ] = None,
    as_json: Json = False,
) -> int:
    """Many demos in real time; the median over seeds is judged."""
    with needs("all"):
        from sightline.benchmarks.real_time import Kinds, measure_demos
        from sightline.evaluation.checks import number
        from sightline.evaluation.score.figures import AT_LEAST
        from sightline.operator_side.score_bounds import EXACT
        from sightline.sim.scenario import load_scenario, scenario_names
    names = scenario_names() if scenario == "all" else scenario.split(",")
    for name in names:
        load_scenario(name)
    wanted, kinds = numbers("--seeds", seeds, int), Kinds(AT_LEAST, EXACT)
    figures = measure_demos(names, wanted, seconds, kinds, lambda line: typer.echo(line, err=True))
    ok = all(figure.ok for figure in figures)
    if as_json:
        checks = [{**asdict(figure), "value": figure.worst} for figure in figures]
        typer.echo(json.dumps({"ok": ok, "checks": checks}))
    for one in () if as_json else figures:
        said = "ok" if one.ok else "FAIL"
        typer.echo(f"{one.name:44} median {number(one.median)}  worst {number(one.worst)} {one.unit}"
                   f"  bound {number(one.bound)}  {said}")
    return 0 if ok else CHECK_FAILED


def report(
    *,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("docs/performance.md"),
    section: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Only this one, e.g. loop; may be given again.")
    ] = None,
) -> int:
    """Run the measurements that the performance page shows, and write them into it. All of them take over an hour."""
    from sightline.benchmarks.report import sections_named, write_report

    return 0 if write_report(out, sections_named(section or ()), typer.echo) else CHECK_FAILED


def print_checks(checks: "list[Check]", as_json: bool) -> int:
    """Print them, and return the exit code."""
    from sightline.evaluation.checks import check_line

    ok = all(check.ok for check in checks)
    if as_json:
        typer.echo(json.dumps({"ok": ok, "checks": [asdict(check) for check in checks]}))
    else:
        typer.echo("\n".join(check_line(check) for check in checks))
    return 0 if ok else CHECK_FAILED
