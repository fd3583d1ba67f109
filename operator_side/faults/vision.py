"""The real vision service with a ledger between it and the link, and a detector that can be made to fail. Shell."""

import os
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from sightline.operator_side.faults.ledger import GOOD, INJECTED, EventLog
from sightline.operator_side.service_settings import load_service
from sightline.protocol.channels import TWIST, Channel
from sightline.protocol.codec import decode
from sightline.protocol.messages import AnswerHeader
from sightline.protocol.transports.link import LatestSlot, Link, Message
from sightline.protocol.transports.zenoh.link import open_zenoh
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.detect.hsv import HsvDetector
from sightline.vision_side.pipeline import SOURCE as VISION_SOURCE
from sightline.vision_side.serving.process import serve

if TYPE_CHECKING:
    from sightline.evaluation.faults.peer import PeerOptions

SLOW_S: Final = 0.33
"""Ten frame intervals at 30 fps."""


class LoggingLink:
    """A link that notes every twist before it leaves; a `Link` itself."""

    def __init__(self, link: Link, ledger: EventLog) -> None:
        self.robot = link.robot
        self._link, self._ledger = link, ledger

    def publish(self, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        """As `Link` says."""
        if channel is TWIST:
            self._ledger.note(GOOD, decode(AnswerHeader, header).echo.t_us)
        return self._link.publish(channel, header, payload, source)

    def subscribe(self, channel: Channel, callback: Callable[[Message], None]) -> None:
        """As `Link` says."""
        self._link.subscribe(channel, callback)

    def latest(self, channel: Channel) -> LatestSlot[Message]:
        """As `Link` says."""
        return self._link.latest(channel)

    def ignore(self, channel: Channel) -> None:
        """As `Link` says."""
        self._link.ignore(channel)

    def has_listener(self, channel: Channel) -> bool:
        """As `Link` says."""
        return self._link.has_listener(channel)

    def close(self) -> None:
        """As `Link` says."""
        self._link.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _raise() -> None:
    raise RuntimeError("the detector fails, as the bench told it to")


FAULTS: Final[dict[str, Callable[[], None]]] = {
    "raises": _raise, "hangs": lambda: time.sleep(3600), "slow": lambda: time.sleep(SLOW_S),
}


def _spoil_detector(fault: str, pulled: threading.Event, ledger: EventLog) -> None:
    """Every detector built from now on does `fault` before it detects, once the trigger is pulled."""
    detect = HsvDetector.detect

    def spoiled(self: HsvDetector, picture: Any) -> Any:
        if pulled.is_set():
            ledger.note(INJECTED)
            FAULTS[fault]()
        return detect(self, picture)

    HsvDetector.detect = spoiled  # type: ignore[method-assign]


def run_vision(options: "PeerOptions", pulled: threading.Event, ledger: EventLog) -> int:
    """Serve for ever."""
    if options.fault:
        _spoil_detector(options.fault, pulled, ledger)
    loaded = load_service("vision", file=str(options.config) if options.config else None,
                          options={"connect": (options.endpoint,)}, environ=os.environ)
    config = loaded.config
    assert isinstance(config, VisionConfig)
    with LoggingLink(open_zenoh(config.robot, connect=config.connect, role=VISION_SOURCE, timeout_s=15), ledger) as link:
        serve(config, link, threading.Event(), lambda line: print(line, flush=True))
    return 0
