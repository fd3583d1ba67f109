"""`sightline bench network`: two machines and a bad network between them, on this one. Shell. Needs root."""

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import CHECK_FAILED, Json, numbers
from sightline.operator_side.preflight import needs

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from sightline.benchmarks.loop_figures import LoopCheck
    from sightline.benchmarks.network.stage import NetworkRun


def register_network_bench(group: typer.Typer) -> None:
    """Add the command to the `bench` group."""
    group.command(epilog="Example: sightline bench network --only radio --seeds 1,2,3,4,5 --seconds 60")(network)


def network(
    *,
    only: Annotated[list[str] | None, typer.Option("--only", metavar="ROW", help="A row; repeatable.")] = None,
    transport: Annotated[str, typer.Option(help="zenoh or websocket, between robot and vision.")] = "zenoh",
    seconds: Annotated[float, typer.Option(help="Of each row, 4 to 600.")] = 20.0,
    seeds: Annotated[str, typer.Option(help="Of what the wire loses, for rows where it loses; by commas.")] = "1",
    as_json: Json = False,
) -> int:
    """Robots, visions and people in two network namespaces: what slow, lossy, far, broken and shared wires cost."""
    with needs("all"):
        from sightline.benchmarks.network.run import Progress, run_network
        from sightline.benchmarks.network.cases import chosen
        from sightline.benchmarks.network.stage import NetworkSetting
        from sightline.operator_side.faults.wires import BenchWire
        from sightline.operator_side.network_medium import medium
    setting = NetworkSetting(transport, seconds, tuple(numbers("--seeds", seeds, int)))
    telling = Progress(lambda line: typer.echo(line, err=True), lambda run: _print_run(run, as_json=as_json))
    runs = run_network(chosen(only or (), transport), setting, BenchWire, telling, {"medium": medium})
    result = _network_result(runs, transport)
    if as_json:
        typer.echo(json.dumps(result))
    elif len(setting.seeds) > 1:
        _print_worst(runs)
    return 0 if result["ok"] else CHECK_FAILED


def _network_result(runs: "Sequence[NetworkRun]", transport: str) -> dict[str, Any]:
    checks = [asdict(check) for check in _worst(runs)]
    rows = [
        {"row": run.row.name, "seed": run.seed, "injected": run.injected, "facts": run.facts,
         "checks": [asdict(check) for check in run.checks], "phases": [asdict(of) for of in run.figures]}
        for run in runs
    ]
    return {"ok": bool(checks) and all(one["ok"] for one in checks), "checks": checks, "transport": transport,
            "rows": rows}


def _worst(runs: "Sequence[NetworkRun]") -> "Iterator[LoopCheck]":
    """Of each demand on a row, the seed that did worst."""
    from sightline.benchmarks.network_figures import worst_of_seeds

    for name in dict.fromkeys(run.row.name for run in runs):
        yield from worst_of_seeds(name, [run.checks for run in runs if run.row.name == name])


def _print_run(run: "NetworkRun", *, as_json: bool) -> None:
    from sightline.evaluation.checks import number

    typer.echo(f"{run.row.name} ({run.row.what}), seed {run.seed}", err=as_json)
    for last in run.figures[-1:]:
        typer.echo(
            f"  age p50 {number(last.p50_ms)} p95 {number(last.p95_ms)} ms, "
            f"{last.fps:.1f} fps of {last.bytes_per_frame / 1000:.0f} kB, quality {last.quality_percent:.0f} %, "
            f"size {last.scale_percent:.0f} %, window up to {last.window}, {last.timeouts} unanswered, "
            f"holds {', '.join(f'{one:.1f} s' for one in last.holds_s) or 'none'}", err=as_json,
        )
    if run.facts:
        typer.echo("  " + ", ".join(f"{name} {number(fact)}" for name, fact in run.facts.items()), err=as_json)
    _print_network_checks(run.checks, as_json=as_json)


def _print_worst(runs: "Sequence[NetworkRun]") -> None:
    typer.echo("worst of all seeds")
    _print_network_checks(list(_worst(runs)), as_json=False)


def _print_network_checks(checks: "Sequence[LoopCheck]", *, as_json: bool) -> None:
    from sightline.evaluation.checks import Check, check_line

    for check in checks:
        typer.echo("  " + check_line(Check(check.name, check.value, check.unit, check.bound, check.ok)), err=as_json)
