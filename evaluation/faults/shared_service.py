"""A vision service that shares robots, as a peer of the fault bench; its mission shows that it drives. Shell."""

import threading
from typing import TYPE_CHECKING, Final

from sightline.evaluation.faults.evidence import GOOD, EventLog
from sightline.protocol.channels import TWIST, Channel
from sightline.protocol.codec import decode
from sightline.protocol.config import Config
from sightline.protocol.log import LOG_FORMATS, start_log
from sightline.protocol.messages import AnswerHeader, CameraModel, Twist
from sightline.protocol.transports.zenoh.link import ZenohLink
from sightline.vision_side.config import MissionConfig, ShareConfig, VisionConfig
from sightline.vision_side.missions.port import Plan, View
from sightline.vision_side.serving.process import run

if TYPE_CHECKING:
    from sightline.evaluation.faults.peer import PeerOptions

_MISSION: Final = "sightline.evaluation.faults.shared_service:Circle"


class CircleConfig(Config):
    """The twist that answers each frame."""

    linear_mps: float
    angular_rad_s: float


class Circle:
    """A mission: one circle. The motor log shows by its direction which service drives."""

    Config = CircleConfig

    def __init__(self, config: CircleConfig, _camera: CameraModel) -> None:
        self._plan = Plan(Twist.model_validate(config.model_dump()), "circle")

    def step(self, _view: View) -> Plan:
        """Return the same plan for each frame."""
        return self._plan


def run_shared(options: "PeerOptions", _pulled: threading.Event, ledger: EventLog) -> int:
    """Run what `sightline vision --share --name NAME` runs, until SIGTERM, and note every twist before it leaves."""
    publish = ZenohLink.publish

    def noted(self: ZenohLink, channel: Channel, header: bytes, payload: bytes, source: str = "") -> bool:
        if channel is TWIST:
            ledger.note(GOOD, decode(AnswerHeader, header).echo.t_us)
        return publish(self, channel, header, payload, source)

    ZenohLink.publish = noted  # type: ignore[method-assign]
    start_log(LOG_FORMATS[0], "vision")
    twist = {"linear_mps": options.linear_mps, "angular_rad_s": options.angular_rad_s}
    share = ShareConfig(enabled=True, name=options.share)
    return run(VisionConfig(robot="*", connect=(options.endpoint,), share=share,
                            mission=MissionConfig(kind=_MISSION, options=twist)))
