"""`sightline bench loop` and `bench watchers`: is the whole loop fresh, and does it stay so? Shell."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from sightline.operator_side.cli.options import CHECK_FAILED, Json
from sightline.operator_side.preflight import needs
from sightline.protocol.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sightline.benchmarks.loop.race import Race
    from sightline.benchmarks.loop_figures import LoopCheck

_ALONE = (
    "Peers see as the older write-ups do. With `+our eyes` they have Sightline's pipeline instead: what their "
    "transport alone costs, without credit, age or a gate; shown, not judged."
)
Transport = Annotated[str, typer.Option(help="zenoh or websocket, between robot and vision.")]


class AnyCheck(Protocol):
    """A check, whichever bench made it."""

    @property
    def name(self) -> str:
        """What is demanded."""
        ...

    @property
    def value(self) -> float | None:
        """What was measured."""
        ...

    @property
    def unit(self) -> str:
        """Of value and bound."""
        ...

    @property
    def bound(self) -> float:
        """The most that is allowed."""
        ...

    @property
    def ok(self) -> bool:
        """Whether it holds."""
        ...


def register_loop_benches(group: typer.Typer) -> None:
    """Add the commands to the `bench` group."""
    group.command(epilog="Example: sightline bench loop --detector-delay-ms 80 --seconds 20 --out runs/loop")(loop)
    group.command(epilog="Example: sightline bench watchers --viewers 10 --seconds 20")(watchers)
    group.command(epilog="Example: sightline bench camera --seconds 30")(camera)


def loop(
    *,
    size: Annotated[str, typer.Option(metavar="WxH", help="Of the pictures, in pixels.")] = "640x480",
    fps: Annotated[float, typer.Option(help="Pictures a second, 1 to 240.")] = 30.0,
    transport: Transport = "zenoh",
    detector_delay_ms: Annotated[float, typer.Option(help="Make every detector this much slower, 0 to 300.")] = 0.0,
    overload: Annotated[
        float, typer.Option(help="So many times more pictures than can be detected, e.g. 2; sets rate or detector.")
    ] = 0.0,
    seconds: Annotated[float, typer.Option(help="Of each contestant, 2 to 600.")] = 10.0,
    peers: Annotated[str, typer.Option(help="all, none, or of older, lekiwi, openpi, callback.")] = "all",
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Leave loop.json and loop.png here.")] = None,
    as_json: Json = False,
) -> int:
    """Capture to the driver's verdict, beside the in-process floor, bare TCP and what others build."""
    with needs("bench"):
        from sightline.benchmarks.loop.race import run_race
        from sightline.benchmarks.loop.figures import LoopSetting, peers_of, size_of

        if peers != "none":
            import zmq  # noqa: F401  # a peer's need; said here, not by a process that dies
    width_px, height_px = size_of(size)
    setting = LoopSetting(
        Path(), width_px, height_px, fps, transport, detector_delay_ms, overload, seconds=seconds, peers=peers_of(peers)
    )
    race = run_race(setting, lambda line: typer.echo(line, err=True))
    result = _race_result(race)
    if out is not None:
        _leave(out, race, result)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        typer.echo("\n".join([*_table(race), "", *_check_lines(race.checks)]))
    return 0 if result["ok"] else CHECK_FAILED


def watchers(
    *,
    viewers: Annotated[int, typer.Option(min=2, max=12, help="One never reads, one reads once a second.")] = 10,
    seconds: Annotated[float, typer.Option(min=3, max=600, help="Without viewers, and again with them.")] = 20.0,
    transport: Transport = "zenoh",
    as_json: Json = False,
) -> int:
    """What viewers of the robot's pictures cost whoever drives: age of the commands, memory of the robot."""
    with needs("all"):
        from sightline.benchmarks.loop.figures import LoopSetting
        from sightline.benchmarks.watchers import measure_watchers

    setting = LoopSetting(Path(), transport=transport, seconds=seconds)
    return _print_loop_checks(measure_watchers(setting, viewers, lambda line: typer.echo(line, err=True)), as_json)


def camera(
    *,
    seconds: Annotated[float, typer.Option(min=3, max=600, help="Of pictures at 30 fps.")] = 30.0,
    as_json: Json = False,
) -> int:
    """What passing a camera's own JPEGs through costs the network process; the device is a stand-in."""
    with needs("camera"):
        from sightline.benchmarks.camera import BOUND_MS, MISSED_BOUND, measure_camera
    from sightline.benchmarks.loop_figures import at_most

    seen = measure_camera(seconds)
    name = f"camera pass-through, CPU a frame (until the frame is ready {seen.ready_ms:.2f})"
    checks = [
        at_most(name, seen.cpu_ms, "ms", BOUND_MS),
        at_most(f"missed frames of {seen.jpeg_bytes:.0f} bytes", seen.missed, "", MISSED_BOUND),
    ]
    return _print_loop_checks(checks, as_json)


def _print_loop_checks(checks: "Sequence[LoopCheck]", as_json: bool) -> int:
    ok = all(check.ok for check in checks)
    if as_json:
        typer.echo(json.dumps({"ok": ok, "checks": [asdict(check) for check in checks]}))
    else:
        typer.echo("\n".join(_check_lines(checks)))
    return 0 if ok else CHECK_FAILED


def _race_result(race: "Race") -> dict[str, Any]:
    return {
        "ok": all(check.ok for check in race.checks),
        "checks": [asdict(check) for check in race.checks],
        "setting": {**asdict(race.setting), "pictures": None, "jpeg_bytes": race.jpeg_bytes},
        "contestants": [asdict(figures) for figures in race.figures.values()],
    }


def _leave(folder: Path, race: "Race", result: dict[str, Any]) -> None:
    with needs("report"):
        from sightline.benchmarks.loop.plot import draw_race
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "loop.json").write_text(json.dumps(result, indent=1), "utf-8")
        draw_race(folder / "loop.png", race)
    except OSError as error:
        raise ConfigError(f"--out {folder}: {error.strerror}; choose a folder that can be written") from None


def _table(race: "Race") -> list[str]:
    from sightline.benchmarks.loop.figures import OUR_DETECTOR

    names = f"{'answered':>9} {'p50':>8} {'p95':>8} {'p99':>8} ms {'bytes':>8} {'others':>7}"
    head = f"{'':18} {names}  CPU ms a picture; MB"
    alone = [_ALONE] if any(name.endswith(OUR_DETECTOR) for name in race.figures) else []
    return [head, *(_row(name, race) for name in race.figures), *alone]


def _row(name: str, race: "Race") -> str:
    one = race.figures[name]
    ages = " ".join(f"{'never' if age is None else f'{age:.1f}':>8}" for age in (one.p50_ms, one.p95_ms, one.p99_ms))
    cpu = " ".join(f"{process} {cpu_ms:.2f}" for process, cpu_ms in one.cpu_ms.items())
    memory = " ".join(f"{megabytes:.0f}" for megabytes in one.memory_mb.values())
    carried = f"{one.bytes_per_picture or 0:8.0f} {one.taken_percent:5.1f} %"
    return f"{name:18} {one.answered_percent:7.1f} % {ages}    {carried}  {cpu}; {memory}"


def _check_lines(checks: "Sequence[AnyCheck]") -> list[str]:
    from sightline.evaluation.checks import Check, check_line

    return [check_line(Check(one.name, one.value, one.unit, one.bound, one.ok)) for one in checks]
