"""Commands about detectors: list, check, and a detector served to many robots. Shell."""

import json
import math
import os
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sightline.operator_side.cli.options import (
    CHECK_FAILED,
    ConfigFile,
    Device,
    Json,
    Listen,
    LogForm,
    MaybeSecure,
    ServiceConnect,
    Sets,
)
from sightline.operator_side.cli.options import (
    Listen as MaybeListen,
)
from sightline.operator_side.cli.options import (
    ServiceConnect as MaybeConnect,
)
from sightline.operator_side.config.loading import load_service
from sightline.operator_side.preflight import needs
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import start_log

if TYPE_CHECKING:
    from sightline.vision_side.detect.contract import PromiseResult, Times
    from sightline.vision_side.detect.port import Detector


Robots = Annotated[
    str | None, typer.Option(metavar="ID", help="A robot's id, or several by * and ? [default: the configured or *].")
]
DeadlineMs = Annotated[
    float, typer.Option("--deadline-ms", min=5, max=1000, help="From a frame's arrival to its boxes, at most.")
]
MaxBatch = Annotated[int, typer.Option("--max-batch", min=1, max=256, help="Frames looked at together, at most.")]
_ELSEWHERE = ("zenoh", "boxes")


def serve(
    name: str,
    *,
    robot: Robots = None,
    listen: Listen = None,
    connect: ServiceConnect = None,
    secure: MaybeSecure = None,
    device: Device = None,
    deadline_ms: DeadlineMs = 100.0,
    max_batch: MaxBatch = 16,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    """Look at the newest frames of every robot that is heard and say what is in them, until Ctrl-C.

    Raises ConfigError for a detector that looks nowhere itself, and as `sightline vision` does.
    """
    start_log(log, "detector")
    if name in _ELSEWHERE:
        raise ConfigError(f"detector {name!r} is boxes that somebody else finds: serve one that looks itself, e.g. hsv")
    options = {"robot": robot, "listen": tuple(listen) if listen else None,
               "connect": tuple(connect) if connect else None, "secure": secure, "detector.kind": name,
               "detector.device": device}
    given = load_service("vision", file=config, sets=sets or (), options=options, environ=os.environ)
    everybody = {} if given.origin(("robot",)) != "default" else {"robot": "*"}
    loaded: Any = given.config.model_copy(update=everybody)
    with needs("vision"):
        from sightline.vision_side.detect.plugin_calls import close_detector
        from sightline.vision_side.detect.registry import configured_detector
        from sightline.vision_side.serving.detector_service import ServingOptions, run

        detector = configured_detector(loaded)
        try:
            return run(loaded, detector, ServingOptions(name, round(deadline_ms * 1000), max_batch, loaded.max_pixels))
        finally:
            close_detector(detector)


# The commands `detector list | check`, and `detector --serve`. Shell; heavy imports inside the commands.


def register(app: typer.Typer) -> None:
    """Add the commands to `app`."""
    group = typer.Typer(
        help="Detectors: what there is, whether one keeps its promises, and one that serves many robots.",
        no_args_is_help=False, rich_markup_mode=None, invoke_without_command=True, callback=_serve,
        epilog="Example: sightline detector --serve onnx:ball.onnx --listen tcp/0.0.0.0:7447",
    )  # fmt: skip
    group.command(name="list", epilog="Example: sightline detector list --json")(list_detectors)
    group.command(epilog="Example: sightline detector check my_eyes:Eyes --set min_score=0.5")(check)
    app.add_typer(group, name="detector")


def _serve(
    context: typer.Context,
    *,
    name: Annotated[str, typer.Option("--serve", metavar="NAME", help="Look for every robot that is heard.")] = "",
    robot: Robots = None,
    listen: MaybeListen = None,
    connect: MaybeConnect = None,
    secure: MaybeSecure = None,
    device: Device = None,
    deadline_ms: DeadlineMs = 100.0,
    max_batch: MaxBatch = 16,
    config: ConfigFile = None,
    sets: Sets = None,
    log: LogForm = None,
) -> int:
    if context.invoked_subcommand is not None:
        if name:
            raise ConfigError(f"--serve {name} runs by itself; leave out {context.invoked_subcommand!r}")
        return 0
    if not name:
        typer.echo(context.get_help())
        return 0
    return serve(name, robot=robot, listen=listen, connect=connect, secure=secure, device=device,
                         deadline_ms=deadline_ms, max_batch=max_batch, config=config, sets=sets, log=log)


def list_detectors(as_json: Json = False) -> int:
    """Name every detector, and say whether it can be used here."""
    with needs("vision"):
        from sightline.vision_side.detect.registry import REGISTRY
    rows = [(name, _problem(lambda name=name: REGISTRY.load(name))) for name in REGISTRY.names()]  # type: ignore[misc]
    model = _shipped_model()
    if as_json:
        listed = [{"name": name, "usable": not why, "why": why} for name, why in rows]
        typer.echo(json.dumps({"detectors": listed, "model_hash": model}))
    else:
        comes = f", comes with model {model}" if model else "; comes without a model: onnx:PATH"
        for name, why in rows:
            typer.echo(f"{name:<12} {why or 'ok'}{comes if name == 'onnx' and not why else ''}")
        typer.echo("or package.module:Name; boxes: what somebody else publishes, see docs/detectors.md")
    return 0


def _shipped_model() -> str:
    try:
        from sightline.vision_side.detect.onnx.detector import shipped_digest
    except ImportError:  # the list says itself what is missing
        return ""
    return shipped_digest()


def _problem(load: Callable[[], Any]) -> str:
    try:
        plugin = load()
    except ConfigError as error:
        return str(error)
    return str(plugin.unusable()) if hasattr(plugin, "unusable") else ""


def check(
    name: Annotated[str, typer.Argument(metavar="NAME", help="hsv, onnx:PATH, package.module:Name ...")],
    *,
    sets: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="An option of the detector's own Config.")
    ] = None,
    device: Device = None,
    seed: Annotated[int, typer.Option(help="Draws the pictures.")] = 1,
    config: ConfigFile = None,
    as_json: Json = False,
) -> int:
    """Hold a detector to what the port promises, with drawn pictures, and time it. Exit code 5 if it breaks it."""
    options: dict[str, Any] = {"detector.device": device}
    given: Any = load_service("vision", file=config, sets=(), options=options, environ=os.environ).config
    with needs("vision"):
        from sightline.vision_side.detect.contract import check_detector, time_detector
        from sightline.vision_side.detect.plugin_calls import notices_of
        from sightline.vision_side.detect.registry import build_detector, check_device, check_takes_pictures
    settings = given.model_copy(update={"detector": given.detector.model_copy(update={"kind": name})})
    check_device(settings)
    check_takes_pictures(name)
    own, made = own_options(sets or ()), list["Detector"]()

    def make() -> "Detector":
        made.append(build_detector(name, own, settings))
        return made[-1]

    verdicts = check_detector(make, seed)
    ok = not any(one.wrong for one in verdicts)
    times = time_detector(make, seed=seed) if ok else []
    said = list(dict.fromkeys(line for one in made for line in notices_of(one)))
    report = _as_json(name, ok, verdicts, times) | {"said": said}
    typer.echo(json.dumps(report) if as_json else _as_text(name, verdicts, times, said))
    return 0 if ok else CHECK_FAILED


def own_options(texts: Sequence[str]) -> dict[str, Any]:
    """What `--set KEY=VALUE` gives a detector's own `Config`; a dot is for a section. Raises ConfigError."""
    from sightline.operator_side.config.toml_text import options_of

    return _nested(options_of(texts))


def _nested(options: dict[str, Any]) -> dict[str, Any]:
    """`hsv.shape=any` is the option `shape` of the section `hsv`. Raises ConfigError for one that is both."""
    tables: dict[str, Any] = {}
    for name, value in options.items():
        *sections, last = name.split(".")
        table = tables
        for section in sections:
            table = table.setdefault(section, {})
            if not isinstance(table, dict):
                raise ConfigError(f"--set {name}: {section!r} has a value already, and so no options")
        if isinstance(table.get(last), dict):
            raise ConfigError(f"--set {name}: options of {last!r} are given besides; give one or the other")
        table[last] = value
    return tables


def _as_json(name: str, ok: bool, verdicts: Sequence["PromiseResult"], times: Sequence["Times"]) -> dict[str, Any]:
    checks = [{"name": one.name, "value": one.wrong or "kept", "unit": "", "bound": one.promise, "ok": not one.wrong}
              for one in verdicts]
    took = [{"size": f"{one.width_px}x{one.height_px}", "p50_ms": _or_none(one.p50_ms), "p95_ms": _or_none(one.p95_ms)}
            for one in times]
    return {"ok": ok, "detector": name, "checks": checks, "times": took}


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 3)


def _as_text(name: str, verdicts: Sequence["PromiseResult"], times: Sequence["Times"], said: Sequence[str]) -> str:
    lines = [f"{name}:"]
    for one in verdicts:
        lines.append(f"  {'FAIL' if one.wrong else 'ok':<5} {one.promise}" + (f": {one.wrong}" if one.wrong else ""))
    for took in times:
        lines.append(f"  {took.width_px}x{took.height_px}: {took.p50_ms:.2f} ms p50, {took.p95_ms:.2f} ms p95")
    lines += [f"  it says: {line}" for line in said]
    return "\n".join(lines)
