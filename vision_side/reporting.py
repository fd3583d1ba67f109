"""What vision says of itself, and how often: twice a second, and at once when something changed. Pure."""

from typing import Final

from protocol.messages import Asked
from protocol.mission_messages import MissionReport
from vision_side.config import DetectorConfig
from vision_side.pipeline import Seen

PERIOD_S: Final = 0.5
LEAST_GAP_S: Final = 0.1
"""A target that comes and goes with every frame is no reason for more reports than this."""
_PHASE_LENGTH, _TEXT_LENGTH, _NAME_LENGTH = 32, 200, 64


class Reporter:
    """Makes the reports of one vision for one robot."""

    def __init__(self, detector: DetectorConfig) -> None:
        self._detector = detector.kind
        self._device = "cpu" if detector.kind == "hsv" else ""
        self._said: tuple[object, ...] | None = None
        self._said_s = 0.0

    def due(self, now_s: float, mission: str, seen: Seen, asked: Asked | None, refused: str) -> MissionReport | None:
        """The report, if it is time for one."""
        state = (mission, seen.phase, seen.done, asked, refused)
        gap_s = LEAST_GAP_S if state != self._said else PERIOD_S
        if self._said is not None and now_s - self._said_s < gap_s:
            return None
        self._said, self._said_s = state, now_s
        return MissionReport(
            mission=mission[:_NAME_LENGTH], phase=_line(seen.phase, _PHASE_LENGTH),
            note=_line(seen.note, _TEXT_LENGTH), done=seen.done,
            asked=asked, refused=refused[:_TEXT_LENGTH], detector=self._detector, device=self._device,
        )


def _line(text: str, most: int) -> str:
    """Whatever a mission says, on one line and within the wire's bound."""
    return " ".join(text.split())[:most]
