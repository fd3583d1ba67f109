"""Missions that people ask for: who may, whether it was asked just now, and why one is not taken up. Pure.

Times are the robot's: what was asked must cite a status not much older than the frame at hand, so that a message that
a network kept back does not start anything.
"""

from dataclasses import dataclass
from typing import Final

from sightline.protocol.channels import MISSION
from sightline.protocol.codec import decode
from sightline.protocol.errors import ConfigError, WireError
from sightline.protocol.messages import FrameHeader, RequestHeader, RequestId
from sightline.protocol.mission_messages import MissionRequest
from sightline.protocol.refusals import RejectReason
from sightline.protocol.transports.link import Message
from sightline.vision_side.config import VisionConfig
from sightline.vision_side.missions.registry import MissionSpec, requested_mission

MAX_AGE_US: Final = 2_000_000
"""As old as the status that a request to a robot may cite."""
_LONGEST: Final = 200


DETECTOR_SWAP: Final = "detector"
"""Asked for like a mission, and none: which detector drives, with the option `shadow`, true or false."""


@dataclass(frozen=True, slots=True)
class DetectorSwap:
    """Which detector is to drive: the one that looks on until now, or the first one again."""

    shadow: bool


class MissionRequests:
    """Takes up what is asked for, each once. `asked` is the newest, `refused` why it was not taken up."""

    def __init__(self, config: VisionConfig) -> None:
        self._config = config
        self.asked: RequestId | None = None
        self.refused = ""

    def take(self, message: Message, frame: FrameHeader) -> MissionSpec | DetectorSwap | None:
        """What to do from `frame` on; None for what was said before and for what is refused.

        Raises WireError for what is no message of this channel; `refused` then says it too.
        """
        try:
            header = decode(RequestHeader, message.header)
            request = decode(MissionRequest, message.payload, MISSION.max_payload_bytes)
        except WireError as error:
            self.refused = str(error)[:_LONGEST]
            raise
        asked = RequestId(session=header.session, id=request.id)
        if asked == self.asked:
            return None
        self.asked, self.refused = asked, ""
        try:
            _check(header, message.source, frame)
            return _swap_of(request) if request.name == DETECTOR_SWAP else requested_mission(request, self._config)
        except (WireError, ConfigError) as error:
            self.refused = " ".join(str(error).split())[:_LONGEST]
            return None


def _swap_of(request: MissionRequest) -> DetectorSwap:
    """Raises ConfigError for other options than its one."""
    shadow = request.options.get("shadow")
    if len(request.options) != 1 or not isinstance(shadow, bool) or request.waypoints:
        raise ConfigError("which detector drives is said with the option shadow=true or shadow=false alone")
    return DetectorSwap(shadow)


def _check(header: RequestHeader, source: str, frame: FrameHeader) -> None:
    """Raise WireError unless it is said by who may, of this session of the robot, and just now."""
    if header.source != source:
        raise WireError(RejectReason.UNKNOWN_SOURCE, "key and header disagree on the source")
    if source not in MISSION.said_by:
        raise WireError(RejectReason.UNKNOWN_SOURCE, f"{source} chooses no mission; {' and '.join(MISSION.said_by)} do")
    echo = header.echo
    if echo is None or echo.channel != "status":
        raise WireError(RejectReason.NOT_ALLOWED, "a mission cites the newest status of the robot")
    if echo.session != frame.session:
        raise WireError(RejectReason.OTHER_SESSION, f"it was asked of session {echo.session}, the robot is in "
                                               f"{frame.session}: say it again")
    age_us = frame.t_us - echo.t_us
    if age_us > MAX_AGE_US:
        raise WireError(RejectReason.STALE, f"it was asked {age_us / 1e6:.1f} s ago: say it again")
