"""`sightline bench detector` and `bench streams`: what eyes elsewhere cost, and one service for many. Shell."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import Json
from sightline.operator_side.preflight import needs

if TYPE_CHECKING:
    from sightline.evaluation.checks import Check

_READY_S = 30.0
_BOUND_US = {"zenoh": 1_000.0, "oip+http": 2_000.0}
"""The median that asking elsewhere on the same machine may add, hot; the rest is only told."""


def register_detector_benches(group: typer.Typer) -> None:
    """Add the commands to the `bench` group."""
    group.command(epilog="Example: sightline bench detector oip+http://127.0.0.1:8000/ball_jpeg")(detector)
    group.command(epilog="Example: sightline bench streams --streams 40 --seconds 60")(streams)


def detector(
    name: Annotated[str, typer.Argument(metavar="NAME", help="zenoh, or the address of a server that runs.")] = "zenoh",
    *,
    frames: Annotated[int, typer.Option(min=30, max=10_000, help="Hot, and again paced at 30 a second.")] = 300,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the detector's own Config.")
    ] = None,
    as_json: Json = False,
) -> int:
    """What a detector elsewhere adds to the time of the same frames here (hsv), 320x240."""
    from sightline.operator_side.cli_detector import own_options

    with needs("vision"):
        from sightline.benchmarks.detector_remote import HOT_S, PACED_S, measure_cost
        from sightline.evaluation.checks import Check
        from sightline.vision_side.config import VisionConfig
        from sightline.vision_side.detect.around import attach_detector, close_detector
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
        what = f"{name}: added, {way} (here {cost.here_us:.0f}, there {cost.there_us:.0f}, medians)"
        judged = bound if way == "hot" else float("inf")
        checks.append(Check(what, cost.added_us, "us", judged, cost.added_us <= judged))
        checks.append(Check(f"{name}: not answered of {frames}", cost.unanswered, "", most, cost.unanswered <= most))
    return _print(checks, as_json)


def streams(
    *,
    streams: Annotated[int, typer.Option(min=2, max=200, help="Robots, each with 30 frames a second.")] = 40,
    seconds: Annotated[float, typer.Option(min=5, max=3600, help="How long.")] = 60.0,
    as_json: Json = False,
) -> int:
    """Many robots at one detector service that can look at half of their frames: age, fairness, memory."""
    with needs("vision"):
        from sightline.benchmarks import detector_streams as bench
        from sightline.evaluation.checks import Check

    with tempfile.TemporaryDirectory(prefix="sightline-") as folder:
        load = bench.measure_streams(_free_endpoint(), Path(folder), streams, seconds)
    missing = streams - len(load.answered)
    checks = [
        Check("offered per answered frame", load.overload, "", bench.OVERLOAD, load.overload >= 0.9 * bench.OVERLOAD),
        Check("age of boxes, p95", load.p95_ms, "ms", bench.DEADLINE_MS, load.p95_ms <= bench.DEADLINE_MS),
        Check("furthest from an equal share", load.unfair_percent, "%", bench.FAIRNESS_PERCENT,
              load.unfair_percent <= bench.FAIRNESS_PERCENT),
        Check("robots never answered", missing, "", 0, missing == 0),
        Check("memory of the service grew", load.growth_mb, "MB", bench.MEMORY_MB, load.growth_mb <= bench.MEMORY_MB),
    ]
    return _print(checks, as_json)


@contextmanager
def _service(name: str, folder: Path) -> "Iterator[Any]":
    """For `zenoh` a service, and a link that is both the robot's and vision's, where they meet; else None."""
    from sightline.operator_side.processes import Processes
    from sightline.protocol.transports.open import open_link

    if name != "zenoh":
        yield None
        return
    endpoint = _free_endpoint()
    with ExitStack() as ending:
        robot = ending.enter_context(open_link("r1", listen=[endpoint]))
        processes = ending.enter_context(Processes(folder))
        processes.start("detector", ["detector", "--serve", "hsv", "--connect", endpoint])
        processes.wait_line("detector", "for robots", _READY_S)
        _publish_status(robot, processes)
        yield robot


def _publish_status(robot: Any, processes: Any) -> None:
    """Until the service has taken note."""
    from sightline.protocol.channels import STATUS
    from sightline.protocol.codec import encode
    from sightline.protocol.messages import Stamp, State, Status

    stamp, status = encode(Stamp(session="0000abcd", seq=1, t_us=1)), encode(Status(state=State.HOLD, reason="bench"))
    while "looks at the pictures" not in processes.log("detector").read_text("utf-8", "replace"):
        robot.publish(STATUS, stamp, status)
        processes.check(0.1)


def _picture(folder: Path) -> bytes:
    from sightline.benchmarks.loop.pictures import write_pictures

    write_pictures(folder, 320, 240)
    return min(folder.glob("*.jpg")).read_bytes()


def _free_endpoint() -> str:
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def _print(checks: "list[Check]", as_json: bool) -> int:
    from sightline.operator_side.cli.bench import print_checks

    return print_checks(checks, as_json)
