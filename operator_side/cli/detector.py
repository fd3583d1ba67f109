"""The commands `detector list | check`, and `detector --serve` for many robots. Shell."""

import json
import math
import os
import shlex
import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import (
    ConfigFile,
    Device,
    Json,
    Listen,
    LogForm,
    MaybeSecure,
    ServiceConnect,
    Sets,
    complete_detector,
    plugin_prints,
    print_result,
)
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.preflight import needs
from sightline.operator_side.table import print_table
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import error_text, slow_logged, start_log
from sightline.protocol.transports.tokens import LEAST_WEIGHT, MOST_WEIGHT

if TYPE_CHECKING:
    from sightline.protocol.config import PluginRegistry
    from sightline.vision_side.detect.contract import PromiseResult, Times
    from sightline.vision_side.detect.port import Detector
    from sightline.vision_side.serving.detector_service import ServingOptions


Robots = Annotated[
    str | None, typer.Option(metavar="ID", help="Robot id; * and ? match several [default: the configured one, or *].")
]
DeadlineMs = Annotated[
    float, typer.Option("--deadline-ms", min=5, max=1000, help="Longest time from a frame's arrival to its boxes.")
]
MaxBatch = Annotated[int, typer.Option("--max-batch", min=1, max=256, help="Most frames in one batch.")]
Share = Annotated[bool, typer.Option("--share", help="Divide the robots with other services that have --share.")]
Weight = Annotated[
    float,
    typer.Option("--weight", min=LEAST_WEIGHT, max=MOST_WEIGHT,
                 help="With --share: its part of the robots, e.g. 2 for twice."),
]
Metrics = Annotated[
    str | None,
    typer.Option("--metrics", metavar="[HOST:]PORT", help="Serve /metrics, /live, /ready at this port, e.g. 9466."),
]
_LISTED_S = 30.0
"""Longest time of one plug-in in the list: its import may load a large package."""
_REMOTE = ("zenoh", "boxes")
_RECOMMENDED = (
    ("balls, legs and traffic lights", "onnx"),
    ("people and the other 79 labels of COCO", "onnx:nanodet"),
    ("an exported YOLO or another ONNX file", "onnx:FILE"),
    ("a PyTorch model", "torch:FILE, or torch:package.module:Class"),
    ("one color in even light, on a small computer", "hsv"),
)


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(
        help="List, check or serve detectors",
        no_args_is_help=False, rich_markup_mode=None, invoke_without_command=True, callback=serve,
        epilog="Example: sightline detector --serve onnx:ball.onnx --listen tcp/0.0.0.0:7447",
    )  # fmt: skip
    group.command(name="list", epilog="Example: sightline detector list --json")(list_detectors)
    group.command(epilog="Example: sightline detector check my_detector:BrightestSpot")(check)
    app.add_typer(group, name="detector")


def serve(
    context: typer.Context,
    *,
    name: Annotated[
        str,
        typer.Option("--serve", metavar="NAME", autocompletion=complete_detector,
                     help="Detect for every robot that it reaches."),
    ] = "",
    robot: Robots = None,
    listen: Listen = None,
    connect: ServiceConnect = None,
    secure: MaybeSecure = None,
    device: Device = None,
    deadline_ms: DeadlineMs = 100.0,
    max_batch: MaxBatch = 16,
    share: Share = False,
    weight: Weight = 1.0,
    metrics: Metrics = None,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    """Publish the detections in the newest frames of every robot until Ctrl-C.

    Raises:
        ConfigError: the detector is remote, or the configuration is invalid.
    """
    if context.invoked_subcommand is not None:
        if name:
            raise ConfigError(f"--serve {name} and '{context.invoked_subcommand}' exclude each other; remove one")
        return 0
    if not name:
        typer.echo(context.get_help())
        return 0
    start_log(log, "detector")
    if name in _REMOTE:
        raise ConfigError(f"--serve '{name}' is remote; choose a local detector, e.g. hsv")
    options = {"robot": robot, "listen": tuple(listen) if listen else None,
               "connect": tuple(connect) if connect else None, "secure": secure, "detector.kind": name,
               "detector.device": device}
    given = load_service("vision", file=config, sets=sets or (), options=options, environ=os.environ)
    every_robot = {} if given.origin(("robot",)) != "default" else {"robot": "*"}
    loaded: Any = given.config.model_copy(update=every_robot)
    if weight != 1.0 and not share:
        raise ConfigError("--weight has no effect alone; add --share")
    with needs("vision"):
        from sightline.vision_side.detect.plugin_calls import close_detector
        from sightline.vision_side.detect.registry import configured_detector
        from sightline.vision_side.serving.detector_service import ServingOptions

        detector = configured_detector(loaded)
        try:
            serving = ServingOptions(name, round(deadline_ms * 1000), max_batch, loaded.max_pixels,
                                     weight if share else None, loaded.robot)
            return _run(loaded, detector, serving, metrics)
        finally:
            close_detector(detector)


def _run(config: Any, detector: "Detector", options: "ServingOptions", metrics: str | None) -> int:
    from sightline.vision_side.serving.detector_service import run

    if metrics is None:
        return run(config, detector, options)
    with needs("metrics"):
        import_module("prometheus_client")
    from sightline.operator_side.cockpit.detector_metrics import served

    with served(metrics) as observe:
        return run(config, detector, options, observe)


def list_detectors(as_json: Json = False) -> int:
    """List detectors, and whether each works here"""
    with needs("vision"):
        from sightline.vision_side.detect.registry import REGISTRY
    with plugin_prints(as_json):
        rows = [(name, _problem_in_time(REGISTRY, name)) for name in REGISTRY.names()]
    model = _shipped_model()
    if as_json:
        listed = [{"name": name, "usable": not why, "why": why} for name, why in rows]
        typer.echo(json.dumps({"detectors": listed, "model_hash": model}))
    else:
        more = {"auto": ", the default: onnx or hsv",
                "onnx": f", with model {model}" if model else "; without a model: give onnx:PATH"}
        print_table((name, why or f"ok{more.get(name, '')}") for name, why in rows)
        typer.echo("also: package.module:Name for your own class, and boxes for those of another publisher")
        typer.echo("\nrecommended:")
        print_table((f"  {what}", name) for what, name in _RECOMMENDED)
    return 0


def _shipped_model() -> str:
    try:
        from sightline.vision_side.detect.onnx.detector import shipped_digest
    except ImportError:  # the list reports the missing package
        return ""
    return shipped_digest()


def _problem_in_time(registry: "PluginRegistry", name: str) -> str:
    """Return why a detector does not work here. A plug-in that hangs delays the list once and hides no other."""
    answers: list[str] = []
    read = threading.Thread(target=lambda: answers.append(_problem(registry, name)), name="detector", daemon=True)
    read.start()
    read.join(_LISTED_S)
    return answers[0] if answers else f"its import or missing() does not return within {_LISTED_S:g} s; fix the plug-in"


def _problem(registry: "PluginRegistry", name: str) -> str:
    from sightline.vision_side.detect.plugin_calls import plugin_guard

    try:
        missing: Callable[[], str] = getattr(registry.load(name), "missing", str)
        with plugin_guard(f"{name}'s missing()"):
            return missing()
    except ConfigError as error:
        return str(error)
    except BaseException as error:  # any, because the caller waits for it
        return f"its import or missing() raises {type(error).__name__}: {error_text(error)}; fix the plug-in"


def check(
    name: Annotated[
        str, typer.Argument(metavar="NAME", autocompletion=complete_detector,
                            help="hsv, onnx:PATH, package.module:Name ..."),
    ],
    *,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the detector's own Config.")
    ] = None,
    device: Device = None,
    seed: Annotated[int, typer.Option(help="Seed of the test images.")] = 1,
    config: ConfigFile = None,
    as_json: Json = False,
) -> int:
    """Check a detector against the port's contract and time it

    It uses generated images. Exit code 5 means that the detector breaks the contract.
    """
    options: dict[str, Any] = {"detector.device": device}
    given: Any = load_service("vision", file=config, sets=(), options=options, environ=os.environ).config
    with needs("vision"):
        from sightline.vision_side.detect.contract import check_detector, time_detector
        from sightline.vision_side.detect.plugin_calls import notices_of
        from sightline.vision_side.detect.registry import build_detector, check_device, check_takes_pictures
    settings = given.model_copy(update={"detector": given.detector.model_copy(update={"kind": name})})
    own, made = own_options(sets or ()), list["Detector"]()

    def make() -> "Detector":
        with slow_logged(f"waiting for the detector {name} to load"):
            made.append(build_detector(name, own, settings))
        return made[-1]

    with plugin_prints(as_json):
        check_device(settings)
        check_takes_pictures(name)
        results = check_detector(make, seed)
        ok = not any(one.wrong for one in results)
        times = time_detector(make, seed=seed) if ok else []
        notices = list(dict.fromkeys(line for one in made for line in notices_of(one)))
    if times and not any(one.boxes for one in times):
        notices.append("it found nothing in the drawn images, so that no box was checked; look at its boxes in images "
                       f"of yours: `sightline vision --dry-run --camera v4l2 --detector {shlex.quote(name)}`")
    deadline_s = settings.detector.deadline_s
    if any(one.p50_ms > deadline_s * 1000 and getattr(made[-1], "waits", False) for one in times):
        notices.append(f"most answers take longer than detector.deadline_s, {deadline_s:g} s, and would not count; use "
                       "a faster server or a longer deadline")
    report = _as_json(name, ok, results, times) | {"notices": notices}
    return print_result(report, [_as_text(name, results, times, notices)], as_json)


def own_options(texts: Sequence[str]) -> dict[str, Any]:
    """Parse `--set KEY=VALUE` for a detector's own `Config`; a dot separates sections. Raises ConfigError."""
    from sightline.operator_side.config.toml_text import options_of

    return _nested(options_of(texts, example="min_score=0.5"))


def _nested(options: dict[str, Any]) -> dict[str, Any]:
    """Convert `hsv.shape=any` to option `shape` of section `hsv`. Raises ConfigError for a name that is both."""
    tables: dict[str, Any] = {}
    for name, value in options.items():
        *sections, last = name.split(".")
        table = tables
        for section in sections:
            table = table.setdefault(section, {})
            if not isinstance(table, dict):
                raise ConfigError(f"--set {name}: '{section}' already has a value; remove one of the two")
        if isinstance(table.get(last), dict):
            raise ConfigError(f"--set {name}: options of '{last}' are also given; remove one of the two")
        table[last] = value
    return tables


def _as_json(name: str, ok: bool, results: Sequence["PromiseResult"], times: Sequence["Times"]) -> dict[str, Any]:
    checks = [{"name": one.name, "value": one.wrong or "kept", "unit": "", "bound": one.promise, "ok": not one.wrong}
              for one in results]
    took = [{"size": f"{one.width_px}x{one.height_px}", "p50_ms": _or_none(one.p50_ms), "p95_ms": _or_none(one.p95_ms),
             "boxes": one.boxes} for one in times]
    return {"ok": ok, "detector": name, "checks": checks, "times": took}


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 3)


def _as_text(name: str, results: Sequence["PromiseResult"], times: Sequence["Times"], notices: Sequence[str]) -> str:
    lines = [f"{name}:"]
    for one in results:
        lines.append(f"  {'FAIL' if one.wrong else 'ok':<5} {one.promise}" + (f": {one.wrong}" if one.wrong else ""))
    for took in times:
        lines.append(f"  {took.width_px}x{took.height_px}: {took.p50_ms:.2f} ms p50, {took.p95_ms:.2f} ms p95")
    lines += [f"  note: {line}" for line in notices]
    return "\n".join(lines)
