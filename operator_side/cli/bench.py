"""Commands that measure performance: bench codec, gate, pipeline, loop, network, detector and others. Shell."""

import json
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import Json, ScenarioNames, command_group, numbers, print_result
from sightline.operator_side.preflight import needs
from sightline.operator_side.table import table_lines
from sightline.protocol.errors import ConfigError

if TYPE_CHECKING:
    from sightline.benchmarks.loop.race import Race
    from sightline.benchmarks.network.stage import NetworkRun
    from sightline.evaluation.checks import Check


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = command_group("Measure performance on this machine")
    group.command(epilog="Example: sightline bench codec --json")(codec)
    group.command(epilog="Example: sightline bench gate")(gate)
    group.command(epilog="Example: sightline bench pipeline")(pipeline)
    group.command(epilog="Example: sightline bench demo --scenario circle --seeds 201,202,203")(demo)
    group.command(epilog="Example: sightline bench loop --detector-delay-ms 80 --out runs/loop")(loop)
    group.command(epilog="Example: sightline bench watchers --viewers 10 --seconds 20")(watchers)
    group.command(epilog="Example: sightline bench network --only radio --seeds 1,2,3,4,5 --seconds 60")(network)
    group.command(epilog="Example: sightline bench detector oip+http://127.0.0.1:8000/ball_jpeg")(detector)
    group.command(epilog="Example: sightline bench streams --streams 40 --seconds 60")(streams)
    app.add_typer(group, name="bench")


def codec(*, as_json: Json = False) -> int:
    """Measure encoding and decoding of frame header and twist"""
    from sightline.benchmarks.costs import measure_codec

    with _load_shown():
        checks = measure_codec()
    return _print_checks(checks, as_json)


def gate(*, as_json: Json = False) -> int:
    """Measure the gate: one command, one step, one proof"""
    from sightline.benchmarks.costs import GATE_BOUND_US, PROOF_BOUND_US, measure_gate, measure_proof
    from sightline.evaluation.checks import at_most

    with _load_shown():
        checks = [
            at_most("offer and step", measure_gate(), "us", GATE_BOUND_US),
            at_most("proof, most hashes", measure_proof(), "us", PROOF_BOUND_US),
        ]
    return _print_checks(checks, as_json)


def pipeline(*, as_json: Json = False) -> int:
    """Measure the pipeline from image to command

    The steps are decode, detect, track and steer. It also measures the network of the learned detector.
    """
    with needs("vision"):
        from sightline.benchmarks.pipeline import LEARNED_BOUND_US, TWO_LOOKS_BOUND_US, time_learned, time_steps
    from sightline.evaluation.checks import Check, at_most

    checks = []
    with _load_shown():
        steps, learned = time_steps(), time_learned()
    for one in steps:
        size = f"{one.width_px}x{one.height_px}"
        checks.append(Check(
            f"step at {size}, hot (best round {one.alone_us:.0f}, paced {one.paced_us:.0f}, "
            f"decode {one.decode_us:.0f})",
            one.median_us, "us", one.bound_us, one.median_us <= one.bound_us and one.phase == "tracking",
        ))
        checks.append(at_most(f"hsv at {size}, decoding included, hot (best round {one.hsv_alone_us:.0f})",
                              one.hsv_us, "us", one.bound_us))
    checks.append(at_most(
        f"onnx at 320x240, network only, hot (best round {learned.alone_us:.0f}, "
        f"from JPEG to boxes {learned.whole_us:.0f}, decode {learned.decode_us:.0f}; {learned.engine})",
        learned.network_us, "us", LEARNED_BOUND_US,
    ))
    checks += [
        at_most("onnx at 320x240, two looks, from JPEG to boxes, hot", learned.two_us, "us", TWO_LOOKS_BOUND_US),
        at_most("images in which onnx finds no ball", learned.missed, "", 0),
        at_most("images without a ball in which onnx finds one", learned.false, "", 0),
    ]
    return _print_checks(checks, as_json)


def demo(
    *,
    scenario: ScenarioNames = "all",
    seeds: Annotated[str, typer.Option(help="Seeds, separated by commas.")] = "201,202,203",
    seconds: Annotated[
        float | None, typer.Option(min=5, max=3600, help="Length of each demo [default: 20, or of the course].")
    ] = None,
    as_json: Json = False,
) -> int:
    """Run many demos in real time and score their median"""
    with needs("all"):
        from sightline.benchmarks.real_time import Kinds, measure_demos
        from sightline.evaluation.checks import number
        from sightline.evaluation.demo.run import DemoOptions
        from sightline.evaluation.score.figures import EXACT
        from sightline.sim.scenario import AT_LEAST, load_scenario, scenario_names
    names = scenario_names() if scenario == "all" else scenario.split(",")
    for name in names:
        load_scenario(name)
    wanted, kinds = numbers("--seeds", seeds, int), Kinds(AT_LEAST, EXACT)
    for seed in wanted:
        DemoOptions(seed=seed)  # raises ConfigError before the first demo
    figures = measure_demos(names, wanted, seconds, kinds, lambda line: typer.echo(line, err=True))
    checks = [{**asdict(figure), "value": figure.worst} for figure in figures]
    lines = table_lines(
        (one.name, f"median {number(one.median)}", f"worst {number(one.worst)} {one.unit}",
         f"bound {number(one.bound)}", "ok" if one.ok else "FAIL") for one in figures
    )
    return print_result({"ok": all(figure.ok for figure in figures), "checks": checks}, lines, as_json)


@contextmanager
def _load_shown() -> Iterator[None]:
    """Print the share of this machine that other programs used meanwhile, if it is too large for a measurement."""
    from sightline.benchmarks.loop.counters import read_machine, taken_percent
    from sightline.benchmarks.loop.figures import TAKEN_BOUND_PERCENT

    before, began_s = read_machine({}), time.monotonic()
    yield
    others = taken_percent(before, read_machine({}), time.monotonic() - began_s)
    if others > TAKEN_BOUND_PERCENT:
        typer.echo(f"bench: others used {others:.0f} % of this machine; close other programs and repeat", err=True)


def _print_checks(checks: "Sequence[Check]", as_json: bool) -> int:
    from sightline.evaluation.checks import check_lines, to_dict

    return print_result(to_dict(checks), check_lines(checks), as_json)


# --- `bench loop` and `bench watchers` ---------------------------------------------------------------------------


Transport = Annotated[str, typer.Option(help="zenoh or websocket, between robot and vision service.")]


def loop(
    *,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the images, in pixels.")] = "640x480",
    fps: Annotated[float, typer.Option(help="Images per second, 1 to 240.")] = 30.0,
    transport: Transport = "zenoh",
    detector_delay_ms: Annotated[float, typer.Option(help="Delay of every detector, 0 to 300.")] = 0.0,
    overload: Annotated[
        float, typer.Option(help="Images per detection, e.g. 2 for overload; sets rate or detector.")
    ] = 0.0,
    seconds: Annotated[float, typer.Option(help="Length for each contestant, 2 to 600.")] = 10.0,
    peers: Annotated[str, typer.Option(help="all, none, or names, e.g. tcp,ring.")] = "all",
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Write loop.json and loop.png here.")] = None,
    as_json: Json = False,
) -> int:
    """Compare the time from capture to wheels with other designs

    The others are the in-process minimum, bare TCP and other designs. `!` marks a sample that others disturbed or cut.
    """
    with needs("bench"):
        from sightline.benchmarks.loop.figures import LoopSetting, peers_of, size_of
        from sightline.benchmarks.loop.race import run_race
        from sightline.evaluation.checks import check_lines

        if peers != "none":
            import zmq  # noqa: F401  # a contestant needs it; a missing one should fail here, not in a child process
    width_px, height_px = size_of(size)
    setting = LoopSetting(
        Path(), width_px, height_px, fps, transport, detector_delay_ms, overload, seconds=seconds, peers=peers_of(peers)
    )
    race = run_race(setting, lambda line: typer.echo(line, err=True))
    result = _race_result(race)
    code = print_result(result, [*_table(race), "", *check_lines(race.checks)], as_json)
    if out is not None:  # after the results are printed, because a full disk must not lose them
        _leave(out, race, result)
    return code


def watchers(
    *,
    viewers: Annotated[int, typer.Option(min=2, max=12, help="Viewers; one never reads, one reads slowly.")] = 10,
    seconds: Annotated[float, typer.Option(min=3, max=600, help="Length without viewers, and again with them.")] = 20.0,
    transport: Transport = "zenoh",
    as_json: Json = False,
) -> int:
    """Measure the cost of viewers for the driver

    It measures the age of the commands and the memory of the robot.
    """
    with needs("all"):
        from sightline.benchmarks.loop.figures import LoopSetting
        from sightline.benchmarks.loop.viewers import measure_watchers

    setting = LoopSetting(Path(), transport=transport, seconds=seconds)
    return _print_checks(measure_watchers(setting, viewers, lambda line: typer.echo(line, err=True)), as_json)


def _race_result(race: "Race") -> dict[str, Any]:
    from sightline.evaluation.checks import to_dict

    return {
        **to_dict(race.checks),
        "setting": {**asdict(race.setting), "pictures": None, "jpeg_bytes": race.jpeg_bytes},
        "contestants": [{**asdict(one), "is_disturbed": one.is_disturbed} for one in race.figures.values()],
    }


def _leave(folder: Path, race: "Race", result: dict[str, Any]) -> None:
    with needs("report"):
        from sightline.benchmarks.loop.plot import draw_race
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "loop.json").write_text(json.dumps(result, indent=1), "utf-8")
        draw_race(folder / "loop.png", race)
    except OSError as error:
        raise ConfigError(f"--out {folder}: {error.strerror}; choose a folder that you may write") from None


def _table(race: "Race") -> list[str]:
    names = f"{'answered':>9} {'fps':>6} {'p50':>8} {'p95':>8} {'p99':>8} ms {'validated':>9} "
    names += f"{'unpaced':>7} {'bytes':>8} {'others':>7}"
    head = f"{'':18} {names}  CPU ms per image; MB"
    return [head, *(_row(name, race) for name in race.figures)]


def _row(name: str, race: "Race") -> str:
    one = race.figures[name]
    ages = " ".join(f"{'never' if age is None else f'{age:.1f}':>8}" for age in (one.p50_ms, one.p95_ms, one.p99_ms))
    cpu = " ".join(f"{process} {cpu_ms:.2f}" for process, cpu_ms in one.cpu_ms.items())
    memory = " ".join(f"{megabytes:.0f}" for megabytes in one.memory_mb.values())
    validated, unpaced = ("" if age is None else f"{age:.1f}" for age in (one.validated_ms, one.hot_ms))
    others = f"{one.taken_percent:5.1f} %{'!' if one.is_disturbed else ' '}"
    carried = f"{validated:>9} {unpaced:>7} {one.bytes_per_picture or 0:8.0f} {others}"
    return f"{name:18} {one.answered_percent:7.1f} % {one.fps:6.1f} {ages}    {carried}  {cpu}; {memory}"


# --- `bench network`: two simulated machines with a bad network between them; needs root -------------------------


def network(
    *,
    only: Annotated[list[str] | None, typer.Option("--only", metavar="ROW", help="A row; repeatable.")] = None,
    transport: Annotated[str, typer.Option(help="zenoh or websocket, between robot and vision service.")] = "zenoh",
    seconds: Annotated[float, typer.Option(help="Length of each row, 4 to 600.")] = 20.0,
    seeds: Annotated[str, typer.Option(help="Seeds of the losses, separated by commas.")] = "1",
    as_json: Json = False,
) -> int:
    """Measure slow, lossy, long, broken and shared networks

    Robots, vision services and clients run in two network namespaces. It needs root.
    """
    with needs("all"):
        from sightline.benchmarks.network.cases import chosen
        from sightline.benchmarks.network.run import NetworkProgress, run_network
        from sightline.benchmarks.network.scenes import medium
        from sightline.benchmarks.network.stage import NetworkSetting
        from sightline.evaluation.faults.fixture import BenchWire
    setting = NetworkSetting(transport, seconds, tuple(numbers("--seeds", seeds, int)))
    progress = NetworkProgress(lambda line: typer.echo(line, err=True), lambda run: _print_run(run, as_json=as_json))
    runs = run_network(chosen(only or (), transport), setting, BenchWire, progress, {"medium": medium})
    worst = list(_worst(runs))
    lines = ["worst of all seeds", *_indented(worst)] if len(setting.seeds) > 1 else []
    return print_result(_network_result(runs, worst, transport), lines, as_json)


def _network_result(runs: "Sequence[NetworkRun]", worst: "Sequence[Check]", transport: str) -> dict[str, Any]:
    from sightline.evaluation.checks import to_dict

    rows = [
        {"row": run.row.name, "seed": run.seed, "injected": run.injected, "facts": run.facts,
         "checks": [asdict(check) for check in run.checks], "phases": [asdict(of) for of in run.figures]}
        for run in runs
    ]
    checked = to_dict(worst)
    return {**checked, "ok": bool(worst) and checked["ok"], "transport": transport, "rows": rows}


def _worst(runs: "Sequence[NetworkRun]") -> "Iterator[Check]":
    """Yield the worst result over the seeds for each check of a row."""
    from sightline.benchmarks.network.figures import worst_of_seeds

    for name in dict.fromkeys(run.row.name for run in runs):
        yield from worst_of_seeds(name, [run.checks for run in runs if run.row.name == name])


def _print_run(run: "NetworkRun", *, as_json: bool) -> None:
    from sightline.evaluation.checks import number

    typer.echo(f"{run.row.name} ({run.row.what}), seed {run.seed}", err=as_json)
    for last in run.figures[-1:]:
        typer.echo(
            f"  age p50 {number(last.p50_ms)} p95 {number(last.p95_ms)} ms, validated {number(last.validated_ms)} ms, "
            f"{last.fps:.1f} fps of {last.bytes_per_frame / 1000:.0f} kB, quality {last.quality_percent:.0f} %, "
            f"size {last.scale_percent:.0f} %, window up to {last.window}, {last.timeouts} unanswered, "
            f"holds {', '.join(f'{one:.1f} s' for one in last.holds_s) or 'none'}", err=as_json,
        )
    if run.facts:
        typer.echo("  " + ", ".join(f"{name} {number(fact)}" for name, fact in run.facts.items()), err=as_json)
    for line in _indented(run.checks):
        typer.echo(line, err=as_json)


def _indented(checks: "Sequence[Check]") -> list[str]:
    from sightline.evaluation.checks import check_lines

    return [f"  {line}" for line in check_lines(checks)]


# --- `bench detector` and `bench streams` ------------------------------------------------------------------------


_BOUND_US = {"zenoh": 1_000.0, "oip+http": 2_000.0}
"""Limit of the median time that a warm remote detector on the same machine may add. Others have no limit."""


def detector(
    name: Annotated[str, typer.Argument(metavar="NAME", help="zenoh, or the address of a running server.")] = "zenoh",
    *,
    frames: Annotated[int, typer.Option(min=30, max=10_000, help="Frames back to back, then at 30 per second.")] = 300,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the detector's own Config.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Measure the time that a remote detector adds

    The comparison is hsv in this process, with the same frames of 320x240.
    """
    from sightline.operator_side.cli.detector import own_options

    with needs("vision"):
        from sightline.benchmarks.detector import HOT_S, PACED_S, measure_cost
        from sightline.evaluation.checks import at_most, number
        from sightline.vision_side.config import VisionConfig
        from sightline.vision_side.detect.plugin_calls import attach_detector, close_detector
        from sightline.vision_side.detect.registry import build_detector
    with tempfile.TemporaryDirectory(prefix="sightline-") as folder, _service(name, Path(folder)) as robot:
        here = build_detector("hsv", {}, VisionConfig())
        there = build_detector(name, own_options(sets or ()), VisionConfig())
        if robot is not None:
            attach_detector(there, robot)
        try:
            jpeg = _picture(Path(folder))
            costs = {way: measure_cost(here, there, jpeg, (320, 240), frames=frames, period_s=period_s, robot=robot)
                     for way, period_s in (("hot", HOT_S), ("paced", PACED_S))}
        finally:
            close_detector(there)
    bound, checks, most = _BOUND_US.get(name.partition(":")[0], float("inf")), [], 0.01 * frames
    for way, cost in costs.items():
        here_text, there_text = map(number, (cost.here_us, cost.there_us))
        what = f"{name}: added, {way} (here {here_text}, there {there_text}, medians)"
        checks.append(at_most(what, cost.added_us, "us", bound if way == "hot" else float("inf")))
        why = f" ({cost.why})" if cost.why else ""
        checks.append(at_most(f"{name}: unanswered of {frames}, {way}{why}", cost.unanswered, "", most))
    return _print_checks(checks, as_json)


def streams(
    *,
    streams: Annotated[int, typer.Option(min=2, max=200, help="Robots, each with 30 frames per second.")] = 40,
    seconds: Annotated[float, typer.Option(min=5, max=3600, help="Length of the run.")] = 60.0,
    services: Annotated[int, typer.Option(min=1, max=8, help="Detector services, each its own process.")] = 1,
    batch_ms: Annotated[
        float, typer.Option("--batch-ms", min=0, max=500, help="Time for a batch; 0: time for half of the frames.")
    ] = 0.0,
    share: Annotated[bool, typer.Option("--share/--no-share", help="Several services divide the robots.")] = True,
    kill: Annotated[bool, typer.Option("--kill", help="Kill one service in the middle of the run.")] = False,
    as_json: Json = False,
) -> int:
    """Measure detector services for many robots

    With --batch-ms the detector decodes each image, and the rate counts. Otherwise age, fairness and memory count.
    """
    with needs("vision"):
        from sightline.benchmarks import detector as bench
        from sightline.evaluation.processes import free_port

    plan = bench.StreamPlan(streams, seconds, services, round(batch_ms * 1000),
                            ("--share",) if share and services > 1 else (), kill)
    with tempfile.TemporaryDirectory(prefix="sightline-") as folder:
        load = bench.measure_streams(f"tcp/127.0.0.1:{free_port()}", Path(folder), plan)
    return _print_checks(bench.stream_checks(load, plan), as_json)


@contextmanager
def _service(name: str, folder: Path) -> "Iterator[Any]":
    """Start a service for `zenoh` and yield the robot's link for the vision service; otherwise yield None."""
    from sightline.evaluation.processes import Processes, free_port
    from sightline.protocol.transports.open import open_link

    if name != "zenoh":
        yield None
        return
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as ending:
        robot = ending.enter_context(open_link("r1", listen=[endpoint]))
        processes = ending.enter_context(Processes(folder))
        processes.start("detector", ["detector", "--serve", "hsv", "--connect", endpoint])
        processes.wait_line("detector", "for robots")
        _publish_status(robot, processes)
        yield robot


def _publish_status(robot: Any, processes: Any) -> None:
    """Publish the status until the service subscribes to the frames."""
    from sightline.benchmarks.detector import publish_status

    while "receives the frames" not in processes.log("detector").read_text("utf-8", "replace"):
        publish_status(robot)
        processes.check(0.1)


def _picture(folder: Path) -> bytes:
    from sightline.benchmarks.loop.pictures import write_pictures

    write_pictures(folder, 320, 240)
    return min(folder.glob("*.jpg")).read_bytes()
