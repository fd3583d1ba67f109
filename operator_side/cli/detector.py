"""`sightline detector --serve NAME`: one detector for many robots. Shell; heavy imports inside the command."""

import os
from typing import Annotated, Any

import typer

from sightline.operator_side.cli.options import ConfigFile, Device, Listen, LogForm, MaybeSecure, ServiceConnect, Sets
from sightline.operator_side.preflight import needs
from sightline.operator_side.service_settings import load_service
from sightline.protocol.errors import ConfigError
from sightline.protocol.log import set_log_format

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
    set_log_format(log, "detector")
    if name in _ELSEWHERE:
        raise ConfigError(f"detector {name!r} is boxes that somebody else finds: serve one that looks itself, e.g. hsv")
    options = {"robot": robot, "listen": tuple(listen) if listen else None,
               "connect": tuple(connect) if connect else None, "secure": secure, "detector.kind": name,
               "detector.device": device}
    given = load_service("vision", file=config, sets=sets or (), options=options, environ=os.environ)
    everybody = {} if given.origin(("robot",)) != "default" else {"robot": "*"}
    loaded: Any = given.config.model_copy(update=everybody)
    with needs("vision"):
        from sightline.vision_side.detect.around import close_detector
        from sightline.vision_side.detect.registry import build_detector, configured_detector
        from sightline.vision_side.detector_service import ServingOptions, run

        detector = configured_detector(loaded) or build_detector("hsv", {}, loaded)
        try:
            return run(loaded, detector, ServingOptions(name, round(deadline_ms * 1000), max_batch, loaded.max_pixels))
        finally:
            close_detector(detector)
