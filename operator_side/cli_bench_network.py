"""`sightline bench network`: two machines and a bad network between them, on this one. Shell. Needs root."""

import json
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from operator_side.cli_judge import CHECK_FAILED, Json, numbers
from operator_side.extras import needs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks.network import NetworkRun


def register_network(group: typer.Typer) -> None:
    """Add the command to the `bench` group."""
    group.command(epilog="Example: sightline bench network --only rtt40 --transport websocket")(network)


def network(
    *,
    only: Annotated[list[str] | None, typer.Option("--only", metavar="ROW", help="A row; repeatable.")] = None,
    transport: Annotated[str, typer.Option(help="zenoh or websocket, between robot and vision.")] = "zenoh",
    seconds: Annotated[float, typer.Option(help="Of each row, 4 to 600.")] = 20.0,
    seeds: Annotated[str, typer.Option(help="Of what the wire loses; separated by commas.")] = "1",
    as_json: Json = False,
) -> int:
    """Robot and vision in two network namespaces: age, rate and holds over slow, lossy, far and broken wires."""
    with needs("bench"):
        from benchmarks.network import NetworkSetting, run_network
        from benchmarks.network_rows import chosen
        from operator_side.faults.wires import BenchWire
    rows = chosen(only or ())
    setting = NetworkSetting(transport, seconds, tuple(numbers("--seeds", seeds, int)))
    say = partial(_say, as_json=as_json)
    runs = run_network(rows, setting, BenchWire, say)
    result = _result_of(runs, setting.transport)
    if as_json:
        typer.echo(json.dumps(result))
    return 0 if result["ok"] else CHECK_FAILED


def _result_of(runs: "Sequence[NetworkRun]", transport: str) -> dict[str, Any]:
    checks = [asdict(check) for run in runs for check in run.checks]
    rows = [
        {"row": run.row.name, "seed": run.seed, "injected": run.injected, "phases": [asdict(of) for of in run.figures]}
        for run in runs
    ]
    return {"ok": bool(checks) and all(one["ok"] for one in checks), "checks": checks, "transport": transport,
            "rows": rows}


def _say(run: "NetworkRun", *, as_json: bool) -> None:
    from operator_side.check_text import check_line, number
    from operator_side.score import Check

    last = run.figures[-1]
    typer.echo(
        f"{run.row.name} ({run.row.what}), seed {run.seed}: "
        f"age p50 {number(last.p50_ms)} p95 {number(last.p95_ms)} ms, "
        f"{last.fps:.1f} fps of {last.bytes_per_frame / 1000:.0f} kB, quality {last.quality_percent:.0f} %, "
        f"size {last.scale_percent:.0f} %, window up to {last.window}, {last.timeouts} unanswered, "
        f"holds {', '.join(f'{one:.1f} s' for one in last.holds_s) or 'none'}", err=as_json,
    )
    for check in () if as_json else run.checks:
        typer.echo("  " + check_line(Check(check.name, check.value, check.unit, check.bound, check.ok)))
