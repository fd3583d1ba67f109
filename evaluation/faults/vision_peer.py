"""The vision service as a peer: alone with a detector that fails on command, or among services that share. Shell.

The event log gets each twist before it is sent.
"""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from sightline.evaluation.faults.evidence import GOOD, INJECTED, EventLog
from sightline.operator_side.config.loading import load_service
from sightline.protocol.channels import TWIST, Channel
from sightline.protocol.codec import decode
from sightline.protocol.config import Config
from sightline.protocol.log import LOG_FORMATS, start_log
from sightline.protocol.messages import AnswerHeader, CameraModel, Twist
from sightline.protocol.transports.link import Link, LinkWrapper
from sightline.protocol.transports.zenoh.link import ZenohLink, open_zenoh
from sightline.vision_side.config import MissionConfig, ShareConfig, VisionConfig
from sightline.vision_side.detect.onnx.detector import AutoDetector
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.pipeline import SOURCE as VISION_SOURCE
from sightline.vision_side.serving.process import run, serve

SLOW_S: Final = 0.33
"""Ten frame intervals at 30 fps."""


class LoggingLink(LinkWrapper):
    """A link that logs every twist before it is sent."""

    def __init__(self, link: Link, event_log: EventLog) -> None:
        super().__init__(link)
        self._event_log = event_log

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """Publish with the fault of this peer, see `Link`."""
        if channel is TWIST:
            self._event_log.note(GOOD, decode(AnswerHeader, header).echo.t_us)
        return self._link.publish(channel, header, payload, source)


def _raise() -> None:
    raise RuntimeError("the detector fails (injected by the bench)")


FAULTS: Final[dict[str, Callable[[], None]]] = {
    "raises": _raise, "hangs": lambda: time.sleep(3600), "slow": lambda: time.sleep(SLOW_S),
}


def _spoil_detector(fault: str, pulled: threading.Event, event_log: EventLog) -> None:
    """Let every new detector do `fault` before it detects, once triggered."""
    detect = AutoDetector.detect

    def spoiled(self: AutoDetector, *given: Any) -> Any:
        if pulled.is_set():
            event_log.note(INJECTED)
            FAULTS[fault]()
        return detect(self, *given)

    AutoDetector.detect = spoiled  # type: ignore[assignment, method-assign]


def run_vision(endpoint: str, file: Path | None, fault: str, pulled: threading.Event, event_log: EventLog) -> int:
    """Serve forever. The detector does `fault` once triggered."""
    if fault:
        _spoil_detector(fault, pulled, event_log)
    loaded = load_service("vision", file=str(file) if file else None, options={"connect": (endpoint,)},
                          environ=os.environ)
    config = loaded.config
    assert isinstance(config, VisionConfig)
    opened = open_zenoh(config.robot, connect=config.connect, role=VISION_SOURCE, timeout_s=15)
    with LoggingLink(opened, event_log) as link:
        serve(config, link, threading.Event(), lambda line: print(line, flush=True))
    return 0


# Services that share robots.

_CIRCLE: Final = "sightline.evaluation.faults.vision_peer:CircleMission"


class CircleConfig(Config):
    """The twist that answers each frame."""

    linear_mps: float
    angular_rad_s: float


class CircleMission:
    """A mission that drives a circle. Its direction in the motor log shows which service drives."""

    Config = CircleConfig

    def __init__(self, config: CircleConfig, _camera: CameraModel) -> None:
        self._plan = Plan(Twist.model_validate(config.model_dump()), "circle")

    def step(self, _view: View) -> Plan:
        """Return the same plan for each frame."""
        return self._plan


def run_shared(endpoint: str, name: str, linear_mps: float, angular_rad_s: float, event_log: EventLog) -> int:
    """Run `sightline vision --share --name NAME` until SIGTERM. The wheels of its robots make a circle."""
    publish = ZenohLink.publish

    def noted(self: ZenohLink, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        if channel is TWIST:
            event_log.note(GOOD, decode(AnswerHeader, header).echo.t_us)
        return publish(self, channel, header, payload, source)

    ZenohLink.publish = noted  # type: ignore[method-assign]
    start_log(LOG_FORMATS[0], "vision")
    twist = {"linear_mps": linear_mps, "angular_rad_s": angular_rad_s}
    return run(VisionConfig(robot="*", connect=(endpoint,), share=ShareConfig(enabled=True, name=name),
                            mission=MissionConfig(kind=_CIRCLE, options=twist)))
