"""What vision says of itself, and how often: twice a second, and at once when something changed. Pure."""

from typing import Any, Final

from sightline.protocol.messages import RequestId
from sightline.protocol.mission_messages import MissionReport
from sightline.vision_side.config import DetectorConfig
from sightline.vision_side.detect.port import DetectionResult
from sightline.vision_side.pipeline import Observation

PERIOD_S: Final = 0.5
LEAST_GAP_S: Final = 0.1
"""A target that comes and goes with every frame is no reason for more reports than this."""
_PHASE_LENGTH, _TEXT_LENGTH, _NAME_LENGTH, _DEVICE_LENGTH = 32, 200, 64, 32


class Reporter:
    """Makes the reports of one vision for one robot."""

    def __init__(self, detector: DetectorConfig) -> None:
        self._detector = detector.kind.partition(":")[0]  # until there is a result to say more
        self._device = "cpu" if detector.kind == "hsv" else ""
        self._said: tuple[object, ...] | None = None
        self._said_s = 0.0

    def due(
        self, now_s: float, mission: str, seen: Observation, asked: RequestId | None, refused: str, *,
        looked: DetectionResult | None = None, beside: str = "", took_us: int | None = None,
    ) -> MissionReport | None:
        """The report, if it is time for one. `looked` is the detector's newest result, `beside` who else looks.

        `took_us` is how long plain colour looked, which gives no result.
        """
        state = (mission, seen.phase, seen.done, asked, refused)
        gap_s = LEAST_GAP_S if state != self._said else PERIOD_S
        if self._said is not None and now_s - self._said_s < gap_s:
            return None
        self._said, self._said_s = state, now_s
        return MissionReport(
            mission=mission[:_NAME_LENGTH], phase=_line(seen.phase, _PHASE_LENGTH),
            note=_line(seen.note, _TEXT_LENGTH), done=seen.done,
            asked=asked, refused=refused[:_TEXT_LENGTH], **self._eyes(looked, beside, took_us),
        )

    def _eyes(self, looked: DetectionResult | None, beside: str, took_us: int | None) -> dict[str, Any]:
        """Who looks, on what, how fast."""
        name = looked.detector if looked else self._detector
        more = f", {beside}" if beside else ""
        said = {"detector": _line(name[: _NAME_LENGTH - len(more)] + more, _NAME_LENGTH)}
        if looked is None:
            return {**said, "device": self._device, "inference_us": took_us}
        return {**said, "device": _line(looked.device, _DEVICE_LENGTH), "model": _line(looked.model_hash, _NAME_LENGTH),
                "inference_us": max(0, looked.compute_us)}


def _line(text: str, most: int) -> str:
    """Whatever a mission says, on one line and within the wire's bound."""
    return " ".join(text.split())[:most]
